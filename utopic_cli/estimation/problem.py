"""What the network and the preparation say about one pair: the solver's question."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from utopic_cli.estimation.surface import Surface, make_surface, point_spacing
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import Correspondences

VOXELS_PER_SPACING = 2.2


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

    @cached_property
    def surfaces(self) -> tuple[Surface, Surface]:
        """The source's and the target's dense points made ready, at the working voxel."""
        voxel = working_voxel(self.source_dense, self.target_dense, self.spacing)
        return make_surface(self.source_dense, voxel), make_surface(self.target_dense, voxel)


def working_voxel(source: PointCloud, target: PointCloud, spacing: float) -> float:
    """The length v that tolerances are multiples of.

    It is h / 2.2, or the dense points' own spacing where a sparse scan has fewer points than
    that: a neighbour nearer than the spacing cannot be asked for.

    Args:
        source: dense points.
        target: dense points.
        spacing: h, of the nodes.
    """
    return max(spacing / VOXELS_PER_SPACING, point_spacing(source.points), point_spacing(target.points))


def check_problem(problem: Problem) -> None:
    """Make sure that a problem can be solved.

    Raises:
        ValueError: arrays that do not fit together.
    """
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


def explained(
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
