"""Answers of every method to one synthetic pair, measured."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from utopic_cli.benchmark.contestants import Contestants
from utopic_cli.benchmark.matcher import Matcher
from utopic_cli.benchmark.method import Method, Trial, checked, refined
from utopic_cli.benchmark.metrics import pair_extent
from utopic_cli.benchmark.pair_metrics import (
    KnownNodes,
    MatchMeasures,
    OverlapMeasures,
    PoseMeasures,
    known_nodes,
    measure_matches,
    measure_overlap,
    measure_pose,
)
from utopic_cli.benchmark.protocols import AnyProtocol
from utopic_cli.benchmark.speed_clock import cpu_seconds_so_far
from utopic_cli.benchmark.uncertainty import UncertaintyByPlace, measure_uncertainty
from utopic_cli.bridge import NetworkView
from utopic_cli.errors import InputError
from utopic_cli.estimation.prior import ANYWHERE, Prior
from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.estimation.refinement import refine
from utopic_cli.look import Look, look_both_sides
from utopic_cli.preprocess import PreparedPair, prepare

if TYPE_CHECKING:
    from collections.abc import Iterator

    from utopic_cli.synthesis.pairs import ScanPair

SOLVED, REFINED, FLOOR = "solved", "refined", "floor"


@dataclass(frozen=True)
class Answer:
    """One method's answer to one pair at one stage.

    Attributes:
        pair: number of the pair.
        group: group of the table it belongs to.
        shape: name of the shape.
        overlap: overlap ratio of the smaller side.
        extent: of the whole object, in the points' unit.
        method: name of the matcher or the method, or ``floor``.
        stage: ``solved`` (matches and one robust solve, or the method's own answer), ``refined`` (after
            refinement at full resolution), or ``floor`` (Procrustes on the true correspondences).
        gt_T_target_source: (4, 4) the known answer.
        T_target_source: (4, 4) the answer, or None.
        pose: how far it is off, or None.
        matches: of the view that the answer rests on; None for the floor and for methods.
        first_overlap: overlap told without a transformation; None from who tells none.
        final_overlap: overlap told from the answer, weighed with the solve's odds that it is right.
        first_uncertainty: raw uncertainty by place at the first look; None from who tells no overlap.
        final_uncertainty: the same when shown the answer.
        score: the solver's score of it.
        cpu_seconds: by step: look, solve, refine, look_again; of a method: method, refine.
        message: what was raised where there is no answer.
    """

    pair: int
    group: str
    shape: str | None
    overlap: float
    extent: float
    method: str
    stage: str
    gt_T_target_source: np.ndarray
    T_target_source: np.ndarray | None = None
    pose: PoseMeasures | None = None
    matches: MatchMeasures | None = None
    first_overlap: OverlapMeasures | None = None
    final_overlap: OverlapMeasures | None = None
    first_uncertainty: UncertaintyByPlace | None = None
    final_uncertainty: UncertaintyByPlace | None = None
    score: float | None = None
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    message: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready data."""
        content = asdict(self)
        for name in ("gt_T_target_source", "T_target_source"):
            content[name] = None if content[name] is None else content[name].tolist()
        return content


def answer_pair(
    pair: ScanPair,
    number: int,
    protocol: AnyProtocol,
    contestants: Contestants,
    points: int,
    seed: int = 0,
    prior: Prior = ANYWHERE,
) -> list[Answer]:
    """Ask everybody for a transformation, and measure it before and after refinement.

    Args:
        pair: with a sample of the whole object.
        number: of the pair in its protocol.
        protocol: says in which units errors are counted.
        contestants: who is asked.
        points: most sampled points per cloud.
        seed: of the draws of methods, together with ``number``.
        prior: what the robust solve is told beforehand.
    """
    prepared = prepare(pair.source, pair.target, points, clean=protocol.cleans)
    desk = _Desk(pair, number, protocol, prepared, prior)
    answers = [] if pair.shared is None else [desk.floor(pair.shared)]
    for matcher in contestants.matchers:
        answers += desk.ask(matcher)
    for method in contestants.methods:
        answers += desk.consult(method, seed)
    return answers


