"""The data path from two clouds to a result: prepare, predict, solve, refine, carry back."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from os import PathLike
from typing import Any

import numpy as np

from utopic_cli.bridge import NetworkView, cpu_threads, load_network, predict
from utopic_cli.config import SOLVERS, AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.estimation.observability import observe
from utopic_cli.estimation.refinement import refine
from utopic_cli.estimation.solver import Estimate, Problem, solve
from utopic_cli.estimation.surface import make_surface, point_spacing
from utopic_cli.estimation.verification import measure_fit
from utopic_cli.geometry import rigid
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import check_points, read_scan
from utopic_cli.model.utopic import Utopic
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import DENSE_RATIO, PreparedPair, carry_to_all, prepare
from utopic_cli.result import Correspondences, FitMeasures, FreeMotion, Observability, RegistrationResult

Progress = Callable[[str], None]

UNIT_MISMATCH = 8.0
"""Extents that differ by more than this factor are named as a likely mix-up of units."""

FEWEST_NODES = 50
"""The network sees at least this many points of a scan that has them."""

CLEAR_SCORE = 0.25
"""An estimate that scores less may rest on normals whose sides were guessed differently."""

CLEAR_OUTWARDNESS = 0.1
"""Normals that point outwards less clearly than this (a flat sheet's) may have either side."""

RIVAL_SHARE = 0.85
"""A distinct pose with more than this share of the best one's score is named as a rival."""

LITTLE_OVERLAP = 0.1
"""Below this share of points with a counterpart, even a right answer can't be told from chance."""

COUNTERPART_REACH = 3.0
"""A point has a counterpart within this many spacings of the sparser scan."""


def align(
    source: str | PathLike[str] | np.ndarray,
    target: str | PathLike[str] | np.ndarray,
    *,
    initial: np.ndarray | None = None,
    **options: Any,
) -> RegistrationResult:
    """Align two scans: ``p_target = T_target_source @ p_source``.

    Args:
        source: the scan that moves: a file, or an (N, 3) array in any unit and pose.
        target: the scan that stays: a file, or an (M, 3) array in the same unit.
        initial: (4, 4) transformation to try first.
        **options: fields of ``AlignOptions``: weights, points, refine, solver, device,
            threads, seed.

    Raises:
        InputError: a scan can't be used.
        UsageError: an unknown option.
    """
    try:
        settings = AlignOptions(**options)
    except TypeError as error:
        known = ", ".join(AlignOptions.__dataclass_fields__)
        raise UsageError(f"{error}; known options: {known}") from error
    clouds = [_as_cloud(scan, name, settings.seed) for scan, name in ((source, "source"), (target, "target"))]
    return register(clouds[0], clouds[1], settings, initial=initial)


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
        return _register(source, target, replace(options, threads=threads), initial, _Clock(progress))


def _register(
    source: PointCloud,
    target: PointCloud,
    options: AlignOptions,
    initial: np.ndarray | None,
    clock: _Clock,
) -> RegistrationResult:
    """The verbs of a registration, in order."""
    clock.start("load weights")
    model, card = load_network(options.weights, options.device)
    clock.start("prepare")
    prepared = prepare(source, target, options.points)
    clock.start("predict")
    view = predict(model, prepared, options.seed)
    clock.start("solve")
    estimate = _solve(prepared, view, options.solver, initial)
    if options.solver != "svd" and _sides_in_doubt(prepared, estimate):
        clock.start("predict and solve inside out")
        prepared, view, estimate = _better_side(model, prepared, view, estimate, options, initial)
    transformation = prepared.denormalise(estimate.T_target_source)
    if options.refine:
        clock.start("refine")
        transformation = refine(source, target, transformation).T_target_source
    if model.config.hypothesis and options.solver != "svd":
        clock.start("look again")
        view = predict(model, prepared, options.seed, prepared.normalise(transformation))
    clock.start("measure")
    correspondences = _in_original_points(estimate.correspondences, prepared)
    threshold = COUNTERPART_REACH * max(point_spacing(source.points), point_spacing(target.points))
    fit = measure_fit(source, target, transformation, threshold, estimate.support)
    observability = _observe(prepared, transformation)
    rivals = [rival for rival in estimate.rivals if rival.score > RIVAL_SHARE * estimate.score]
    clock.start("carry to all points")
    source_all = _carry(
        (source.points - prepared.source_centre) / prepared.scale,
        prepared.source.points,
        view.source_overlap,
        view.source_uncertainty,
    )
    target_all = _carry(
        (target.points - prepared.target_centre) / prepared.scale,
        prepared.target.points,
        view.target_overlap,
        view.target_uncertainty,
    )
    return RegistrationResult(
        T_target_source=transformation,
        confidence=None,
        trusted=None,
        reasons=("these weights carry no calibration, so there is no verdict: look at the result",),
        ambiguous_with=tuple(prepared.denormalise(rival.T_target_source) for rival in rivals),
        source_overlap=source_all[:, 0],
        target_overlap=target_all[:, 0],
        source_uncertainty=source_all[:, 1],
        target_uncertainty=target_all[:, 1],
        raw_uncertainty=_summary(view),
        correspondences=correspondences,
        fit=fit,
        observability=observability,
        timings_s=clock.stop(),
        warnings=_warnings(source, target, fit, observability, len(rivals)),
        weights_name=str(card["name"]),
        weights_sha256=str(card["sha256"]),
        # With what "auto" and 0 came to: device and thread count can change the last bits.
        options={**asdict(options), "device": str(next(model.parameters()).device)},
    )


def _solve(prepared: PreparedPair, view: NetworkView, solver: str, initial: np.ndarray | None) -> Estimate:
    problem = Problem(
        source_nodes=prepared.source.points,
        target_nodes=prepared.target.points,
        matching_scores=view.matching_scores,
        source_overlap=view.source_overlap,
        target_overlap=view.target_overlap,
        source_certainty=1.0 - view.source_uncertainty,
        target_certainty=1.0 - view.target_uncertainty,
        source_dense=prepared.source.dense,
        target_dense=prepared.target.dense,
        spacing=prepared.spacing,
    )
    try:
        return solve(problem, solver, None if initial is None else prepared.normalise(initial))
    except ValueError as error:
        raise InputError(f"no transformation can be found between these scans: {error}") from error


def _check_options(options: AlignOptions, initial: np.ndarray | None) -> None:
    if options.solver not in SOLVERS:
        raise UsageError(f"{options.solver}: no such solver; choose {', '.join(SOLVERS)}")
    for name, least in (("points", FEWEST_NODES), ("seed", 0), ("threads", 0)):
        value = getattr(options, name)
        if not isinstance(value, int) or value < least:
            raise UsageError(f"{name} is {value!r}; give a whole number of at least {least}")
    if initial is not None and (np.shape(initial) != (4, 4) or not rigid.is_rigid(initial, 1e-6)):
        raise InputError("the initial transformation is no (4, 4) rigid motion")


def _sides_in_doubt(prepared: PreparedPair, estimate: Estimate) -> bool:
    """Tell whether the two scans may have been given normals on opposite sides."""
    sheet = min(prepared.source.outwardness, prepared.target.outwardness) < CLEAR_OUTWARDNESS
    return not estimate.shared_points and (sheet or estimate.score < CLEAR_SCORE)


def _better_side(
    model: Utopic,
    prepared: PreparedPair,
    view: NetworkView,
    estimate: Estimate,
    options: AlignOptions,
    initial: np.ndarray | None,
) -> tuple[PreparedPair, NetworkView, Estimate]:
    """Try the source with its normals reversed, and return what verification likes better.

    Nothing in a point cloud says which side of a surface is the outside. The rule that
    decides gives both scans the same side nearly always; where it may not have, both are tried.
    """
    reversed_pair = replace(prepared, source=prepared.source.turned_inside_out())
    reversed_view = predict(model, reversed_pair, options.seed)
    other = _solve(reversed_pair, reversed_view, options.solver, initial)
    if other.outranks(estimate):
        return reversed_pair, reversed_view, other
    return prepared, view, estimate


def _as_cloud(scan: str | PathLike[str] | np.ndarray, name: str, seed: int) -> PointCloud:
    """Read a file, or check an array (N, 3) as a file's points are; NaN points are dropped."""
    if isinstance(scan, (str, PathLike)):
        return read_scan(scan, seed=seed).cloud
    try:
        points = np.asarray(scan, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: neither a path nor an array of numbers ({error})") from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name}: an array of shape {points.shape}; expected (N, 3)")
    finite = points[np.isfinite(points).all(axis=1)]
    try:
        check_points(finite, len(points))
    except FormatError as error:
        raise InputError(f"{name}: {error}") from error
    return PointCloud(finite)


def _observe(prepared: PreparedPair, transformation: np.ndarray) -> Observability | None:
    """Find which motions the overlap fixes, in file units; None if too little overlaps to tell."""
    voxel = prepared.spacing / DENSE_RATIO
    source, target = (make_surface(cloud.dense, voxel) for cloud in (prepared.source, prepared.target))
    try:
        seen = observe(source, target, prepared.normalise(transformation))
    except ValueError:
        return None
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


def _warnings(
    source: PointCloud,
    target: PointCloud,
    fit: FitMeasures,
    observability: Observability | None,
    rivals: int,
) -> tuple[str, ...]:
    """Say what a user should know beyond the numbers."""
    warnings = []
    name, share = min(fit.overlap_ratio.items(), key=lambda item: item[1])
    if share < LITTLE_OVERLAP:
        warnings.append(f"only {share:.0%} of the {name} finds a counterpart: the answer is likely wrong")
    if observability is not None and observability.free:
        said = " and ".join(_motion_in_words(motion) for motion in observability.free)
        warnings.append(f"not determined by the surfaces that overlap: {said}")
    if rivals:
        poses = "another pose fits" if rivals == 1 else f"{rivals} other poses fit"
        warnings.append(f"{poses} nearly as well (symmetry, or too little overlap): see ambiguous_with")
    extents = [float(np.linalg.norm(np.ptp(cloud.points, axis=0))) for cloud in (source, target)]
    ratio = max(extents) / min(extents)
    if ratio >= UNIT_MISMATCH:
        warnings.append(
            f"the scans' sizes differ by a factor of about {ratio:.0f}: are both in the same unit?"
        )
    return tuple(warnings)


def _motion_in_words(motion: FreeMotion) -> str:
    axis = ", ".join(f"{value:.2f}" for value in motion.axis + 0.0)
    return f"rotation about ({axis})" if motion.kind == "rotation" else f"sliding along ({axis})"


class _Clock:
    """Seconds per step, and a word to whoever watches when a step starts."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._step = ""
        self._since = 0.0

    def start(self, step: str) -> None:
        """End the step in hand and start another."""
        self._end()
        self._step, self._since = step, time.perf_counter()
        if self._progress is not None:
            self._progress(step)

    def stop(self) -> dict[str, float]:
        """End the last step and return seconds by step."""
        self._end()
        return self._seconds

    def _end(self) -> None:
        if self._step:
            self._seconds[self._step] = time.perf_counter() - self._since
        self._step = ""
