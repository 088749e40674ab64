"""From two raw clouds to what the network sees, and back: one frame, one scale, one density.

Both clouds of a pair are centred, divided by one common scale, and sampled with one common
node spacing h (see ``frame``); the dense scan around each sampled point is kept as its local
geometry. Training and inference share this file, so what the network is shown never differs
between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.frame import DENSE_RATIO, FEWEST_DENSE_POINTS, Frame, find_frame
from utopic_cli.geometry.nearest import nearest
from utopic_cli.geometry.normals import estimate_normals, orient_normals, orient_towards
from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.geometry.voxel import cell_means, voxel_downsample, voxel_index
from utopic_cli.point_cloud import PointCloud

NEIGHBOURS = 20
"""Graph neighbours kept per sampled point; the network takes the first k of its setting."""

PATCHES = ((1.8, 32), (3.6, 24), (7.2, 24))
"""Radius in node spacings and number of points of the three local-geometry patches."""

NORMAL_SOFTNESS = 1.5
"""Standard deviation, in gaps between dense points, of the Gaussian by which neighbours count for a normal.

Of 30 pairs of sparse clouds with jitter the normals are 17 degrees off on average so, 21 where all within
3 voxels count alike; of 30 pairs of range scans 14 and 15."""


@dataclass(frozen=True)
class SampledCloud:
    """One cloud of a pair in normalised units.

    Attributes:
        points: (N, 3) float64 sampled points (nodes).
        normals: (N, 3) float64 oriented unit normals of the nodes.
        neighbours: (N, k) int64 nearest nodes, nearest first.
        patches: three arrays (N, K, 6) float32: offset over radius, neighbour's normal.
        patch_masks: three arrays (N, K) bool.
        dense: the dense cloud with oriented normals, for estimation.
        node_index: (N,) int64 original point nearest to each node.
    """

    points: np.ndarray
    normals: np.ndarray
    neighbours: np.ndarray
    patches: tuple[np.ndarray, ...]
    patch_masks: tuple[np.ndarray, ...]
    dense: PointCloud
    node_index: np.ndarray

    def turned_inside_out(self) -> SampledCloud:
        """Return the cloud with every normal reversed."""
        patches = tuple(np.concatenate([patch[..., :3], -patch[..., 3:]], axis=2) for patch in self.patches)
        dense = PointCloud(self.dense.points, -_normals_of(self.dense))
        return replace(self, normals=-self.normals, patches=patches, dense=dense)

    def rotated(self, rotation: np.ndarray) -> SampledCloud:
        """Return the cloud turned about the origin by a (3, 3) rotation."""
        halves = ((patch[..., :3] @ rotation.T, patch[..., 3:] @ rotation.T) for patch in self.patches)
        return replace(
            self,
            points=self.points @ rotation.T,
            normals=self.normals @ rotation.T,
            patches=tuple(np.concatenate(pair, axis=2).astype(np.float32) for pair in halves),
            dense=PointCloud(self.dense.points @ rotation.T, _normals_of(self.dense) @ rotation.T),
        )

    @property
    def outwardness(self) -> float:
        """How clearly the normals point away from the centroid, in [-1, 1]; near 0 for a flat sheet."""
        offset = self.dense.points - self.dense.points.mean(axis=0)
        height = np.einsum("nd,nd->n", _normals_of(self.dense), offset)
        return float(height.sum() / max(np.linalg.norm(offset, axis=1).sum(), 1e-12))


@dataclass(frozen=True)
class PreparedPair:
    """Two clouds ready for the network, and the way back to file units.

    Attributes:
        source: sampled source; ``normalised = (p - source_centre) / scale``.
        target: sampled target; ``normalised = (p - target_centre) / scale``.
        source_centre: (3,) file units; mean of the points that are not astray.
        target_centre: (3,) file units, likewise.
        scale: file units per normalised unit.
        spacing: node spacing h in normalised units.
    """

    source: SampledCloud
    target: SampledCloud
    source_centre: np.ndarray
    target_centre: np.ndarray
    scale: float
    spacing: float

    def denormalise(self, transformation: np.ndarray) -> np.ndarray:
        """Take a (4, 4) transformation between normalised clouds to file units."""
        result = transformation.copy()
        rotation = transformation[:3, :3]
        result[:3, 3] = (
            self.scale * transformation[:3, 3] + self.target_centre - rotation @ self.source_centre
        )
        return result

    def normalise(self, transformation: np.ndarray) -> np.ndarray:
        """Take a (4, 4) transformation in file units to the normalised clouds."""
        result = transformation.copy()
        rotation = transformation[:3, :3]
        result[:3, 3] = (
            transformation[:3, 3] - self.target_centre + rotation @ self.source_centre
        ) / self.scale
        return result


def prepare(
    source: PointCloud,
    target: PointCloud,
    points: int,
    *,
    source_viewpoint: np.ndarray | None = None,
    target_viewpoint: np.ndarray | None = None,
    clean: bool = False,
    resampled: np.random.Generator | None = None,
) -> PreparedPair:
    """Centre, scale and sample a pair.

    Args:
        source: points in file units.
        target: points in file units.
        points: most sampled points per cloud.
        source_viewpoint: (3,) where the scanner stood, in the source's own frame, if known:
            normals then face it, which is faster than propagating signs.
        target_viewpoint: likewise for the target.
        clean: leave scattered points out of the sampling where a scan has many of them.
        resampled: draws another sampling of the same scans: turned grids, and of scans so sparse
            that all their points are sampled, nine in ten. What follows from a sampling alone
            then differs; what follows from the surfaces stays.

    Raises:
        InputError: one scan is so much smaller than the other that nothing of it is left at a
            spacing that suits both.
    """
    frame = find_frame(source, target, points, clean=clean)
    return sample_pair(
        frame, source_viewpoint=source_viewpoint, target_viewpoint=target_viewpoint, resampled=resampled
    )


def sample_pair(
    frame: Frame,
    *,
    source_viewpoint: np.ndarray | None = None,
    target_viewpoint: np.ndarray | None = None,
    resampled: np.random.Generator | None = None,
) -> PreparedPair:
    """Sample both scans of a pair as often as need be; arguments are those of ``prepare``."""
    parts, most = frame.parts, frame.most
    viewpoints = [
        None if view is None else (view - centre) / frame.scale
        for view, centre in zip((source_viewpoint, target_viewpoint), frame.centres, strict=True)
    ]
    grids = [None if resampled is None else random_rotation(resampled) for _ in parts]
    if resampled is not None:
        parts = tuple(_nine_in_ten(part, most, resampled) for part in parts)
    sampled = [
        sample(part, frame.spacing, most, viewpoint=view, grid=grid)
        for part, view, grid in zip(parts, viewpoints, grids, strict=True)
    ]
    source, target = (
        replace(cloud, node_index=tree.query(cloud.points)[1])
        for cloud, tree in zip(sampled, frame.trees, strict=True)
    )
    return PreparedPair(source, target, *frame.centres, frame.scale, frame.spacing)


def sample(
    points: np.ndarray,
    spacing: float,
    most: int,
    *,
    viewpoint: np.ndarray | None = None,
    grid: np.ndarray | None = None,
) -> SampledCloud:
    """Sample nodes of one normalised cloud and collect the local geometry around them.

    Args:
        points: (P, 3) normalised points.
        spacing: node spacing h.
        most: a cloud of no more points than this keeps every point as a node.
        viewpoint: (3,) scanner position in the same frame, or None.
        grid: (3, 3) rotation from the points' frame to that of the voxel grids, or None.
    """
    if grid is not None:
        aligned = sample(
            points @ grid.T, spacing, most, viewpoint=None if viewpoint is None else grid @ viewpoint
        )
        return aligned.rotated(grid.T)
    dense, _ = voxel_downsample(points, spacing / DENSE_RATIO)
    tree = cKDTree(dense)
    normals = estimate_normals(dense, softness=NORMAL_SOFTNESS * _gap(dense, tree), tree=tree)
    if viewpoint is None:
        normals = orient_normals(dense, normals)
    else:
        normals = orient_towards(dense, normals, viewpoint)

    owner, count = voxel_index(dense, spacing)
    nodes, node_normals = cell_means(dense, owner, count), _cell_normals(normals, owner, count)
    middle = (nodes, node_normals)
    if len(points) <= most:
        # Sparse clouds are used whole; each point takes the normal of the dense point it fell in.
        nodes = np.unique(points, axis=0)
        node_normals = normals[tree.query(nodes)[1]]
    owner, count = voxel_index(dense, 2.0 * spacing)
    coarse = (cell_means(dense, owner, count), _cell_normals(normals, owner, count))

    k = min(NEIGHBOURS + 1, len(nodes))
    neighbours = cKDTree(nodes).query(nodes, k=k)[1][:, 1:]
    patches, masks = [], []
    for (cloud, cloud_normals), (reach, size) in zip(
        ((dense, normals), middle, coarse), PATCHES, strict=True
    ):
        patch, mask = _patch(nodes, cloud, cloud_normals, reach * spacing, size)
        patches.append(patch)
        masks.append(mask)
    return SampledCloud(
        points=nodes,
        normals=node_normals,
        neighbours=neighbours,
        patches=tuple(patches),
        patch_masks=tuple(masks),
        dense=PointCloud(dense, normals),
        node_index=np.empty(0, dtype=np.int64),
    )


def _gap(points: np.ndarray, tree: cKDTree) -> float:
    """Median distance of (P, 3) points to their nearest neighbours; infinity for a single point."""
    return float(np.median(tree.query(points, k=2)[0][:, 1]))


def _nine_in_ten(points: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    if len(points) > most:
        return points
    return points[np.sort(rng.permutation(len(points))[: max(FEWEST_DENSE_POINTS, round(0.9 * len(points)))])]


def carry_to_all(points: np.ndarray, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Carry values at nodes to every point: inverse-distance mean over the three nearest nodes.

    Args:
        points: (P, 3), same frame as the nodes.
        nodes: (N, 3).
        values: (N, C).

    Returns:
        (P, C) float32.
    """
    k = min(3, len(nodes))
    distance, index = nearest(cKDTree(nodes), points, range(1, k + 1))
    weight = 1.0 / (distance.reshape(len(points), k) ** 2 + 1e-12)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("pk,pkc->pc", weight, values[index.reshape(len(points), k)]).astype(np.float32)


