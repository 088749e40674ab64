"""From raw pairs to what the network sees: the batched ``preprocess``.

Clouds stand in one row, source and target of a pair next to each other: cloud 2 b is the source
of pair b, cloud 2 b + 1 its target.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from utopic_cli.frame import DENSE_RATIO
from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.preprocess import NORMAL_SOFTNESS, PATCHES
from utopic_cli.training.batched.draws import Draws, unit
from utopic_cli.training.batched.normals import NEIGHBOURS, faced, guessed_signs, plane_normals
from utopic_cli.training.batched.ragged import (
    DISTANCES,
    group_means,
    masked_quantile,
    product,
    squared_distances,
    to_rows,
    turned,
)
from utopic_cli.training.batched.raw_pairs import RawPairs
from utopic_cli.training.batched.voxels import Voxels, common_spacing, near, rows_of, voxelised

NORMAL_REACH = 6.0  # in cells of the dense cloud: of sparse clouds, too, 30 neighbours are nearer
KNOWN_SIDE = 0.5
"""Share of pairs whose normals face the scanner where it is known; see ``training.data.sample_pair``."""


@dataclass(frozen=True)
class FlatClouds:
    """All points of C clouds in normalised units, one cloud after the other.

    Attributes:
        points: (T, 3) float32.
        towards: (T, 3) a direction on the visible side of the surface at each point.
        cloud: (T,) int64, ascending.
        one_side: (C,) bool, whether the cloud was seen from one side only.
    """

    points: Tensor
    towards: Tensor
    cloud: Tensor
    one_side: Tensor


@dataclass(frozen=True)
class DenseClouds:
    """The dense clouds that patches and ICP are taken from.

    Attributes:
        voxels: one mean a cell.
        normals: (K, 3) oriented unit normals of the means.
        spacing: (C,) node spacing h.
    """

    voxels: Voxels
    normals: Tensor
    spacing: Tensor


def moved_apart(pairs: RawPairs) -> tuple[FlatClouds, Tensor]:
    """Turn both clouds of each pair into frames of their own, centre them and bring them to one scale.

    A translation would be undone by the centring, so none is drawn.

    Returns:
        The clouds, and the known answers (B, 4, 4) between them.
    """
    count, width = len(pairs.points), pairs.points.shape[2]
    points, mask = pairs.points.view(2 * count, width, 3), pairs.mask.view(2 * count, width)
    rotation = pairs.rotation.view(2 * count, 3, 3)
    cloud = mask.nonzero()[:, 0]
    centre = group_means(points[mask], cloud, 2 * count)
    radius = (points - centre[:, None]).norm(dim=2)
    scale = masked_quantile(radius, mask, 0.99).view(count, 2).amax(dim=1)
    flat = (points[mask] - centre[cloud]) / scale.repeat_interleave(2)[cloud, None]
    own = rotation[cloud]
    clouds = FlatClouds(
        turned(flat[:, None], own)[:, 0],
        turned(pairs.towards.view(2 * count, width, 3)[mask][:, None], own)[:, 0],
        cloud,
        pairs.one_side.view(-1),
    )
    both = rotation.view(count, 2, 3, 3)
    gt = torch.eye(4, device=points.device).repeat(count, 1, 1)
    gt[:, :3, :3] = product(both[:, 1], both[:, 0].transpose(1, 2))
    apart = (centre.view(count, 2, 3)[:, 0] - centre.view(count, 2, 3)[:, 1]) / scale[:, None]
    gt[:, :3, 3] = turned(apart[:, None], both[:, 1])[:, 0]
    return clouds, gt


def dense_clouds(clouds: FlatClouds, points: int, draws: Draws) -> DenseClouds:
    """Thin clouds to the dense level and give them oriented normals.

    Args:
        clouds: C clouds.
        points: most nodes per cloud.
        draws: draws the pairs whose normals face the scanner; for the others signs are guessed.
    """
    count = len(clouds.one_side)
    spacing = common_spacing(clouds.points, clouds.cloud, count, points).repeat_interleave(2)
    voxels = voxelised(clouds.points, clouds.cloud, spacing / DENSE_RATIO)
    distance, index = near(voxels.means, voxels.cloud, voxels, NORMAL_REACH, NEIGHBOURS)
    rows, mask = to_rows(distance[:, 1:2], voxels.cloud, count, int(torch.bincount(voxels.cloud).max()))
    gap = masked_quantile(rows[..., 0], mask & rows[..., 0].isfinite(), 0.5)
    normals = plane_normals(voxels.means, distance, index, NORMAL_SOFTNESS * gap[voxels.cloud], draws)
    normals = faced(normals, group_means(clouds.towards, voxels.owner, len(voxels.keys)))
    known = draws.chance(KNOWN_SIDE, count // 2).repeat_interleave(2) & clouds.one_side
    sign = guessed_signs(voxels.means, normals, distance, index, voxels.cloud, count, ~known)
    return DenseClouds(voxels, normals * sign[:, None], spacing)


def sampled(clouds: FlatClouds, dense: DenseClouds, points: int, neighbours: int) -> CloudInput:
    """Sample nodes and collect the local geometry around them; see ``preprocess.sample``.

    Args:
        clouds: C clouds.
        dense: their dense level.
        points: rows per cloud; the nodes come first. (The spacing leaves at most about this many;
            a node too many, which is rare, is left out.)
        neighbours: k of the network's graph.

    Returns:
        A batch of C clouds.
    """
    count, spacing = len(dense.spacing), dense.spacing
    middle, middle_normals = _level(dense, spacing)
    coarse, coarse_normals = _level(dense, 2.0 * spacing)
    sparse = torch.bincount(clouds.cloud, minlength=count) <= points
    every, every_mask = to_rows(clouds.points, clouds.cloud, count, points)
    nodes, valid = rows_of(middle.means, middle, points)
    node_normals = rows_of(middle_normals, middle, points)[0]
    nodes = torch.where(sparse[:, None, None], every, nodes)
    valid = torch.where(sparse[:, None], every_mask, valid)
    row = valid.nonzero()[:, 0]
    reach, size = PATCHES[0]
    distance, index = near(nodes[valid], row, dense.voxels, reach * DENSE_RATIO, 2 * size)
    # Sparse clouds are used whole; each point takes the normal of the nearest dense point.
    nearest = torch.zeros_like(nodes)
    nearest[valid] = dense.normals[index[:, 0]]
    node_normals = torch.where(sparse[:, None, None], nearest, node_normals)
    patch, mask = _patch(
        nodes[valid], distance, dense.voxels.means[index], dense.normals[index], reach * spacing[row]
    )
    patches = [nodes.new_zeros(count, points, size, 6)]
    masks = [torch.zeros(count, points, size, dtype=torch.bool, device=nodes.device)]
    patches[0][valid], masks[0][valid] = patch, mask
    for (level, normals), (reach, size) in zip(
        ((middle, middle_normals), (coarse, coarse_normals)), PATCHES[1:], strict=True
    ):
        there, there_mask = rows_of(torch.cat([level.means, normals], dim=1), level)
        distance, index = _nearest(nodes, there[..., :3], there_mask, 2 * size)
        radius = reach * spacing
        distance = torch.where(valid[..., None] & (distance < radius[:, None, None]), distance, torch.inf)
        found = _rows(there, index)
        patch, mask = _patch(
            nodes, distance, found[..., :3], found[..., 3:], radius[:, None].expand(-1, points)
        )
        missing = size - patch.shape[2]
        patches.append(torch.nn.functional.pad(patch, (0, 0, 0, missing)))
        masks.append(torch.nn.functional.pad(mask, (0, missing)))
    graph = _graph(nodes, valid, neighbours)
    return CloudInput(nodes, node_normals, spacing, graph, tuple(patches), tuple(masks), valid)


def of_side(clouds: CloudInput, side: int) -> CloudInput:
    """Return the sources (0) or targets (1) of a batch of clouds."""
    assert clouds.valid is not None  # set by ``sampled``
    return CloudInput(
        clouds.points[side::2].contiguous(),
        clouds.normals[side::2].contiguous(),
        clouds.spacing[side::2].contiguous(),
        clouds.neighbours[side::2].contiguous(),
        tuple(patch[side::2].contiguous() for patch in clouds.patches),
        tuple(mask[side::2].contiguous() for mask in clouds.patch_masks),
        clouds.valid[side::2].contiguous(),
    )


def _level(dense: DenseClouds, size: Tensor) -> tuple[Voxels, Tensor]:
    """Thin the dense clouds further -> cells and their unit normals; see ``preprocess._cell_normals``."""
    level = voxelised(dense.voxels.means, dense.voxels.cloud, size)
    count = len(level.keys)
    mean = group_means(dense.normals, level.owner, count)
    number = torch.arange(len(level.owner), device=mean.device)
    last = torch.zeros(count, dtype=torch.int64, device=mean.device)
    last.scatter_reduce_(0, level.owner, number, "amax")
    cancelled = mean.norm(dim=1, keepdim=True) <= 1e-3
    return level, torch.where(cancelled, dense.normals[last], unit(mean))


def _patch(
    nodes: Tensor, distance: Tensor, points: Tensor, normals: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Take every second of the nearest points: even cover, half the cost; see ``preprocess._patch``.

    Args:
        nodes: (..., 3).
        distance: (..., 2 K) nearest first, infinity where there is none.
        points: (..., 2 K, 3).
        normals: (..., 2 K, 3).
        radius: (...).

    Returns:
        (..., K, 6) offsets over the radius and normals, and the mask (..., K).
    """
    distance, points, normals = distance[..., ::2], points[..., ::2, :], normals[..., ::2, :]
    mask = distance.isfinite()
    patch = torch.cat([(points - nodes[..., None, :]) / radius[..., None, None], normals], dim=-1)
    return torch.where(mask[..., None], patch, 0.0), mask


