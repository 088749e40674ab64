"""Voxel grids of many clouds at once: means, node spacing, and neighbours by looking cells up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from utopic_cli.training.batched.ragged import (
    DISTANCES,
    group_means,
    masked_quantile,
    squared_distances,
    to_rows,
)

BITS = 16  # of a cell's number along each axis
MARGIN = 8  # cells below the lowest point that may be asked for
CANDIDATES = 2**23  # looked at in one go, which bounds memory


@dataclass(frozen=True)
class Voxels:
    """The occupied cells of C grids, one after the other, each in grid order.

    Attributes:
        means: (K, 3) float32 mean of the points in each cell.
        cloud: (K,) int64 the cloud each cell belongs to.
        owner: (T,) int64 the cell each point lies in.
        keys: (K,) int64 ascending: cloud and place of each cell.
        low: (C, 3) lower corner of each grid.
        size: (C,) edge length of its cells.
    """

    means: Tensor
    cloud: Tensor
    owner: Tensor
    keys: Tensor
    low: Tensor
    size: Tensor


def voxelised(points: Tensor, cloud: Tensor, size: Tensor) -> Voxels:
    """Thin clouds to one point a cell; see ``geometry.voxel.voxel_downsample``.

    Args:
        points: (T, 3) float32 of all clouds, one after the other.
        cloud: (T,) int64 the cloud each point belongs to.
        size: (C,) edge length of a cell.
    """
    low = lowest_corners(points, cloud, len(size))
    keys, owner = torch.unique(_keys(cell_of(points, cloud, low, size), cloud), return_inverse=True)
    return Voxels(group_means(points, owner, len(keys)), keys >> (3 * BITS), owner, keys, low, size)


def lowest_corners(points: Tensor, cloud: Tensor, clouds: int) -> Tensor:
    """Return the lower corner (C, 3) of each cloud's bounding box."""
    low = torch.full((clouds, 3), torch.inf, device=points.device)
    return low.scatter_reduce(0, cloud[:, None].expand(-1, 3), points, "amin")


def cell_of(points: Tensor, cloud: Tensor, low: Tensor, size: Tensor) -> Tensor:
    """Return the cell (T, 3) int64 each point (T, 3) of a cloud (T,) lies in."""
    cell = ((points - low[cloud]) / size[cloud, None]).floor().long()
    return cell.clamp(-MARGIN, 2**BITS - 1 - 2 * MARGIN)


def _keys(cell: Tensor, cloud: Tensor) -> Tensor:
    x, y, z = (cell + MARGIN).unbind(-1)
    return (((((cloud << BITS) | x) << BITS) | y) << BITS) | z


def common_spacing(points: Tensor, cloud: Tensor, clouds: int, most: int) -> Tensor:
    """Find the node spacing h (C / 2,) of each pair; see ``frame._common_spacing``.

    Args:
        points: (T, 3) normalised points of all clouds; clouds 2 b and 2 b + 1 are a pair.
        cloud: (T,) int64, ascending.
        clouds: C.
        most: most nodes per cloud.
    """
    count = torch.bincount(cloud, minlength=clouds)
    bound = torch.tensor([[1e-4], [2.0]], dtype=torch.float64, device=points.device).repeat(1, clouds)
    low, high = bound.unbind(0)
    corner = lowest_corners(points, cloud, clouds)
    # The bracket shrinks alike for all clouds, to a ratio of 1.015 as in frame.
    for _ in range(math.ceil(math.log2(math.log(2.0 / 1e-4) / math.log(1.015)))):
        size = (low * high).sqrt()
        occupied = torch.unique(_keys(cell_of(points, cloud, corner, size.float()), cloud))
        too_many = torch.bincount(occupied >> (3 * BITS), minlength=clouds) > most
        low, high = torch.where(too_many, size, low), torch.where(too_many, high, size)
    own = own_spacing(points, cloud, count, 4 * most)
    spacing = torch.where(count > most, torch.maximum(high.float(), own), own)
    return spacing.view(-1, 2).amax(dim=1)


