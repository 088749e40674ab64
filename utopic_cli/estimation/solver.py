"""The robust solve: hypotheses from the network's scores, refined, verified, the best returned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from utopic_cli.estimation.candidates import (
    PLAUSIBILITY_WEIGHT,
    Candidate,
    CoarseRefinement,
    nodes_are_points,
    refine_candidates,
    screen,
    weigh,
    with_partners,
)
from utopic_cli.estimation.close_up import CloseUp, close_ups
from utopic_cli.estimation.consensus import Hypothesis, consensus_hypotheses, distinct
from utopic_cli.estimation.constellation import alike
from utopic_cli.estimation.correspondences import (
    candidate_correspondences,
    linear_assignment,
    overlap_weights,
)
from utopic_cli.estimation.partners import Coincidence
from utopic_cli.estimation.prior import ANYWHERE, Prior
from utopic_cli.estimation.problem import Problem, check_problem, explained
from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.result import Correspondences

CONSENSUS_TOLERANCE = 2.5  # voxels
PARTNERS_TOLERANCE = 2.0  # reaches
ALIKE = 1000  # pairs of points that look alike which are asked
PROPOSED = 200
FIRST = 40  # tried first; the rest only where none of these fits beyond doubt
BEYOND_DOUBT = 0.5  # score
RIVALS = 5
VERIFIED = 8  # best candidates that are looked at closely
DECIDED = 3.0  # log-odds by which a verifier that is sure prefers the answer: 20 to 1
SURE = 5.0  # log-odds of an answer that rests on shared points
SAME_PLACE = 0.15  # of the source's radius: what two samplings' answers to one question may differ by


@dataclass(frozen=True)
class Estimate:
    """The answer of ``solve``.

    Attributes:
        best: the answer.
        rivals: distinct runners-up, best first.
        hypotheses: how many transformations were tried.
        correspondences: node pairs the answer rests on: those it explains within the
            tolerance (``svd``: all of the assignment), with their weights.
        method: ``svd`` or ``consensus``, and for ``auto`` where the answer came from:
            ``assignment``, ``consensus`` or ``initial``.
        shared_points: whether the clouds turned out to share points, and the answer rests on
            them: stronger evidence than any score.
    """

    best: Candidate
    rivals: tuple[Candidate, ...]
    hypotheses: int
    correspondences: Correspondences
    method: str
    shared_points: bool = False

    @property
    def T_target_source(self) -> np.ndarray:
        """The answer (4, 4) float64."""
        return self.best.T_target_source

    @property
    def score(self) -> float:
        """The answer's fit minus free-space violation, at most 1."""
        return self.best.score

    @property
    def odds(self) -> float:
        """Log-odds that the answer is right, as far as the solve can tell.

        ``SURE`` where it rests on shared points, else of the verifier; 0 where none was asked.
        """
        return SURE if self.shared_points else self.best.plausibility

    @property
    def support(self) -> float:
        """Share of the correspondences' weight that the answer explains."""
        return self.best.support

    @property
    def margin(self) -> float:
        """By how much the answer's standing exceeds that of its best rival, in [0, 1]; 1 without any."""
        rival = max((rival.standing for rival in self.rivals), default=-np.inf)
        return float(np.clip(self.best.standing - rival, 0.0, 1.0))

    def lag(self, rival: Candidate) -> float:
        """By how much a rival's standing lags behind the answer's.

        Where the verifier prefers the answer but is not sure of it, by the surfaces alone: of the poses of a
        symmetric thing it prefers some one, too.
        """
        preferred = self.best.plausibility - rival.plausibility
        unsure = 0.0 < preferred < DECIDED
        excused = PLAUSIBILITY_WEIGHT * preferred if unsure else 0.0
        return self.best.standing - rival.standing - excused

    def outranks(self, other: Estimate) -> bool:
        """Tell whether more speaks for this estimate than for another one of the same scans."""
        return (self.shared_points, self.best.standing) > (other.shared_points, other.best.standing)

    def with_rivals(self, other: Estimate, points: np.ndarray) -> Estimate:
        """Return this estimate with another one of the same scans, and its rivals, among its rivals.

        Args:
            other: in the same frame.
            points: (N, 3) of the source; transformations that put them nearly alike are one.
        """
        rivals = sorted((*self.rivals, other.best, *other.rivals), key=lambda rival: -rival.standing)
        transformations = np.stack([self.T_target_source, *(rival.T_target_source for rival in rivals)])
        size = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
        kept = distinct(transformations, points.mean(axis=0), SAME_PLACE * size)[1 : RIVALS + 1]
        return replace(self, rivals=tuple(rivals[i - 1] for i in kept))


