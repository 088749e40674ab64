"""Point-to-plane ICP: many hypotheses at once on thinned scans, then one at full resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.estimation.partners import Coincidence
from utopic_cli.estimation.surface import Surface, point_spacing, thinned
from utopic_cli.geometry import rigid
from utopic_cli.geometry.nearest import nearest
from utopic_cli.geometry.normals import estimate_normals
from utopic_cli.point_cloud import PointCloud

SURFACE_NEIGHBOURS = 20
ITERATIONS = 12
DAMPING = 1e-4
COARSE_DAMPING = 1e-2
"""Where few or noisy points hardly fix a motion, what the start says of it is better than what they say."""

NO_WORSE = 0.01
"""A mean residual larger by this share, of itself or of what it is short of nothing meeting, is no worse:
noise decides, and the robust fit is the better guess."""

MOST_PARTNERS = 5_000
"""Clouds of more points than this are not asked whether they share points: dense surfaces fix a
pose as well."""


@dataclass(frozen=True)
class Stage:
    """One round of coarse ICP.

    Attributes:
        radius: partners farther than this many voxels are ignored.
        iterations: most steps.
        samples: points of each scan used.
    """

    radius: float
    iterations: int
    samples: int


@dataclass(frozen=True)
class Refinement:
    """The outcome of a refinement at full resolution.

    Attributes:
        T_target_source: (4, 4) float64, the refined transformation, or the one given.
        residual: mean truncated distance between the surfaces, both ways, in the points'
            units, at ``T_target_source``.
        initial_residual: the same at the transformation given.
        improved: whether the refined transformation was kept.
        threshold: distance at which the residual is truncated (no counterpart).
    """

    T_target_source: np.ndarray
    residual: float
    initial_residual: float
    improved: bool
    threshold: float


def refine_coarse(
    source: Surface, target: Surface, transformations: np.ndarray, stages: tuple[Stage, ...]
) -> np.ndarray:
    """Run symmetric ICP from H transformations at once.

    Partners are nearest points of the other scan, both ways, within the stage's radius, whose normals point
    the same way; nearer ones weigh more. What is made small is their distance along the mean of both
    normals: the noise of two normals cancels in part, and of a curved surface the error is of higher order
    than with one. A hypothesis stops when its steps become tiny.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformations: (H, 4, 4) start values.
        stages: rounds, coarse to fine.

    Returns:
        (H, 4, 4) refined transformations, in the same order.
    """
    current = transformations.copy()
    for stage in stages:
        of_source, of_target = (
            surface.sample[:: max(1, len(surface.sample) // stage.samples)] for surface in (source, target)
        )
        radius = stage.radius * target.voxel
        moving = np.arange(len(current))
        for _ in range(stage.iterations):
            if not len(moving):
                break
            step, size = _coarse_step(source, target, of_source, of_target, current[moving], radius)
            current[moving] = step @ current[moving]
            moving = moving[size > 0.02 * target.voxel]
    return current


def _coarse_step(
    source: Surface,
    target: Surface,
    source_sample: np.ndarray,
    target_sample: np.ndarray,
    transformations: np.ndarray,
    radius: float,
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step for (H, 4, 4) -> (H, 4, 4) increments and their (H,) sizes."""
    rotations = transformations[:, :3, :3]
    shifts = transformations[:, None, :3, 3]
    points, normals = source.points[source_sample], source.normals[source_sample]
    there, weight_there = _partners(
        points @ rotations.transpose(0, 2, 1) + shifts, normals @ rotations.transpose(0, 2, 1), target, radius
    )
    fixed, fixed_normals = target.points[target_sample], target.normals[target_sample]
    here, weight_here = _partners((fixed - shifts) @ rotations, fixed_normals @ rotations, source, radius)
    # Every pair once more, as (moved point, fixed point) with their normals: (H, 2 S, 3).
    index = np.concatenate([np.broadcast_to(source_sample, there.shape), here], axis=1)
    moved = source.points[index] @ rotations.transpose(0, 2, 1) + shifts
    turned = source.normals[index] @ rotations.transpose(0, 2, 1)
    index = np.concatenate([there, np.broadcast_to(target_sample, here.shape)], axis=1)
    plane = turned + target.normals[index]
    plane /= np.maximum(np.linalg.norm(plane, axis=2, keepdims=True), 1e-300)
    offset = np.einsum("hsd,hsd->hs", target.points[index] - moved, plane)
    centre = moved.mean(axis=1, keepdims=True)
    jacobian = np.concatenate([np.cross(moved - centre, plane), plane], axis=2)  # (H, 2 S, 6)
    weight = np.concatenate([weight_there, weight_here], axis=1)
    return _solve_step(jacobian, weight, offset, centre[:, 0], COARSE_DAMPING)


