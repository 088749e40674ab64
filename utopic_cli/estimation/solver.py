"""The robust solve: hypotheses from the network's scores, refined, verified, the best returned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.estimation.consensus import Hypothesis, consensus_hypotheses, distinct
from utopic_cli.estimation.correspondences import (
    candidate_correspondences,
    linear_assignment,
    overlap_weights,
)
from utopic_cli.estimation.partners import (
    BEYOND_CHANCE,
    approach_partners,
    fit_partners,
    partner_evidence,
    partner_reach,
)
from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.estimation.refinement import Stage, refine_coarse
from utopic_cli.estimation.surface import Surface, make_surface, point_spacing
from utopic_cli.estimation.verification import verify
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import Correspondences

VOXELS_PER_SPACING = 2.2
CONSENSUS_TOLERANCE = 2.5  # voxels
MERGE_DISTANCE = 8.0  # voxels
PROPOSED = 200
FIRST = 40  # tried first; the rest only where none of these fits beyond doubt
BEYOND_DOUBT = 0.5  # score
REFINED = 8  # measured: what ranks lower after screening never turns out best
REFINED_SPARSE = 30  # partners may yet speak for it
APPROACHED = 3
RIVALS = 5
SCREENING = (Stage(5.0, 6, 250), Stage(3.0, 4, 250))
COARSE = (Stage(3.0, 8, 1000), Stage(1.2, 8, 1000))


@dataclass(frozen=True)
class Problem:
    """What the network and the preparation say about one pair.

    All lengths are in one common frame unit; nodes and dense points of a scan share a frame.

    Attributes:
        source_nodes: (N, 3) float64.
        target_nodes: (M, 3) float64.
        matching_scores: (N, M) in [0, 1], Sinkhorn output without slack.
        source_overlap: (N,) probability of lying in the overlap.
        target_overlap: (M,) likewise.
        source_certainty: (N,) in [0, 1], 1 = certain.
        target_certainty: (M,) likewise.
        source_dense: dense points with oriented normals, one a voxel of h / 2.2.
        target_dense: likewise.
        spacing: h, the spacing of the nodes.
    """

    source_nodes: np.ndarray
    target_nodes: np.ndarray
    matching_scores: np.ndarray
    source_overlap: np.ndarray
    target_overlap: np.ndarray
    source_certainty: np.ndarray
    target_certainty: np.ndarray
    source_dense: PointCloud
    target_dense: PointCloud
    spacing: float


@dataclass(frozen=True)
class Candidate:
    """A refined and verified transformation.

    Attributes:
        T_target_source: (4, 4) float64.
        score: fit minus free-space violation.
        fit: share of points with a close neighbour and agreeing normals, mean of both ways.
        violation: share of points that stand where the other scan saw free space.
        origin: ``consensus``, ``assignment`` or ``initial``.
    """

    T_target_source: np.ndarray
    score: float
    fit: float
    violation: float
    origin: str


@dataclass(frozen=True)
class Estimate:
    """The answer of ``solve``.

    Attributes:
        T_target_source: (4, 4) float64.
        score: fit minus free-space violation, at most 1; comparable between solvers.
        fit: see ``Candidate``.
        violation: see ``Candidate``.
        rivals: distinct runners-up, best first.
        hypotheses: how many transformations were tried.
        correspondences: node pairs the answer rests on: those it explains within the
            tolerance (``svd``: all of the assignment), with their weights.
        support: share of the candidates' weight that the answer explains.
        method: ``svd`` or ``consensus``, and for ``auto`` where the answer came from:
            ``assignment``, ``consensus`` or ``initial``.
        shared_points: whether the clouds turned out to share points, and the answer rests on
            them: stronger evidence than any score.
    """

    T_target_source: np.ndarray
    score: float
    fit: float
    violation: float
    rivals: tuple[Candidate, ...]
    hypotheses: int
    correspondences: Correspondences
    support: float
    method: str
    shared_points: bool = False

    def outranks(self, other: Estimate) -> bool:
        """Tell whether more speaks for this estimate than for another one of the same scans."""
        return (self.shared_points, self.score) > (other.shared_points, other.score)


def solve(problem: Problem, solver: str = "auto", initial: np.ndarray | None = None) -> Estimate:
    """Find the transformation of one pair.

    Args:
        problem: what is known about the pair.
        solver: ``svd`` is the paper's: linear assignment and overlap-weighted Procrustes,
            nothing after it. ``consensus`` tries the transformations that many
            correspondences agree on. ``auto`` tries both. Except for ``svd``, every
            hypothesis is refined by coarse ICP, and verification chooses.
        initial: (4, 4) T_target_source to try as well (with ``svd``: the better of the two).

    Returns:
        The best transformation with its rivals. The same input gives the same output.

    Raises:
        ValueError: an unknown solver, arrays that do not fit together, an initial
            transformation that is not rigid, or scores from which no transformation follows.
    """
    if solver not in ("auto", "svd", "consensus"):
        raise ValueError(f"unknown solver {solver!r}; expected auto, svd or consensus")
    _check(problem, initial)
    voxel = working_voxel(problem)
    source, target = make_surface(problem.source_dense, voxel), make_surface(problem.target_dense, voxel)
    candidates = _weighted_candidates(problem)
    hypotheses: list[Hypothesis] = []
    if initial is not None:
        hypotheses.append(Hypothesis(np.asarray(initial, np.float64), np.inf, "initial"))
    if solver != "consensus":
        hypotheses += _assignment_hypothesis(problem)
    if solver != "svd":
        hypotheses += _consensus(problem, candidates, source, target, voxel)
    if not hypotheses:
        raise ValueError("no transformation follows from the matching scores")
    refine = solver != "svd"
    tried = min(FIRST, len(hypotheses))
    screened = _screened(hypotheses[:tried], source, target, refine=refine)
    chosen, partners = _refined(problem, screened, source, target, refine=refine)
    if not partners and chosen[0].score < BEYOND_DOUBT and tried < len(hypotheses):
        screened += _screened(hypotheses[tried:], source, target, refine=refine)
        tried = len(hypotheses)
        chosen, partners = _refined(problem, screened, source, target, refine=refine)
    chosen = partners or chosen
    best = chosen[0]
    if solver == "svd" and best.origin == "assignment":
        correspondences = _assignment(problem)
    else:
        correspondences = candidates
    explained = _explained(problem, correspondences, best.T_target_source, CONSENSUS_TOLERANCE * voxel)
    total = correspondences.weights.sum()
    support = float(explained.weights.sum() / total) if total > 0 else 0.0
    return Estimate(
        T_target_source=best.T_target_source,
        score=best.score,
        fit=best.fit,
        violation=best.violation,
        rivals=tuple(chosen[1 : RIVALS + 1]),
        hypotheses=tried,
        correspondences=correspondences if solver == "svd" else explained,
        support=support,
        method=best.origin if solver == "auto" else solver,
        shared_points=bool(partners),
    )


def working_voxel(problem: Problem) -> float:
    """The length v that tolerances are multiples of.

    It is h / 2.2, or the dense points' own spacing where a sparse scan has fewer points than
    that: a neighbour nearer than the spacing cannot be asked for.
    """
    dense = max(point_spacing(problem.source_dense.points), point_spacing(problem.target_dense.points))
    return max(problem.spacing / VOXELS_PER_SPACING, dense)


def _check(problem: Problem, initial: np.ndarray | None) -> None:
    n, m = len(problem.source_nodes), len(problem.target_nodes)
    if min(n, m) < 3:
        raise ValueError("a transformation needs at least three nodes in each scan")
    if problem.matching_scores.shape != (n, m):
        raise ValueError(f"matching scores of shape {problem.matching_scores.shape}; expected {(n, m)}")
    for name, count in (
        ("source_overlap", n),
        ("source_certainty", n),
        ("target_overlap", m),
        ("target_certainty", m),
    ):
        if getattr(problem, name).shape != (count,):
            raise ValueError(f"{name} of shape {getattr(problem, name).shape}; expected {(count,)}")
    if not problem.spacing > 0:
        raise ValueError(f"spacing {problem.spacing} is not positive")
    if initial is not None and not rigid.is_rigid(np.asarray(initial)):
        raise ValueError("the initial transformation is not rigid")


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
    problem: Problem, candidates: Correspondences, source: Surface, target: Surface, voxel: float
) -> list[Hypothesis]:
    if len(candidates) < 3:
        return []
    source_nodes = problem.source_nodes[candidates.source_indices]
    target_nodes = problem.target_nodes[candidates.target_indices]
    return consensus_hypotheses(
        source_nodes,
        target_nodes,
        candidates.weights,
        CONSENSUS_TOLERANCE * voxel,
        PROPOSED,
        source.normals[source.tree.query(source_nodes)[1]],
        target.normals[target.tree.query(target_nodes)[1]],
    )


def _screened(
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


def _refined(
    problem: Problem, screened: list[Hypothesis], source: Surface, target: Surface, *, refine: bool
) -> tuple[list[Candidate], list[Candidate]]:
    """Refine and verify the best of the screened hypotheses.

    Returns:
        The distinct candidates, best first, and those of them whose points have partners.
    """
    screened = sorted(screened, key=lambda hypothesis: -hypothesis.score)
    transformations = np.stack([hypothesis.T_target_source for hypothesis in screened])
    centre = source.points.mean(axis=0)
    apart = MERGE_DISTANCE * target.voxel
    most = REFINED_SPARSE if _nodes_are_points(problem) else REFINED
    kept = distinct(transformations, centre, apart / 4, 2.5)[:most]
    transformations, origins = transformations[kept], np.array([screened[i].origin for i in kept])
    if refine:
        transformations = refine_coarse(source, target, transformations, COARSE)
    candidates = _verified(transformations, origins, source, target)
    kept = distinct(np.stack([candidate.T_target_source for candidate in candidates]), centre, apart)
    candidates = [candidates[i] for i in kept]
    return candidates, _with_partners(problem, candidates, source, target) if refine else []


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


def _nodes_are_points(problem: Problem) -> bool:
    """Tell sparse clouds, used whole, from dense scans, whose nodes are means of many points."""
    return len(problem.source_nodes) >= len(problem.source_dense) and (
        len(problem.target_nodes) >= len(problem.target_dense)
    )


def _with_partners(
    problem: Problem, candidates: list[Candidate], source: Surface, target: Surface
) -> list[Candidate]:
    """Return the candidates under which the clouds turn out to share points, refitted to them.

    Usually none is left, and the surfaces decide. Where some are, the coincidence of single
    points is the stronger witness: it tells even symmetric poses apart.
    """
    nodes = problem.source_nodes, problem.target_nodes
    reach = partner_reach(*nodes) if _nodes_are_points(problem) else 0.0
    if not reach > 0:
        return []
    evidence = partner_evidence(*nodes, np.stack([each.T_target_source for each in candidates]), reach)
    candidates = [candidates[i] for i in np.argsort(-evidence, kind="stable")[:APPROACHED]]
    approached = np.stack([approach_partners(*nodes, each.T_target_source, reach) for each in candidates])
    evidence = partner_evidence(*nodes, approached, reach)
    order = [i for i in np.argsort(-evidence, kind="stable") if evidence[i] > BEYOND_CHANCE]
    fitted = [fit_partners(*nodes, approached[i], reach) for i in order]
    return [
        _verified(T[None], np.array([candidates[i].origin]), source, target)[0]
        for i, T in zip(order, fitted, strict=True)
    ]


def _explained(
    problem: Problem, correspondences: Correspondences, T: np.ndarray, tolerance: float
) -> Correspondences:
    """The correspondences whose moved source node lies within tolerance of its partner."""
    moved = rigid.apply(T, problem.source_nodes[correspondences.source_indices])
    distance = np.linalg.norm(moved - problem.target_nodes[correspondences.target_indices], axis=1)
    near = distance <= tolerance
    return Correspondences(
        correspondences.source_indices[near],
        correspondences.target_indices[near],
        correspondences.weights[near],
    )