class _Desk:
    """One pair and everything that is known about it."""

    def __init__(
        self, pair: ScanPair, number: int, protocol: AnyProtocol, prepared: PreparedPair, prior: Prior
    ) -> None:
        self._pair, self._protocol, self._prepared, self._prior = pair, protocol, prepared, prior
        self._about: dict[str, Any] = {
            "pair": number,
            "group": protocol.group(number),
            "shape": pair.shape,
            "overlap": pair.smaller_overlap,
            "extent": pair.extent,
            "gt_T_target_source": pair.gt_T_target_source,
        }
        # Turning a cloud inside out moves no node, so this holds whatever the solve does.
        self._known: KnownNodes = known_nodes(
            prepared, pair.gt_T_target_source, protocol.overlap_radius(prepared)
        )

    def floor(self, shared: np.ndarray) -> Answer:
        """Procrustes on the true correspondences: its error is what the noise alone leaves."""
        source, target = self._pair.source.points[shared[:, 0]], self._pair.target.points[shared[:, 1]]
        try:
            T = weighted_procrustes(source, target, np.ones(len(shared)))
        except ValueError as error:
            return Answer(**self._about, method=FLOOR, stage=FLOOR, message=str(error))
        return Answer(**self._about, method=FLOOR, stage=FLOOR, T_target_source=T, pose=self._pose(T))

    def ask(self, matcher: Matcher) -> list[Answer]:
        """Return the answers ``solved`` and ``refined``."""
        seconds: dict[str, float] = {}
        try:
            with _cpu(seconds, "solve"):
                look = look_both_sides(partial(_look, matcher, seconds), self._prepared, prior=self._prior)
            seconds["solve"] -= seconds["look"]
        except InputError as error:  # no transformation follows from the scores
            return self._lost(matcher.name, seconds, str(error))
        T = look.prepared.denormalise(look.estimate.T_target_source)
        refining = dict(seconds)
        with _cpu(refining, "refine"):
            T_refined = refine(self._pair.source, self._pair.target, T).T_target_source
        return [
            self._answer(matcher, look, T, SOLVED, seconds),
            self._answer(matcher, look, T_refined, REFINED, refining),
        ]

    def consult(self, method: Method, seed: int) -> list[Answer]:
        """Return the answers ``solved`` (the method's own) and ``refined`` of a whole method."""
        source, target = self._pair.source, self._pair.target
        own_seed = int(np.random.default_rng([seed, self._about["pair"], 2]).integers(2**31))
        trial = Trial(source, target, pair_extent(source, target), own_seed)
        seconds: dict[str, float] = {}
        try:
            with _cpu(seconds, "method"):
                T = checked(method.estimate(trial))
        except Exception as raised:  # whatever a method does wrong is a failure of that method
            message = " ".join(f"{type(raised).__name__}: {raised}".splitlines())
            return self._lost(method.name, seconds, message)
        refining = dict(seconds)
        with _cpu(refining, "refine"):
            T_refined = refined(trial, T)
        return [
            Answer(
                **self._about,
                method=method.name,
                stage=stage,
                T_target_source=one,
                pose=self._pose(one),
                cpu_seconds=spent,
            )
            for stage, one, spent in ((SOLVED, T, seconds), (REFINED, T_refined, refining))
        ]

    def _lost(self, name: str, seconds: dict[str, float], message: str) -> list[Answer]:
        return [
            Answer(**self._about, method=name, stage=stage, cpu_seconds=seconds, message=message)
            for stage in (SOLVED, REFINED)
        ]

    def _answer(
        self, matcher: Matcher, look: Look, T: np.ndarray, stage: str, seconds: dict[str, float]
    ) -> Answer:
        told: dict[str, Any] = {}
        if matcher.tells_overlap:
            again = look.view
            if matcher.looks_again:
                with _cpu(seconds, "look_again"):
                    normalised = look.prepared.normalise(T)
                    odds = look.estimate.odds
                    again = matcher.look_again(look.prepared, look.view, normalised, odds)
            for name, view in (("first", look.view), ("final", again)):
                told[f"{name}_overlap"] = measure_overlap(view, self._known)
                told[f"{name}_uncertainty"] = measure_uncertainty(look.prepared, view, self._known)
        inlier_radius = self._protocol.inlier_radius(look.prepared)
        return Answer(
            **self._about,
            method=matcher.name,
            stage=stage,
            T_target_source=T,
            pose=self._pose(T),
            matches=measure_matches(look.view.matching_scores, self._known, inlier_radius),
            **told,
            score=look.estimate.score,
            cpu_seconds=seconds,
        )

    def _pose(self, T: np.ndarray) -> PoseMeasures:
        return measure_pose(
            T,
            self._pair.gt_T_target_source,
            self._protocol.unit(self._pair),
            centre=self._protocol.centre(self._pair),
            object_points=self._pair.object_points,
            extent=self._pair.extent,
        )


def _look(matcher: Matcher, seconds: dict[str, float], prepared: PreparedPair) -> NetworkView:
    with _cpu(seconds, "look"):
        return matcher.look(prepared)


@contextmanager
def _cpu(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Add the CPU time of the block, of all threads and processes."""
    begin = cpu_seconds_so_far()
    try:
        yield
    finally:
        seconds[step] = seconds.get(step, 0.0) + cpu_seconds_so_far() - begin