def solve(
    problem: Problem,
    solver: str = "auto",
    prior: Prior = ANYWHERE,
    verify: Callable[[Sequence[CloseUp]], np.ndarray] | None = None,
) -> Estimate:
    """Find the transformation of one pair.

    Args:
        problem: what is known about the pair.
        solver: ``svd`` is the paper's: linear assignment and overlap-weighted Procrustes,
            nothing after it. ``consensus`` tries the transformations that many
            correspondences agree on. ``auto`` tries both. Except for ``svd``, every
            hypothesis is refined by coarse ICP, and verification chooses.
        prior: what is known beforehand: a transformation to try as well (with ``svd``: the better of
            the two), and how far the source may be turned; what is turned farther is no candidate.
        verify: log-odds (C,) that candidates seen close up are right, or None: then the surfaces decide.

    Returns:
        The best transformation with its rivals. The same input gives the same output.

    Raises:
        ValueError: an unknown solver, arrays that do not fit together, or scores from which no
            transformation follows that the prior admits.
    """
    if solver not in ("auto", "svd", "consensus"):
        raise ValueError(f"unknown solver {solver!r}; expected auto, svd or consensus")
    check_problem(problem)
    source, target = problem.surfaces
    voxel = target.voxel
    candidates = _weighted_candidates(problem)
    hypotheses: list[Hypothesis] = []
    if prior.initial is not None:
        hypotheses.append(Hypothesis(np.asarray(prior.initial, np.float64), np.inf, "initial"))
    if solver != "consensus":
        hypotheses += _assignment_hypothesis(problem)
    if solver != "svd":
        hypotheses += _consensus(problem, candidates, CONSENSUS_TOLERANCE * voxel, prior)
    hypotheses = _admitted(hypotheses, prior)
    if not hypotheses:
        raise ValueError(_nothing(prior))
    refine = solver != "svd"
    shared = _SharedPoints(problem, prior) if refine and nodes_are_points(problem) else None
    partners = shared.near(hypotheses[:FIRST], candidates) if shared is not None else []
    tried = min(FIRST, len(hypotheses))
    if partners:
        chosen = partners
    else:
        chosen, tried = _refined(problem, hypotheses, prior, refine=refine)
        partners = shared.near(list(map(_as_hypothesis, chosen))) if shared is not None else []
        chosen = partners or chosen
    if not chosen:  # all were drawn beyond what is admitted
        raise ValueError(_nothing(prior))
    correspondences = candidates
    if solver == "svd" and chosen[0].origin == "assignment":
        correspondences = _assignment(problem)
    tolerance = CONSENSUS_TOLERANCE * voxel
    chosen = weigh(problem, chosen, correspondences, tolerance, source, target)
    if refine and not partners:
        chosen.sort(key=lambda candidate: -candidate.standing)
        if verify is not None:
            chosen = _verified(problem, chosen[:VERIFIED], verify)
    best = chosen[0]
    return Estimate(
        best=best,
        rivals=tuple(chosen[1 : RIVALS + 1]),
        hypotheses=tried,
        correspondences=correspondences
        if solver == "svd"
        else explained(problem, correspondences, best.T_target_source, tolerance),
        method=best.origin if solver == "auto" else solver,
        shared_points=bool(partners),
    )


def _refined(
    problem: Problem, hypotheses: list[Hypothesis], prior: Prior, *, refine: bool
) -> tuple[list[Candidate], int]:
    """Screen, refine and verify hypotheses, no more of them than are needed.

    Returns:
        The candidates, best first, and how many hypotheses were tried.
    """
    source, target = problem.surfaces
    refinement = CoarseRefinement(source, target, prior)
    tried = min(FIRST, len(hypotheses))
    screened = _admitted(screen(hypotheses[:tried], source, target, refine=refine), prior)
    chosen = refine_candidates(problem, screened, refinement, refine=refine)
    if tried < len(hypotheses) and (not chosen or chosen[0].score < BEYOND_DOUBT):
        screened += _admitted(screen(hypotheses[tried:], source, target, refine=refine), prior)
        tried = len(hypotheses)
        chosen = refine_candidates(problem, screened, refinement, refine=refine)
    return chosen, tried