def _partners(
    points: np.ndarray, normals: np.ndarray, fixed: Surface, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find the partners of (H, S, 3) points -> (H, S) rows of the surface and weights, 0 for none."""
    distance, index = nearest(fixed.tree, points, within=radius)
    index = np.minimum(index, len(fixed.points) - 1)  # "none" is len(points)
    agree = np.einsum("hsd,hsd->hs", normals, fixed.normals[index])
    near = np.isfinite(distance) & (agree > 0.5)
    return index, np.where(near, 1.0 - (np.where(near, distance, 0.0) / radius) ** 2, 0.0)


def _solve_step(
    jacobian: np.ndarray, weight: np.ndarray, offset: np.ndarray, centre: np.ndarray, damp: float = DAMPING
) -> tuple[np.ndarray, np.ndarray]:
    """Solve B weighted point-to-plane problems.

    Args:
        jacobian: (B, S, 6), rotation about ``centre`` first, then translation.
        weight: (B, S).
        offset: (B, S) signed distance to the partner's plane.
        centre: (B, 3).
        damp: how much is added to the normal matrix, in proportion to it.

    Returns:
        increments: (B, 4, 4) rigid.
        size: (B,) largest displacement it causes at the points' typical distance from the centre.
    """
    weighted = (jacobian * weight[..., None]).transpose(0, 2, 1)
    normal_matrix = weighted @ jacobian  # (B, 6, 6)
    right = (weighted @ offset[..., None])[..., 0]
    # Sliding directions of a plane or cylinder have no gradient: a little damping, scaled to
    # each unknown's unit (lengths squared for rotation), keeps them still.
    spread = np.sqrt(np.maximum(np.einsum("bsd,bsd->b", jacobian[..., :3], jacobian[..., :3]), 1e-300))
    spread /= np.sqrt(jacobian.shape[1])
    total = np.maximum(weight.sum(axis=1), 1e-12)
    damping = np.repeat(np.stack([spread**2 * total, total], axis=1), 3, axis=1)  # (B, 6)
    normal_matrix[:, np.arange(6), np.arange(6)] += damp * damping
    solution = np.linalg.solve(normal_matrix, right[..., None])[..., 0]  # (B, 6)
    solution[np.count_nonzero(weight, axis=1) < 6] = 0.0
    rotation = _rotations(solution[:, :3])
    increments = np.zeros((len(solution), 4, 4))
    increments[:, :3, :3] = rotation
    increments[:, :3, 3] = centre + solution[:, 3:] - np.einsum("bij,bj->bi", rotation, centre)
    increments[:, 3, 3] = 1.0
    size = np.linalg.norm(solution[:, :3], axis=1) * spread + np.linalg.norm(solution[:, 3:], axis=1)
    return increments, size


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotation matrices (B, 3, 3) of rotation vectors (B, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)
    axis = vectors / np.maximum(angle, 1e-300)[:, None]
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    cross -= cross.transpose(0, 2, 1)
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def refine(
    source: PointCloud,
    target: PointCloud,
    T: np.ndarray,
    *,
    radius: float | None = None,
    limit: int = 50_000,
    trees: tuple[cKDTree, cKDTree] | None = None,
) -> Refinement:
    """Refine one transformation at full resolution, and keep it unless the fit becomes worse.

    Symmetric point-to-plane ICP: distances are measured along the mean of both normals. The
    search radius shrinks from ``radius`` to a few times the points' own spacing, following the
    spread of the residuals; partners that lie beside the target's border (far along the
    surface) are dropped, so that parts seen by one scan only do not pull. Where small clouds
    turn out to share points (see ``partners``), a fit to those follows: planes through noisy
    points would only spoil it.

    Args:
        source: (N, 3) all points of the scan that moves; its normals are not needed.
        target: (M, 3) all points of the scan that stays.
        T: (4, 4) T_target_source to start from, right to within ``radius``.
        radius: first search radius in the points' units; 12 times the spacing if None.
        limit: most points used of each scan; larger ones are thinned evenly.
        trees: of all points of source and target, if there are any already.

    Returns:
        The refined transformation, or the given one where that fits better, with its residual; for clouds
        that share points, the fit to those, whatever its residual.

    Raises:
        ValueError: fewer than six points, points that all coincide, or ``T`` is not rigid.
    """
    if min(len(source), len(target)) < 6:
        raise ValueError("refinement needs at least six points in each cloud")
    if not rigid.is_rigid(T):
        raise ValueError("the transformation to refine is not rigid")
    moving, fixed = (
        _FullSurface(thinned(cloud.points, limit), tree if len(cloud) <= limit else None)
        for cloud, tree in zip((source, target), trees or (None, None), strict=True)
    )
    spacing = max(fixed.spacing, moving.spacing)
    if not spacing > 0:
        raise ValueError("the points all coincide")
    finest = 3.0 * spacing
    reach = max(radius if radius is not None else 4.0 * finest, finest)
    current = T
    while True:
        current = _descend(moving, fixed, current, reach)
        if reach <= finest:
            break
        reach = max(reach / 2.0, finest)
    threshold = max(finest, min(radius, 2.0 * finest) if radius is not None else 2.0 * finest)
    before = _residual(moving, fixed, T, threshold)
    after = _residual(moving, fixed, current, threshold)
    fitted = _fit_partners(moving, fixed, np.stack([T, current]))
    if fitted is not None:
        return Refinement(fitted, _residual(moving, fixed, fitted, threshold), before, True, threshold)
    kept = bool(after < before + NO_WORSE * min(before, threshold - before))
    return Refinement(current if kept else T, after if kept else before, before, kept, threshold)


class _FullSurface:
    """A cloud at full resolution with the spacing and the normals found from its own points."""

    def __init__(self, points: np.ndarray, tree: cKDTree | None) -> None:
        self.points = points
        self.tree = cKDTree(points) if tree is None else tree
        self.spacing = point_spacing(points, self.tree)
        self._normals = np.empty_like(points)
        self._known = np.zeros(len(points), dtype=bool)

    def normals_at(self, rows: np.ndarray) -> np.ndarray:
        """Normals (K, 3) of arbitrary sign at (K,) rows, found when first asked for.

        Of scans that share little, most points never meet the other scan.
        """
        missing = np.zeros(len(self.points), dtype=bool)
        missing[rows] = True
        missing = np.flatnonzero(missing & ~self._known)
        self._normals[missing] = estimate_normals(self.points, SURFACE_NEIGHBOURS, tree=self.tree, at=missing)
        self._known[missing] = True
        return self._normals[rows]


def _fit_partners(
    moving: _FullSurface, fixed: _FullSurface, transformations: np.ndarray
) -> np.ndarray | None:
    """Fit to shared points from the best of (H, 4, 4) transformations; None if there are none."""
    if max(len(moving.points), len(fixed.points)) > MOST_PARTNERS:
        return None
    coincidence = Coincidence(moving.points, fixed.points)
    evidence = coincidence.evidence(transformations)
    if not evidence.max() > coincidence.enough:
        return None
    return coincidence.fit(transformations[evidence.argmax()])


def _descend(moving: _FullSurface, fixed: _FullSurface, T: np.ndarray, reach: float) -> np.ndarray:
    """Symmetric point-to-plane ICP within one search radius."""
    spacing = max(fixed.spacing, moving.spacing)
    # Coarse rounds need no more than a few thousand points.
    stride = max(1, int(len(moving.points) * min(1.0, (reach / (3.0 * spacing) - 1.0) / 4.0) / 4000))
    rows = np.arange(0, len(moving.points), stride)
    points = moving.points[rows]
    for _ in range(ITERATIONS):
        moved = rigid.apply(T, points)
        distance, index = nearest(fixed.tree, moved, within=reach)
        near = np.flatnonzero(np.isfinite(distance))
        if len(near) < 6:
            return T
        plane = fixed.normals_at(index[near])
        turned = moving.normals_at(rows[near]) @ T[:3, :3].T
        agreement = np.einsum("nd,nd->n", turned, plane)
        offset = fixed.points[index[near]] - moved[near]
        mean = plane + np.where(agreement < 0, -1.0, 1.0)[:, None] * turned  # signs are arbitrary here
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        along = np.einsum("nd,nd->n", offset, mean)
        beside = np.linalg.norm(offset - along[:, None] * mean, axis=1)
        usable = (np.abs(agreement) > 0.7) & (beside < max(1.5 * spacing, 0.3 * reach))
        if np.count_nonzero(usable) < 6:
            return T
        along, mean, anchor = along[usable], mean[usable], moved[near][usable]
        scale = max(1.4826 * float(np.median(np.abs(along))), 1e-3 * spacing)
        weight = np.maximum(1.0 - (along / (4.0 * scale)) ** 2, 0.0) ** 2  # Tukey's biweight
        centre = anchor.mean(axis=0)
        jacobian = np.concatenate([np.cross(anchor - centre, mean), mean], axis=1)
        step, size = _solve_step(jacobian[None], weight[None], along[None], centre[None])
        T = step[0] @ T
        if size[0] < 1e-3 * spacing:
            break
    return rigid.rigid(rigid.nearest_rotation(T[:3, :3]), T[:3, 3])


def _residual(moving: _FullSurface, fixed: _FullSurface, T: np.ndarray, threshold: float) -> float:
    """Mean point-to-plane distance, both ways, truncated where there is no counterpart."""
    forward = _one_way(rigid.apply(T, moving.points), fixed, threshold)
    backward = _one_way(rigid.apply(rigid.invert(T), fixed.points), moving, threshold)
    return (forward + backward) / 2.0


def _one_way(points: np.ndarray, surface: _FullSurface, threshold: float) -> float:
    points = thinned(points, 20_000)
    distance, index = nearest(surface.tree, points, within=threshold)
    near = np.isfinite(distance)
    residual = np.full(len(distance), threshold)
    offset = surface.points[index[near]] - points[near]
    residual[near] = np.abs(np.einsum("nd,nd->n", offset, surface.normals_at(index[near])))
    return float(residual.mean())
