"""Known answers for a sampled pair: soft correspondences and overlap (Sec. 3.5)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from utopic_cli.model.cloud_input import CloudInput

POSITIVE_REACH = 1.1
"""Largest distance, in node spacings, at which two nodes show the same piece of surface."""

IGNORED_REACH = 2.0
"""Up to this distance, in node spacings, a wrong match is too near to be punished."""

SOFTNESS = 0.45
"""Standard deviation of the soft correspondence in node spacings."""


class Labels(NamedTuple):
    """Known answers of a batch of pairs.

    Attributes:
        correspondences: (B, N, M) soft, in [0, 1]; rows and columns sum to about 1 in the
            overlap and to 0 elsewhere.
        ignored: (B, N, M) bool, pairs of nodes that are neither right nor clearly wrong, or that
            only fill a batch up.
        source_overlap: (B, N) in {0, 1}.
        target_overlap: (B, M) in {0, 1}.
        source_valid: (B, N) float, 0 for nodes that only fill a batch up.
        target_valid: (B, M) float.
    """

    correspondences: Tensor
    ignored: Tensor
    source_overlap: Tensor
    target_overlap: Tensor
    source_valid: Tensor
    target_valid: Tensor


def label_pair(
    source: CloudInput,
    target: CloudInput,
    gt_T_target_source: Tensor,
    hard_radius: float = 0.0,
) -> Labels:
    """Label a batch of sampled pairs.

    Nodes of two scans never coincide, so a mutual nearest neighbour would leave most points
    without a partner: each node spreads over its (at most four) nearest counterparts instead,
    with Gaussian weights, and the two directions are averaged.

    Args:
        source: clouds of N points.
        target: clouds of M points.
        gt_T_target_source: (B, 4, 4).
        hard_radius: if positive, the correspondences are the paper's mutual nearest neighbours
            within this radius instead.
    """
    moved = source.points @ gt_T_target_source[:, :3, :3].transpose(1, 2) + gt_T_target_source[:, None, :3, 3]
    distance = torch.cdist(moved, target.points, compute_mode="donot_use_mm_for_euclid_dist")
    source_valid, target_valid = _valid(source), _valid(target)
    filling = ~(source_valid[:, :, None] & target_valid[:, None])
    distance = distance.masked_fill(filling, torch.inf)
    valid = (source_valid.float(), target_valid.float())
    if hard_radius > 0:
        near = distance < hard_radius
        overlap = (near.any(dim=2).float(), near.any(dim=1).float())
        return Labels(mutual_nearest(distance, hard_radius), filling, *overlap, *valid)
    distance = distance / source.spacing.view(-1, 1, 1)
    near = distance < POSITIVE_REACH
    weight = torch.exp(-0.5 * (distance / SOFTNESS) ** 2) * near
    forward = _nearest_four(weight)
    backward = _nearest_four(weight.transpose(1, 2)).transpose(1, 2)
    return Labels(
        correspondences=0.5 * (forward + backward),
        ignored=((distance < IGNORED_REACH) & ~near) | filling,
        source_overlap=near.any(dim=2).float(),
        target_overlap=near.any(dim=1).float(),
        source_valid=valid[0],
        target_valid=valid[1],
    )


def mutual_nearest(distance: Tensor, radius: float) -> Tensor:
    """The paper's hard correspondences: mutual nearest neighbours closer than ``radius``.

    Args:
        distance: (B, N, M) from source points under the known transformation to target points.
        radius: r, in the points' units.

    Returns:
        (B, N, M) float in {0, 1}.
    """
    nearest_target = distance == distance.min(dim=2, keepdim=True).values
    nearest_source = distance == distance.min(dim=1, keepdim=True).values
    return (nearest_target & nearest_source & (distance < radius)).float()


def _valid(cloud: CloudInput) -> Tensor:
    return torch.ones_like(cloud.points[..., 0], dtype=torch.bool) if cloud.valid is None else cloud.valid


def _nearest_four(weight: Tensor) -> Tensor:
    """Keep the four largest weights of each row and make rows with any sum to one."""
    k = min(4, weight.shape[-1])
    kept = weight * (weight >= weight.topk(k, dim=-1).values[..., -1:])
    return kept / kept.sum(dim=-1, keepdim=True).clamp_min(1e-6)
