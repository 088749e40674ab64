"""The data path from two clouds to a result: prepare, predict, solve, refine, carry back."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from numbers import Integral, Real
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.bridge import Eye, NetworkView, cpu_threads, load_network, weigh
from utopic_cli.clock import Clock, Progress
from utopic_cli.config import SOLVERS, AlignOptions, OptionValues
from utopic_cli.errors import InputError, UsageError
from utopic_cli.estimation.evidence import SAME, Seen, collect_evidence
from utopic_cli.estimation.observability import Twists, find_twists, observe
from utopic_cli.estimation.prior import ANY_ROTATION, Prior
from utopic_cli.estimation.refinement import refine
from utopic_cli.estimation.surface import point_spacing
from utopic_cli.estimation.verification import measure_fit
from utopic_cli.frame import extent, find_frame
from utopic_cli.geometry import rigid
from utopic_cli.given import as_given, take
from utopic_cli.look import look, look_both_sides
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import PreparedPair, carry_to_all, sample_pair
from utopic_cli.result import Correspondences, Observability, RegistrationResult
from utopic_cli.verdict import judge, read_calibration

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from typing_extensions import Unpack

FEWEST_NODES = 50
"""The network sees at least this many points of a scan that has them."""

RIVAL_LAG = 0.15
"""A distinct pose whose standing is behind the best one's by less than this is named as a rival. Nine in
ten poses that are the same by symmetry are, and one in eight wrong ones beside a right answer."""

COUNTERPART_REACH = 3.0
"""A point has a counterpart within this many spacings of the sparser scan."""


def align(
    source: str | PathLike[str] | ArrayLike,
    target: str | PathLike[str] | ArrayLike,
    *,
    initial: ArrayLike | None = None,
    **options: Unpack[OptionValues],
) -> RegistrationResult:
    """Align two scans: ``p_target = T_target_source @ p_source``.

    Args:
        source: the scan that moves: a file, or an (N, 3) array in any unit and pose.
        target: the scan that stays: a file, or an (M, 3) array in the same unit.
        initial: (4, 4) transformation to try first.
        **options: fields of ``AlignOptions``: weights, points, refine, solver, max_rotation,
            device, threads, seed.

    Returns:
        The answer; its arrays have one value for each point of the file or row of the array, NaN
        where that is not finite.

    Raises:
        InputError: a scan can't be used.
        UsageError: an unknown option, or a value that makes no sense.
    """
    known = [option.name for option in fields(AlignOptions)]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise UsageError(f"unknown option {', '.join(unknown)}; known options: {', '.join(known)}, initial")
    settings = AlignOptions(**options)
    start = None if initial is None else _as_motion(initial)
    _check_options(settings, start)
    # NumPy's whole numbers are as good as Python's, but neither torch nor JSON takes them.
    settings = replace(
        settings,
        points=int(settings.points),
        threads=int(settings.threads),
        seed=int(settings.seed),
        max_rotation=float(settings.max_rotation),
    )
    given = take(source, "source", settings.seed), take(target, "target", settings.seed)
    result = register(given[0].cloud, given[1].cloud, settings, initial=start)
    return as_given(result, *given)


def register(
    source: PointCloud,
    target: PointCloud,
    options: AlignOptions,
    *,
    initial: np.ndarray | None = None,
    progress: Progress | None = None,
) -> RegistrationResult:
    """Register two clouds.

    Args:
        source: the cloud that moves.
        target: the cloud that stays.
        options: see ``AlignOptions``.
        initial: (4, 4) transformation in file units to try first.
        progress: called with the name of each step as it starts.

    Returns:
        The transformation, overlap and uncertainty of every original point, and measures.

    Raises:
        InputError: the weights can't be used, or no transformation follows from the scans.
        UsageError: an unknown solver.
    """
    _check_options(options, initial)
    with cpu_threads(options.threads) as threads:
        return _register(source, target, replace(options, threads=threads), initial, Clock(progress))


def _register(
    source: PointCloud,
    target: PointCloud,
    options: AlignOptions,
    initial: np.ndarray | None,
    clock: Clock,
) -> RegistrationResult:
    """The verbs of a registration, in order."""
    prior = Prior(initial, options.max_rotation)
    clock.start("load weights")
    model, card = load_network(options.weights, options.device)
    calibration = read_calibration(card)
    clock.start("prepare")
    frame = find_frame(source, target, options.points, clean=True)
    prepared = sample_pair(frame)
    clock.start("predict and solve")
    see = Eye(model, options.seed)
    answer = look_both_sides(see, prepared, options.solver, prior)
    spread = SAME
    if options.solver == "auto" and answer.unclear:
        clock.start("sample, predict and solve anew")
        again = sample_pair(frame, resampled=np.random.default_rng(options.seed))
        if answer.inside_out:
            again = replace(again, source=again.source.turned_inside_out())
        try:
            other = look(see, again, options.solver, prior)
        except InputError:  # nothing follows from this sampling: as far from agreeing as can be
            spread = 0.0
        else:
            spread = answer.spread(other)
            answer = answer.joined(other)
    prepared, view, estimate = answer.prepared, answer.view, answer.estimate
    transformation = prepared.denormalise(estimate.T_target_source)
    trees = cKDTree(source.points), cKDTree(target.points)
    if options.refine:
        clock.start("refine")
        transformation = refine(source, target, transformation, trees=trees).T_target_source
    normalised = prepared.normalise(transformation)
    shown = model.config.hypothesis and options.solver != "svd"
    if shown:
        clock.start("look again")
        view = see(prepared, normalised)
    clock.start("measure")
    spacings = [
        point_spacing(cloud.points, tree) for cloud, tree in zip((source, target), trees, strict=True)
    ]
    threshold = COUNTERPART_REACH * max(spacings)
    fit = measure_fit(source, target, transformation, threshold, estimate.support, trees=trees)
    surfaces = answer.surfaces
    twists = find_twists(*surfaces, normalised)
    observability = None if twists is None else _observe(prepared, twists, surfaces[1].voxel)
    signals = collect_evidence(
        *surfaces, normalised, estimate, _seen(prepared, view), fit, twists, spread
    ).as_dict()
    rivals = tuple(
        prepared.denormalise(rival.T_target_source)
        for rival in estimate.rivals
        if estimate.lag(rival) < RIVAL_LAG
    )
    verdict = judge(
        calibration,
        signals,
        transformation,
        rivals,
        observability,
        fit.overlap_ratio,
        (extent(source.points), extent(target.points)),
        # Only "auto" looks for all the rivals, and unrefined surfaces agree less.
        usual=options.solver == "auto" and options.refine,
        same=np.array_equal(source.points, target.points),
    )
    if shown:
        calibrated = None if estimate.shared_points else verdict.odds  # no calibration knows such points
        odds = estimate.odds if calibrated is None else calibrated
        view = weigh(model, answer.view, view, odds)
    clock.start("carry to all points")
    source_all = _carry(
        frame.points[0],
        prepared.source.points,
        view.source_overlap,
        view.source_uncertainty,
    )
    target_all = _carry(
        frame.points[1],
        prepared.target.points,
        view.target_overlap,
        view.target_uncertainty,
    )
    return RegistrationResult(
        T_target_source=transformation,
        confidence=verdict.confidence,
        trusted=verdict.trusted,
        reasons=verdict.reasons,
        ambiguous_with=rivals,
        source_overlap=source_all[:, 0],
        target_overlap=target_all[:, 0],
        source_uncertainty=source_all[:, 1],
        target_uncertainty=target_all[:, 1],
        raw_uncertainty=_summary(view),
        correspondences=_in_original_points(estimate.correspondences, prepared),
        fit=fit,
        observability=observability,
        timings_s=clock.stop(),
        signals=signals,
        warnings=(),
        weights_name=str(card["name"]),
        weights_sha256=str(card["sha256"]),
        # With what "auto" and 0 came to: device and thread count can change the last bits.
        options={**asdict(options), "device": str(next(model.parameters()).device)},
    )


def _seen(prepared: PreparedPair, view: NetworkView) -> Seen:
    return Seen(
        prepared.source.points,
        prepared.target.points,
        np.concatenate([view.source_overlap, view.target_overlap]),
        np.concatenate([view.source_raw, view.target_raw]),
    )


def _check_options(options: AlignOptions, initial: np.ndarray | None) -> None:
    if options.solver not in SOLVERS:
        raise UsageError(f"{options.solver}: no such solver; choose {', '.join(SOLVERS)}")
    for name, least in (("points", FEWEST_NODES), ("seed", 0), ("threads", 0)):
        value = getattr(options, name)
        if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
            raise UsageError(f"{name} is {value!r}; give a whole number of at least {least}")
    if not isinstance(options.refine, (bool, np.bool_)):
        raise UsageError(f"refine is {options.refine!r}; give True or False")
    if not _is_angle(options.max_rotation):
        raise UsageError(f"max_rotation is {options.max_rotation!r}; give degrees above 0, 180 at most")
    if initial is not None and not (initial.shape == (4, 4) and rigid.is_rigid(initial, 1e-6)):
        raise InputError("the initial transformation is no (4, 4) rigid motion")


def _is_angle(value: object) -> bool:
    number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    return number and 0.0 < float(value) <= ANY_ROTATION  # type: ignore[arg-type]


def _as_motion(initial: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(initial, np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"the initial transformation is a {type(initial).__name__}; give a (4, 4) array of numbers"
        ) from None


def _observe(prepared: PreparedPair, twists: Twists, voxel: float) -> Observability:
    """Find which motions the overlap fixes, in file units."""
    seen = observe(twists, voxel)
    scale, centre = prepared.scale, prepared.target_centre
    units = np.concatenate([np.ones(3), np.full(3, scale)])
    free = tuple(
        replace(motion, point=None if motion.point is None else scale * motion.point + centre)
        for motion in seen.free
    )
    return replace(
        seen,
        free=free,
        covariance=seen.covariance * np.outer(units, units),
        centre=scale * seen.centre + centre,
    )


def _in_original_points(nodes: Correspondences, prepared: PreparedPair) -> Correspondences:
    return Correspondences(
        prepared.source.node_index[nodes.source_indices],
        prepared.target.node_index[nodes.target_indices],
        nodes.weights,
    )


def _carry(points: np.ndarray, nodes: np.ndarray, overlap: np.ndarray, uncertainty: np.ndarray) -> np.ndarray:
    """Carry overlap and uncertainty from nodes to all normalised points -> (N, 2) float32 in [0, 1]."""
    return np.clip(carry_to_all(points, nodes, np.stack([overlap, uncertainty], axis=1)), 0.0, 1.0)


def _summary(view: NetworkView) -> dict[str, float]:
    both = np.concatenate([view.source_raw, view.target_raw])
    return {
        "source_mean": float(view.source_raw.mean()),
        "target_mean": float(view.target_raw.mean()),
        "p50": float(np.percentile(both, 50)),
        "p90": float(np.percentile(both, 90)),
    }
