"""Candidates for the answer: hypotheses, refined by coarse ICP, verified, and weighed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from utopic_cli.estimation.consensus import Hypothesis, distinct
from utopic_cli.estimation.meeting import Meeting, meet, self_agreement
from utopic_cli.estimation.partners import Coincidence
from utopic_cli.estimation.prior import Prior
from utopic_cli.estimation.problem import Problem, explained
from utopic_cli.estimation.refinement import Stage, refine_coarse
from utopic_cli.estimation.surface import Surface
from utopic_cli.estimation.verification import verify
from utopic_cli.geometry import rigid
from utopic_cli.result import Correspondences

MERGE_DISTANCE = 8.0  # voxels
REFINED = 8  # measured: what ranks lower after screening never turns out best
REFINED_SPARSE = 30  # partners may yet speak for it
APPROACHED = 5
PLAUSIBILITY_WEIGHT = 0.1  # of a log-odds, in voxels
LEAST_LIKENESS = 0.03  # of right ones in 700 trials: .27
FACING = 2.0  # voxels: behind whatever does not
LEAST_SUPPORT = 1e-3  # of the correspondences' weight: less is the same
MOST_TURNING = 0.5  # beyond it, normals contradict each other
MOST_CONFLICT = 0.3
SCREENING = (Stage(5.0, 6, 125), Stage(3.0, 4, 125))
COARSE = (Stage(3.0, 8, 500), Stage(1.2, 8, 500))


@dataclass(frozen=True)
class Candidate:
    """A refined and verified transformation.

    Attributes:
        T_target_source: (4, 4) float64.
        score: fit minus free-space violation.
        fit: share of points with a close neighbour and agreeing normals, mean of both ways.
        violation: share of points that stand where the other scan saw free space.
        origin: ``consensus``, ``assignment`` or ``initial``.
        support: share of the correspondences' weight that it explains.
        meeting: how the surfaces lie on each other; None until it is weighed.
        plausibility: log-odds that it is right, of a verifier that saw it close up; 0 without one.
    """

    T_target_source: np.ndarray
    score: float
    fit: float
    violation: float
    origin: str
    support: float = 0.0
    meeting: Meeting | None = None
    plausibility: float = 0.0

    @property
    def standing(self) -> float:
        """What candidates are ranked by in the end.

        Not the score: it likes a wrong transformation that lays much of one scan roughly on the other
        (a nearly symmetric thing, half a turn off) better than a right one of scans that share little.
        Under the right one the surfaces lie closer where they meet (which says the more the more they
        turn there: flat on flat is always close), more of the correspondences are explained, and hardly
        anything stands where the other scan saw nothing. Scans that meet and agree next to nowhere face each
        other (two sheets with their normals on opposite sides), however closely they lie. A verifier, which
        has seen more than such averages, has the last word.

        Raises:
            ValueError: it was not weighed.
        """
        if self.meeting is None:
            raise ValueError("a candidate has no standing before it is weighed")
        support = np.log10(max(self.support, LEAST_SUPPORT))
        shape = min(self.meeting.turning, MOST_TURNING)
        conflict = min(self.meeting.conflict, MOST_CONFLICT)
        by_surfaces = 0.08 * support - self.meeting.looseness + 0.2 * shape - 0.7 * conflict
        facing = FACING if self.meeting.likeness < LEAST_LIKENESS else 0.0
        return float(by_surfaces - facing + PLAUSIBILITY_WEIGHT * self.plausibility)


def screen(
    hypotheses: list[Hypothesis], source: Surface, target: Surface, *, refine: bool
) -> list[Hypothesis]:
    """Draw each hypothesis into the nearest fit with few points; its score becomes that fit's."""
    transformations = np.stack([hypothesis.T_target_source for hypothesis in hypotheses])
    if refine:
        transformations = refine_coarse(source, target, transformations, SCREENING)
    score = verify(source, target, transformations, samples=500).score
    return [
        Hypothesis(T, float(quick), hypothesis.origin)
        for T, quick, hypothesis in zip(transformations, score, hypotheses, strict=True)
    ]


class CoarseRefinement:
    """Coarse ICP between two surfaces from any transformation, from each but once."""

    def __init__(self, source: Surface, target: Surface, prior: Prior) -> None:
        """Remember the surfaces, and what is known of the transformation beforehand."""
        self.source, self.target, self.prior = source, target, prior
        self._known: dict[bytes, np.ndarray] = {}

    def __call__(self, transformations: np.ndarray) -> np.ndarray:
        """Refine (H, 4, 4) transformations."""
        new = {T.tobytes(): T for T in transformations if T.tobytes() not in self._known}
        if new:
            refined = refine_coarse(self.source, self.target, np.stack(list(new.values())), COARSE)
            self._known.update(zip(new, refined, strict=True))
        return np.stack([self._known[T.tobytes()] for T in transformations])