def _nearest(queries: Tensor, points: Tensor, mask: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return distance and column (C, Q, k) of the nearest k of the True points (C, N, 3), nearest first."""
    together = max(1, DISTANCES // (queries.shape[1] * points.shape[1]))
    found = []
    for start in range(0, len(queries), together):
        part = slice(start, start + together)
        squared = squared_distances(queries[part], points[part])
        squared = torch.where(mask[part, None], squared, torch.inf)
        found.append(squared.topk(min(k, points.shape[1]), dim=2, largest=False))
    squared, index = (torch.cat(parts) for parts in zip(*found))
    return squared.sqrt(), index


def _graph(nodes: Tensor, valid: Tensor, k: int) -> Tensor:
    """Return each node's k nearest others (C, N, k), the farthest repeated where there are fewer."""
    index = _nearest(nodes, nodes, valid, k + 1)[1][..., 1:]
    most = (valid.sum(dim=1) - 2).clamp(0, index.shape[2] - 1)  # the last column that is a neighbour
    column = torch.minimum(torch.arange(k, device=nodes.device), most[:, None])
    index = index.gather(2, column[:, None].expand(-1, index.shape[1], -1))
    return torch.where(valid[..., None], index, 0)


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """Pick rows: values (C, N, V), index (C, Q, k) -> (C, Q, k, V)."""
    return values[torch.arange(len(values), device=index.device)[:, None, None], index]