def _cell_normals(normals: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    mean = cell_means(normals, owner, count)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    first = np.zeros(count, dtype=np.int64)
    first[owner] = np.arange(len(owner))
    return np.where(length > 1e-3, mean / np.maximum(length, 1e-3), normals[first])


def _patch(
    nodes: np.ndarray, cloud: np.ndarray, normals: np.ndarray, radius: float, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Take every second of the 2 * size nearest points within the radius: even cover, half the cost."""
    nearest = range(1, min(2 * size, len(cloud)) + 1)  # a range: the answer has a column even for one
    distance, index = cKDTree(cloud).query(nodes, k=nearest, distance_upper_bound=radius)
    distance, index = distance[:, ::2], index[:, ::2]
    mask = np.isfinite(distance)
    index = np.where(mask, index, 0)
    patch = np.concatenate([(cloud[index] - nodes[:, None]) / radius, normals[index]], axis=2)
    patch[~mask] = 0.0
    missing = size - patch.shape[1]
    if missing > 0:
        patch = np.pad(patch, ((0, 0), (0, missing), (0, 0)))
        mask = np.pad(mask, ((0, 0), (0, missing)))
    return patch.astype(np.float32), mask


def _normals_of(cloud: PointCloud) -> np.ndarray:
    assert cloud.normals is not None  # every dense cloud is made with them
    return cloud.normals