class _SharedPoints:
    """Looks for transformations under which sparse clouds turn out to share points."""

    def __init__(self, problem: Problem, prior: Prior) -> None:
        self.problem, self.prior = problem, prior
        self.coincidence = Coincidence(problem.source_nodes, problem.target_nodes)

    def near(
        self, hypotheses: list[Hypothesis], correspondences: Correspondences | None = None
    ) -> list[Candidate]:
        """Return what shares points near hypotheses, or else near what points agree on that look alike.

        Partners match exactly, which hypotheses about surfaces don't ask for. In grids all points look alike:
        there the correspondences have to do.
        """
        found = self._near(hypotheses)
        reach = self.coincidence.reach
        if not found and correspondences is not None and reach > 0:
            tolerance = PARTNERS_TOLERANCE * reach
            if self.coincidence.regular:
                closely = _consensus(self.problem, correspondences, tolerance, self.prior, FIRST)
            else:
                closely = self._agreeing(tolerance)
            found = self._near(closely)
        return found

    def _agreeing(self, tolerance: float) -> list[Hypothesis]:
        """Propose what points that look alike agree on; without normals, whose sides are guessed."""
        source, target = self.problem.source_nodes, self.problem.target_nodes
        pairs = candidate_correspondences(alike(source, target, 2.0 * self.coincidence.reach), limit=ALIKE)
        if len(pairs) < 3:
            return []
        ours, theirs = source[pairs.source_indices], target[pairs.target_indices]
        return consensus_hypotheses(ours, theirs, pairs.weights, tolerance, FIRST, prior=self.prior)

    def _near(self, hypotheses: list[Hypothesis]) -> list[Candidate]:
        if not hypotheses:
            return []
        transformations = np.stack([hypothesis.T_target_source for hypothesis in hypotheses])
        origins = [hypothesis.origin for hypothesis in hypotheses]
        return with_partners(self.problem, self.coincidence, transformations, origins, self.prior)


def _as_hypothesis(candidate: Candidate) -> Hypothesis:
    return Hypothesis(candidate.T_target_source, candidate.score, candidate.origin)


def _verified(
    problem: Problem, candidates: list[Candidate], verify: Callable[[Sequence[CloseUp]], np.ndarray]
) -> list[Candidate]:
    odds = verify(close_ups(problem, candidates))
    seen = [replace(each, plausibility=float(one)) for each, one in zip(candidates, odds, strict=True)]
    return sorted(seen, key=lambda candidate: -candidate.standing)


def _admitted(hypotheses: list[Hypothesis], prior: Prior) -> list[Hypothesis]:
    if not hypotheses:
        return []
    admitted = prior.admits(np.stack([hypothesis.T_target_source for hypothesis in hypotheses]))
    return [hypothesis for hypothesis, kept in zip(hypotheses, admitted, strict=True) if kept]


def _nothing(prior: Prior) -> str:
    if not prior.bounded:
        return "no transformation follows from the matching scores"
    return (
        f"nothing that turns the source by {prior.max_rotation:g} degrees at most follows from the matching "
        "scores; allow more"
    )


def _assignment(problem: Problem) -> Correspondences:
    """The paper's hard correspondences with their overlap weights w_ij.

    Where fewer than three points keep half their mass (an unsure network on a hard pair),
    every row and column takes part.
    """
    for minimum_mass in (0.5, 0.0):
        pairs = linear_assignment(problem.matching_scores, minimum_mass)
        if len(pairs) >= 3:
            break
    return overlap_weights(pairs, problem.source_overlap, problem.target_overlap)


def _assignment_hypothesis(problem: Problem) -> list[Hypothesis]:
    pairs = _assignment(problem)
    source = problem.source_nodes[pairs.source_indices]
    target = problem.target_nodes[pairs.target_indices]
    try:
        T = weighted_procrustes(source, target, pairs.weights)
    except ValueError:  # too few or all on a line: other hypotheses may answer all the same
        return []
    return [Hypothesis(T, 0.0, "assignment")]


def _weighted_candidates(problem: Problem) -> Correspondences:
    """Candidate pairs, believed less where the network sees no overlap or is unsure.

    The factors never reach zero: an overlap prediction that is wrong must not be able to
    remove the right pairs.
    """
    source = (0.2 + 0.8 * problem.source_overlap) * (0.5 + 0.5 * problem.source_certainty)
    target = (0.2 + 0.8 * problem.target_overlap) * (0.5 + 0.5 * problem.target_certainty)
    return candidate_correspondences(problem.matching_scores * source[:, None] * target)


def _consensus(
    problem: Problem, candidates: Correspondences, tolerance: float, prior: Prior, most: int = PROPOSED
) -> list[Hypothesis]:
    if len(candidates) < 3:
        return []
    source, target = problem.surfaces
    source_nodes = problem.source_nodes[candidates.source_indices]
    target_nodes = problem.target_nodes[candidates.target_indices]
    return consensus_hypotheses(
        source_nodes,
        target_nodes,
        candidates.weights,
        tolerance,
        most,
        source.normals[source.tree.query(source_nodes)[1]],
        target.normals[target.tree.query(target_nodes)[1]],
        prior,
    )
