"""Geometric relation embedding (Sec. 3.3.1): three invariant numbers for a pair of points."""

from __future__ import annotations

import torch
from torch import Tensor

RELATIONS = 3


def geometric_embedding(points: Tensor, neighbours: Tensor) -> Tensor:
    """Relate every point to every other: distance, triplet angle, triangle perimeter difference.

    Args:
        points: (B, N, 3).
        neighbours: (B, N, k) int64 with k >= 2, nearest first, the point itself left out.

    Returns:
        (B, 3, N, N): rho_ij = |p_i - p_j|; alpha_ij, the angle in radians between
        (p_k1 - p_i) + (p_k2 - p_i) and p_j - p_i; eta_ij, the perimeter of i's triangle
        with its two nearest neighbours minus that of j's. On the diagonal all three are 0.
    """
    batch, count, _ = points.shape
    rows = torch.arange(batch, device=points.device)[:, None]
    first = points[rows, neighbours[:, :, 0]]  # (B, N, 3)
    second = points[rows, neighbours[:, :, 1]]
    distance = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")  # (B, N, N)

    triplet = first + second - 2.0 * points
    # triplet_i . (p_j - p_i) without an (N, N, 3) tensor.
    along = triplet @ points.transpose(1, 2) - (triplet * points).sum(-1, keepdim=True)
    length = triplet.norm(dim=-1, keepdim=True)
    cosine = along / (length * distance).clamp_min(1e-9)
    angle = torch.arccos(cosine.clamp(-1.0, 1.0))
    angle = angle * (1.0 - torch.eye(count, device=points.device))

    perimeter = (
        (first - points).norm(dim=-1) + (second - points).norm(dim=-1) + (first - second).norm(dim=-1)
    )  # (B, N)
    difference = perimeter[:, :, None] - perimeter[:, None, :]
    return torch.stack([distance, angle, difference], dim=1)
