"""What one trained variant makes of the test pairs: matches, overlap, and two solves of the same view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.benchmark.held_out import made_of
from utopic_cli.benchmark.pair_metrics import (
    MatchMeasures,
    OverlapMeasures,
    PoseMeasures,
    known_nodes,
    measure_matches,
    measure_overlap,
    measure_pose,
)
from utopic_cli.benchmark.pool import each
from utopic_cli.benchmark.protocols import AnyProtocol
from utopic_cli.bridge import NetworkView, load_network, predict
from utopic_cli.errors import InputError
from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.look import look_both_sides
from utopic_cli.model.utopic import Utopic
from utopic_cli.preprocess import PreparedPair, prepare
from utopic_cli.synthesis.pairs import ScanPair
from utopic_cli.synthesis.shapes import ShapeLibrary

FLOOR = "floor"
SOLVERS = ("svd", "auto")
"""The paper's solve (assignment, overlap-weighted Procrustes), and the robust one; neither is refined."""


@dataclass(frozen=True)
class PairResult:
    """One variant on one pair.

    Attributes:
        pair: number of the pair in its protocol.
        shape: name of the shape.
        matches: how good the matching scores are.
        overlap: how well overlap is told at first sight; None from the variant without it.
        poses: by solver, and ``floor`` for Procrustes on the true correspondences; None without an answer.
    """

    pair: int
    shape: str | None
    matches: MatchMeasures
    overlap: OverlapMeasures | None
    poses: Mapping[str, PoseMeasures | None]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready data."""
        return asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> PairResult:
        """Build from what ``to_dict`` gave, by way of JSON.

        Raises:
            KeyError, TypeError: of anything else.
        """
        poses = {name: None if pose is None else _pose_from(pose) for name, pose in values["poses"].items()}
        told = values["overlap"]
        return PairResult(
            int(values["pair"]),
            values["shape"],
            MatchMeasures(**values["matches"]),
            None if told is None else OverlapMeasures(**told),
            poses,
        )


def measure_variant(
    weights: Path,
    protocol: AnyProtocol,
    shapes: ShapeLibrary,
    data: str,
    pairs: int,
    *,
    seed: int,
    points: int,
    device: str = "auto",
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[PairResult]:
    """Let a variant answer the pairs of a protocol.

    Args:
        weights: of the variant.
        protocol: makes the pairs.
        shapes: held out from training.
        data: what to call them.
        pairs: how many.
        seed: of the pairs, and of the network's own draws.
        points: most sampled points per cloud.
        device: of the network.
        workers: processes, each with one thread; the results do not depend on their number.
        progress: called with (pairs done, pairs in all).

    Raises:
        InputError: no pair can be made of the shapes, or the weights can't be used.
    """
    load_network(str(weights), device)  # here first, so that what can't be used ends the run in one line
    task = partial(_task, weights, device, protocol, shapes, data, seed, points)
    return each(task, pairs, workers, progress)


def _task(
    weights: Path,
    device: str,
    protocol: AnyProtocol,
    shapes: ShapeLibrary,
    data: str,
    seed: int,
    points: int,
) -> Callable[[int], PairResult]:
    """What a worker does once, before it answers pairs by number."""
    return partial(
        answer, load_network(str(weights), device)[0], protocol, shapes, data, seed=seed, points=points
    )


def answer(
    model: Utopic,
    protocol: AnyProtocol,
    shapes: ShapeLibrary,
    data: str,
    number: int,
    *,
    seed: int,
    points: int,
) -> PairResult:
    """Make pair ``number`` and measure a network on it; arguments as for ``measure_variant``.

    Raises:
        InputError: no such pair can be made of the shapes.
    """
    with made_of(data):
        pair = protocol.pair(shapes, seed, number)
    prepared = prepare(pair.source, pair.target, points, clean=protocol.cleans)
    known = known_nodes(prepared, pair.gt_T_target_source, protocol.overlap_radius(prepared))
    view = predict(model, prepared, seed)

    def see(what: PreparedPair) -> NetworkView:
        return view if what is prepared else predict(model, what, seed)

    poses: dict[str, PoseMeasures | None] = {}
    for solver in SOLVERS:
        try:
            look = look_both_sides(see, prepared, solver)
        except InputError:  # no transformation follows from the scores
            poses[solver] = None
            continue
        T = look.prepared.denormalise(look.estimate.T_target_source)
        poses[solver] = _pose(T, pair, protocol)
    if pair.shared is not None:
        poses[FLOOR] = _floor(pair, pair.shared, protocol)
    return PairResult(
        pair=number,
        shape=pair.shape,
        matches=measure_matches(view.matching_scores, known, protocol.inlier_radius(prepared)),
        overlap=measure_overlap(view, known) if model.config.overlap else None,
        poses=poses,
    )


def _pose_from(values: Mapping[str, Any]) -> PoseMeasures:
    triples: dict[str, Any] = {name: tuple(values[name]) for name in ("euler_deg", "axes")}
    return PoseMeasures(**{**values, **triples})


def _floor(pair: ScanPair, shared: np.ndarray, protocol: AnyProtocol) -> PoseMeasures | None:
    """Procrustes on the true correspondences: its error is what the noise alone leaves."""
    source, target = pair.source.points[shared[:, 0]], pair.target.points[shared[:, 1]]
    try:
        return _pose(weighted_procrustes(source, target, np.ones(len(shared))), pair, protocol)
    except ValueError:  # the points in common lie on a line
        return None


def _pose(T: np.ndarray, pair: ScanPair, protocol: AnyProtocol) -> PoseMeasures:
    return measure_pose(T, pair.gt_T_target_source, protocol.unit(pair), centre=protocol.centre(pair))