def refine_candidates(
    problem: Problem, screened: list[Hypothesis], refinement: CoarseRefinement, *, refine: bool
) -> list[Candidate]:
    """Refine (if ``refine``) and verify the best of the screened hypotheses.

    Returns:
        The distinct candidates that the prior admits, best first.
    """
    if not screened:
        return []
    source, target = refinement.source, refinement.target
    screened = sorted(screened, key=lambda hypothesis: -hypothesis.score)
    transformations = np.stack([hypothesis.T_target_source for hypothesis in screened])
    centre = source.points.mean(axis=0)
    apart = MERGE_DISTANCE * target.voxel
    most = REFINED_SPARSE if nodes_are_points(problem) else REFINED
    kept = distinct(transformations, centre, apart / 4, 2.5)[:most]
    transformations, origins = transformations[kept], np.array([screened[i].origin for i in kept])
    if refine:
        transformations = refinement(transformations)
        admitted = refinement.prior.admits(transformations)
        if not admitted.any():
            return []
        transformations, origins = transformations[admitted], origins[admitted]
    candidates = _verified(transformations, origins, source, target)
    kept = distinct(np.stack([candidate.T_target_source for candidate in candidates]), centre, apart)
    return [candidates[i] for i in kept]


def _verified(
    transformations: np.ndarray, origins: np.ndarray, source: Surface, target: Surface
) -> list[Candidate]:
    """Score (H, 4, 4) transformations; best first."""
    verdict = verify(source, target, transformations)
    return [
        Candidate(
            rigid.rigid(rigid.nearest_rotation(transformations[i, :3, :3]), transformations[i, :3, 3]),
            float(verdict.score[i]),
            float(verdict.fit[i]),
            float(verdict.violation[i]),
            str(origins[i]),
        )
        for i in np.argsort(-verdict.score, kind="stable")
    ]


def weigh(
    problem: Problem,
    candidates: list[Candidate],
    correspondences: Correspondences,
    tolerance: float,
    source: Surface,
    target: Surface,
) -> list[Candidate]:
    """Add to each candidate what its standing needs: how the surfaces meet, and support.

    The weights in ``Candidate.standing`` were chosen on the candidates of 667 simulated pairs (sparse
    clouds and range scans of training shapes, rooms, solids), 496 with a right one among them: it comes
    first in 457; by score, share and agreement of what meets, it did in 411.
    """
    total = max(float(correspondences.weights.sum()), 1e-300)
    alike = self_agreement(source, target)
    return [
        replace(
            candidate,
            meeting=meet(source, target, candidate.T_target_source, alike),
            support=float(
                explained(problem, correspondences, candidate.T_target_source, tolerance).weights.sum()
                / total
            ),
        )
        for candidate in candidates
    ]


def nodes_are_points(problem: Problem) -> bool:
    """Tell sparse clouds, used whole, from dense scans, whose nodes are means of many points."""
    return len(problem.source_nodes) >= len(problem.source_dense) and (
        len(problem.target_nodes) >= len(problem.target_dense)
    )


def with_partners(
    problem: Problem, coincidence: Coincidence, transformations: np.ndarray, origins: list[str], prior: Prior
) -> list[Candidate]:
    """Return candidates under which the clouds turn out to share points, fitted to them, best first.

    Usually there is none, and the surfaces decide. Where some are, the coincidence of single
    points is the stronger witness: it tells even symmetric poses apart.

    Args:
        problem: sparse clouds whose nodes are their points.
        coincidence: of the nodes.
        transformations: (H, 4, 4) near which to look.
        origins: where each came from.
        prior: what it does not admit is no candidate.
    """
    fitted, begun = coincidence.meet(transformations, APPROACHED)
    if not len(fitted):
        return []
    source, target = problem.surfaces
    kept = distinct(fitted, source.points.mean(axis=0), MERGE_DISTANCE * target.voxel)
    kept = kept[prior.admits(fitted[kept])]
    return [
        _verified(T[None], np.array([origins[i]]), source, target)[0]
        for T, i in zip(fitted[kept], begun[kept], strict=True)
    ]
