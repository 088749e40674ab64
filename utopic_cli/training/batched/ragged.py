"""Sums, quantiles and rotations that are exact and repeatable on every device.

Two things would spoil geometry on a GPU: matrix products may be rounded to ten bits (TF32), and
sums of floats scattered by atomic adds depend on the order of the threads. So rotations are written
out, and scattered sums are taken in fixed point, where the order doesn't matter.
"""

from __future__ import annotations

import torch
from torch import Tensor

FIXED_POINT = 2.0**36
"""Steps per unit in sums: values up to 1,000 and 100,000 of them fit into int64."""


DISTANCES = 2**26
"""Distances worked on at a time, which bounds memory."""


def turned(points: Tensor, rotation: Tensor) -> Tensor:
    """Rotate points (..., N, 3) by matrices (..., 3, 3): rows R @ p, without a matrix product."""
    x, y, z = points.unbind(-1)
    columns = [
        rotation[..., i, 0, None] * x + rotation[..., i, 1, None] * y + rotation[..., i, 2, None] * z
        for i in range(3)
    ]
    return torch.stack(columns, dim=-1)


def product(first: Tensor, second: Tensor) -> Tensor:
    """Multiply small matrices (..., I, J) and (..., J, K), written out."""
    return (first[..., :, :, None] * second[..., None, :, :]).sum(dim=-2)


def rotations(vectors: Tensor) -> Tensor:
    """Return the rotations (W, 3, 3) about vectors (W, 3) by their lengths in radians."""
    angle = vectors.norm(dim=1).clamp_min(1e-12)
    x, y, z = (vectors / angle[:, None]).unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)
    sine, cosine = angle.sin()[:, None, None], angle.cos()[:, None, None]
    return torch.eye(3, device=vectors.device) + sine * skew + (1.0 - cosine) * product(skew, skew)


def cross(first: Tensor, second: Tensor) -> Tensor:
    """Cross product of (..., 3) vectors that broadcast."""
    ax, ay, az = first.unbind(-1)
    bx, by, bz = second.unbind(-1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=-1)


def squared_distances(queries: Tensor, points: Tensor) -> Tensor:
    """Return (B, Q, N) squared distances between queries (B, Q, 3) and points (B, N, 3).

    Written out: ``torch.cdist`` either takes a matrix product, or on a GPU a block of threads for
    every single distance.
    """
    total = (queries[..., 0, None] - points[..., None, :, 0]).square_()
    for axis in (1, 2):
        apart = queries[..., axis, None] - points[..., None, :, axis]
        total.addcmul_(apart, apart)
    return total


def nearest_distance(queries: Tensor, points: Tensor) -> Tensor:
    """Return the distance (B, Q) from each query (B, Q, 3) to the nearest of points (B, N, 3)."""
    together = max(1, DISTANCES // (queries.shape[1] * points.shape[1]))
    blocks = zip(queries.split(together), points.split(together))
    return torch.cat([squared_distances(*block).amin(dim=2) for block in blocks]).sqrt()


def group_sums(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Add up the rows of each group.

    Args:
        values: (T, C) float32, at most about 1,000.
        group: (T,) int64 in [0, count).
        count: number of groups.

    Returns:
        (count, C) float64, the same whatever the order of the additions.
    """
    fixed = (values.double() * FIXED_POINT).round().long()
    sums = torch.zeros(count, values.shape[1], dtype=torch.int64, device=values.device)
    sums.scatter_add_(0, group[:, None].expand(-1, values.shape[1]), fixed)
    return sums.double() / FIXED_POINT


def group_means(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Average the rows (T, C) of each group -> (count, C) float32; see ``group_sums``."""
    size = torch.bincount(group, minlength=count).clamp_min(1)
    return (group_sums(values, group, count) / size[:, None]).float()


def masked_quantile(values: Tensor, mask: Tensor, share: float) -> Tensor:
    """Return the quantile (R,) of the True columns of each row (R, N), linearly interpolated.

    Rows without any give infinity.
    """
    ordered = torch.where(mask, values, torch.inf).sort(dim=1).values
    position = (mask.sum(dim=1) - 1).clamp_min(0) * share
    low = position.floor().long()[:, None]
    high = position.ceil().long()[:, None]
    at_low, at_high = ordered.gather(1, low)[:, 0], ordered.gather(1, high)[:, 0]
    return torch.where(at_low == at_high, at_low, at_low + (at_high - at_low) * (position - low[:, 0]))


def to_rows(values: Tensor, row: Tensor, rows: int, width: int) -> tuple[Tensor, Tensor]:
    """Lay out flat values (T, ...), grouped by ``row`` in ascending order, as padded rows.

    Args:
        values: (T, ...).
        row: (T,) int64, ascending, in [0, rows).
        rows: number of rows R.
        width: columns W; what does not fit is left out.

    Returns:
        padded: (R, W, ...), zero where there is nothing.
        mask: (R, W) bool, the filled places come first.
    """
    size = torch.bincount(row, minlength=rows)
    column = torch.arange(len(row), device=row.device) - (size.cumsum(0) - size)[row]
    fits = column < width
    padded = values.new_zeros(rows, width, *values.shape[1:])
    padded[row[fits], column[fits]] = values[fits]
    mask = torch.arange(width, device=row.device) < size[:, None]
    return padded, mask
