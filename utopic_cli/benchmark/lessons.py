"""Lessons for a verifier: simulated pairs, and what the poses that the solve proposes for them look like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from utopic_cli.benchmark.held_out import made_of
from utopic_cli.benchmark.pair_metrics import SUCCESS, known_nodes, measure_pose
from utopic_cli.benchmark.protocols import AnyProtocol, CropProtocol, RangeProtocol
from utopic_cli.benchmark.trials import trial
from utopic_cli.bridge import gaps, load_network, predict
from utopic_cli.estimation.candidates import Candidate
from utopic_cli.estimation.close_up import close_ups
from utopic_cli.estimation.prior import Prior
from utopic_cli.estimation.problem import Problem
from utopic_cli.estimation.solver import solve
from utopic_cli.geometry import rigid
from utopic_cli.look import problem_of
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import PreparedPair, prepare
from utopic_cli.synthesis.scan_pair import DegeneratePair, ScanPair
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.shapes import ShapeLibrary

MIXTURE: tuple[tuple[float, AnyProtocol], ...] = (
    (0.17, CropProtocol("keep 0.7", 0.7, "independent", "uniform")),
    (0.15, CropProtocol("keep 0.5", 0.5, "independent", "uniform")),
    (0.18, RangeProtocol(bands=((0.1, 0.3),), name="overlap 0.1-0.3")),
    (0.10, RangeProtocol(bands=((0.3, 0.5),), name="overlap 0.3-0.5")),
    (0.03, RangeProtocol(bands=((0.5, 0.9),), name="overlap 0.5-0.9")),
    (
        0.10,
        RangeProtocol(
            replace(PairSettings(), several_views_probability=1.0), ((0.15, 0.6),), "several views"
        ),
    ),
)
"""What the pairs are, with their shares; the rest are ``TRIALS``."""

TRIALS = ("scans", "patch", "sparse", "room", "near-symmetric", "little", "disjoint", "different", "mirrored")
"""Kinds of trials among the lessons: rougher scans, and what is no scan of a shape. Not those where hardly
ever anything tells a right pose from a wrong one, nor what ``MIXTURE`` has."""

DIFFERENT, MIRRORED = 0.10, 0.05
"""Shares of the other pairs that nothing puts right: scans of two shapes, and of a shape and its mirror
image."""

OTHERS = 1_000_000
"""Added to the seed for the second shape."""

POINTS = 1024
OVERLAP_EVERY = 4


@dataclass(frozen=True)
class Lesson:
    """The candidates of one pair.

    Attributes:
        kind: of the pair.
        shape: what was scanned.
        points: (C, P, F) float16, of each candidate's close-up.
        whole: (C, G) float32.
        right: (C,) whether it is right; see ``Question``.
        proposed: (C,) whether the solve came upon it; False for what the known answer is drawn to, which is
            among them where the solve missed it.
        by_surfaces: (C,) its standing by the surfaces alone.
        gap: (N,) how far the pair's points are from the other scan under a right pose (not by symmetry)
            that was proposed, in node spacings; empty without one, and but for every fourth pair.
        overlaps: (N,) whether they overlap; empty but for every fourth pair.
    """

    kind: str
    shape: str
    points: np.ndarray
    whole: np.ndarray
    right: np.ndarray
    proposed: np.ndarray
    by_surfaces: np.ndarray
    gap: np.ndarray
    overlaps: np.ndarray


@dataclass(frozen=True)
class Question:
    """A pair to solve.

    Attributes:
        kind: of the pair.
        shape: what was scanned.
        source: the scan that moves.
        target: the scan that stays.
        answer: (4, 4) T_target_source; None where nothing puts the pair right.
        right: tells whether a (4, 4) answer is right, or, except in a trial, as good by symmetry.
        scans: whether scattered points are left out first, as of scans.
        radius: called with the prepared pair: points nearer than this overlap, normalised units.
    """

    kind: str
    shape: str
    source: PointCloud
    target: PointCloud
    answer: np.ndarray | None
    right: Callable[[np.ndarray], bool]
    scans: bool
    radius: Callable[[PreparedPair], float]


def lesson_of(weights: str, shapes: ShapeLibrary, data: str, seed: int, number: int) -> Lesson | None:
    """Make pair ``number`` and solve it; None where there is none, nothing follows, or points decide.

    Args:
        weights: as of ``load_network``.
        shapes: to make pairs of.
        data: what to call them.
        seed: names the set of pairs.
        number: from 0.

    Raises:
        InputError: no such pair can be made of the shapes.
    """
    with made_of(data):
        question = question_of(shapes, seed, number)
    if question is None:
        return None
    prepared = prepare(question.source, question.target, POINTS, clean=question.scans)
    model = load_network(weights, "cpu", verifier=False)[0]
    view = predict(model, prepared, 0)
    problem = problem_of(prepared, view)
    try:
        estimate = solve(problem)
    except ValueError:
        return None
    if estimate.shared_points:
        return None
    proposals = candidates = [estimate.best, *estimate.rivals]
    right = [question.right(prepared.denormalise(each.T_target_source)) for each in candidates]
    proposed = [True] * len(candidates)
    if question.answer is not None and not any(right):
        missed = _missed(problem, prepared, question)
        candidates = [*candidates, *missed]
        right += [True] * len(missed)
        proposed += [False] * len(missed)
    gap, overlaps = np.zeros(0), np.zeros(0, bool)
    if number % OVERLAP_EVERY == 0:
        overlaps = _overlaps(prepared, question)
        known = next((each for each in proposals if _as_known(prepared, each, question)), None)
        if known is not None:
            gap = np.concatenate(gaps(prepared, known.T_target_source))
    shown = close_ups(problem, candidates)
    return Lesson(
        question.kind,
        question.shape,
        np.stack([one.points for one in shown]).astype(np.float16),
        np.stack([one.whole for one in shown]),
        np.array(right),
        np.array(proposed),
        np.array([each.standing for each in candidates]),
        gap.astype(np.float32),
        overlaps,
    )


def _as_known(prepared: PreparedPair, candidate: Candidate, question: Question) -> bool:
    """Tell whether a candidate is right, and not by symmetry: overlap is known of the known answer."""
    T = prepared.denormalise(candidate.T_target_source)
    return (
        question.answer is not None
        and question.right(T)
        and rigid.relative_rotation_error_deg(T, question.answer) < SUCCESS[0]
    )


def _overlaps(prepared: PreparedPair, question: Question) -> np.ndarray:
    """Tell which sampled points of both scans overlap (N,): none, where nothing puts the pair right."""
    if question.answer is None:
        return np.zeros(len(prepared.source.points) + len(prepared.target.points), bool)
    known = known_nodes(prepared, question.answer, question.radius(prepared))
    return np.concatenate([known.source_overlap, known.target_overlap])


def _missed(problem: Problem, prepared: PreparedPair, question: Question) -> list[Candidate]:
    """Return what the known answer is drawn to, if that is right: what the solve ought to have proposed."""
    assert question.answer is not None
    told = solve(problem, prior=Prior(prepared.normalise(question.answer)))
    found = [each for each in (told.best, *told.rivals) if each.origin == "initial"]
    return [each for each in found if question.right(prepared.denormalise(each.T_target_source))]


def question_of(shapes: ShapeLibrary, seed: int, number: int) -> Question | None:
    """Make pair ``number``; it depends on the arguments alone.

    Returns:
        The pair; None where it is to be a trial, and the shapes make none of its kind.

    Raises:
        DegeneratePair: no such pair can be made of the shapes.
    """
    rng = np.random.default_rng([seed, number, 1])  # other draws than those that choose the shape
    place = int(np.searchsorted(np.cumsum([share for share, _ in MIXTURE]), rng.random(), side="right"))
    if place == len(MIXTURE):
        return _trial(shapes, seed, number)
    protocol = MIXTURE[place][1]
    pair = protocol.pair(shapes, seed, number)
    draw = rng.random()
    if draw < DIFFERENT:
        other = protocol.pair(shapes, seed + OTHERS, number)
        return _question("different", protocol, replace(pair, target=other.target), solvable=False)
    if draw < DIFFERENT + MIRRORED:
        mirror = np.ones(3)
        mirror[rng.integers(3)] = -1.0
        mirrored = replace(pair, source=PointCloud(pair.source.points * mirror))
        return _question("mirrored", protocol, mirrored, solvable=False)
    return _question(protocol.name, protocol, pair, solvable=True)


def _trial(shapes: ShapeLibrary, seed: int, number: int) -> Question | None:
    try:
        one = trial(shapes, seed, number, TRIALS)
    except DegeneratePair:  # two like shapes, say, or only symmetric ones
        return None
    radius = MIXTURE[-1][1].overlap_radius  # as of any scans
    return Question(
        one.kind, one.shape, one.source, one.target, one.gt_T_target_source, one.right, True, radius
    )


def _question(kind: str, protocol: AnyProtocol, pair: ScanPair, *, solvable: bool) -> Question:
    def right(T: np.ndarray) -> bool:
        measured = measure_pose(
            T,
            pair.gt_T_target_source,
            protocol.unit(pair),
            centre=protocol.centre(pair),
            object_points=pair.object_points,
            extent=pair.extent,
        )
        return solvable and measured.symmetric

    answer = pair.gt_T_target_source if solvable else None
    shape, radius = str(pair.shape), protocol.overlap_radius
    return Question(kind, shape, pair.source, pair.target, answer, right, protocol.cleans, radius)