def own_spacing(points: Tensor, cloud: Tensor, count: Tensor, limit: int) -> Tensor:
    """Return the spacing (C,) of clouds of fewer than ``limit`` points; 0 for the others.

    It is 0.75 of the median distance of the 8th neighbour; see ``frame._own_spacing``.
    """
    spacing = torch.zeros(len(count), device=points.device)
    start = count.cumsum(0) - count
    few = [(n, number) for number, n in enumerate(count.tolist()) if 9 <= n < limit]
    few.sort()  # clouds of about equal size share a block
    while few:
        together = max(1, DISTANCES // few[-1][0] ** 2)
        few, block = few[:-together], few[-together:]
        width = block[-1][0]
        number = torch.tensor([number for _, number in block], device=points.device)
        column = torch.arange(width, device=points.device)
        mask = column < count[number, None]
        rows = points[start[number, None] + torch.where(mask, column, 0)]
        squared = torch.where(mask[:, None], squared_distances(rows, rows), torch.inf)
        eighth = squared.topk(9, dim=2, largest=False).values[..., 8].sqrt()
        spacing[number] = 0.75 * masked_quantile(eighth, mask, 0.5)
    return spacing


def near(queries: Tensor, cloud: Tensor, voxels: Voxels, cells: float, k: int) -> tuple[Tensor, Tensor]:
    """Find each query's nearest voxel means within a radius, nearest first.

    Cells of a column lie one after the other in grid order, so one search a column finds all.

    Args:
        queries: (Q, 3).
        cloud: (Q,) int64 the cloud each is looked for in.
        voxels: at most one mean a cell.
        cells: the radius, in cells; less than ``MARGIN``.
        k: neighbours wanted.

    Returns:
        distance: (Q, k), infinity where there are fewer.
        index: (Q, k) int64 rows of ``voxels.means``; 0 where there are fewer.
    """
    reach = math.ceil(cells)
    steps = range(-reach, reach + 1)
    gap = {step: max(abs(step) - 1, 0) for step in steps}
    columns = [(i, j) for i in steps for j in steps if gap[i] ** 2 + gap[j] ** 2 <= cells**2]
    offset = torch.tensor([(i << 2 * BITS) + (j << BITS) - reach for i, j in columns], device=queries.device)
    run = torch.arange(2 * reach + 1, device=queries.device)
    block = max(1, CANDIDATES // (len(columns) * len(run)))
    x, y, z = voxels.means.unbind(1)
    last = len(voxels.keys) - 1
    found = []
    for start in range(0, len(queries), block):
        point, own = queries[start : start + block], cloud[start : start + block]
        first_key = _keys(cell_of(point, own, voxels.low, voxels.size), own)[:, None] + offset
        candidate = torch.searchsorted(voxels.keys, first_key)[..., None] + run  # (q, columns, run)
        inside = candidate <= last
        candidate = candidate.clamp_max(last)
        inside &= voxels.keys[candidate] <= first_key[..., None] + 2 * reach
        squared = (x[candidate] - point[:, 0, None, None]).square()
        squared += (y[candidate] - point[:, 1, None, None]).square()
        squared += (z[candidate] - point[:, 2, None, None]).square()
        inside &= squared < (cells * voxels.size[own]).square()[:, None, None]
        squared = torch.where(inside, squared, torch.inf).flatten(1)
        nearest, place = squared.topk(min(k, squared.shape[1]), dim=1, largest=False)
        index = candidate.flatten(1).gather(1, place)
        found.append((nearest.sqrt(), torch.where(nearest.isfinite(), index, 0)))
    distance, index = (torch.cat(parts) for parts in zip(*found))
    return distance, index


def rows_of(values: Tensor, voxels: Voxels, width: int | None = None) -> tuple[Tensor, Tensor]:
    """Lay out values (K, ...) of cells as one padded row (C, width, ...) a cloud, with its mask."""
    if width is None:
        width = int(torch.bincount(voxels.cloud, minlength=len(voxels.size)).max())
    return to_rows(values, voxels.cloud, len(voxels.size), width)
