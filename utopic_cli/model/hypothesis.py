"""Evidence of a hypothesis: what a transformation under test says about each point.

The paper's network sees the scans once and has to tell overlap from features alone. Here it
may look again: once a transformation has been found, how near each point comes to the other
scan, and whether the surfaces face the same way, are given to the network beside the
features. Training shows it right, slightly wrong and plausible wrong transformations, so it
also learns when not to believe one. Without a hypothesis the network is the paper's.
"""

from __future__ import annotations

import torch
from torch import Tensor

from utopic_cli.model.cloud_input import CloudInput

REACHES = (0.7, 1.5, 3.0)
"""Distances, in node spacings, at which "near" is judged."""

HYPOTHESIS_FEATURES = 2 * (len(REACHES) + 1) + 1


def hypothesis_features(
    own: CloudInput, other: CloudInput, transformation: Tensor, present: Tensor
) -> Tensor:
    """Judge every point of one cloud by a transformation onto the other.

    Args:
        own: clouds of N points.
        other: clouds of M points.
        transformation: (B, 4, 4) from ``own`` to ``other``, normalised units.
        present: (B,) 1 where there is a hypothesis, 0 where there is none (all features are 0).

    Returns:
        (B, N, 9): nearness at three reaches, agreement of normals where near, the means of
        these four over the cloud, and whether there is a hypothesis.
    """
    rotation = transformation[:, :3, :3].transpose(1, 2)
    moved = own.points @ rotation + transformation[:, None, :3, 3]
    distance = torch.cdist(moved, other.points, compute_mode="donot_use_mm_for_euclid_dist")
    if other.valid is not None:
        distance = distance.masked_fill(~other.valid[:, None], torch.inf)
    nearest = distance.min(dim=2)
    residual = nearest.values / own.spacing[:, None]  # (B, N)
    rows = torch.arange(len(moved), device=moved.device)[:, None]
    agreement = ((own.normals @ rotation) * other.normals[rows, nearest.indices]).sum(-1)
    near = [torch.exp(-0.5 * (residual / reach) ** 2) for reach in REACHES]
    local = torch.stack([*near, near[1] * agreement], dim=-1)  # (B, N, 4)
    if own.valid is None:
        mean = local.mean(dim=1, keepdim=True)
    else:
        share = own.valid / own.valid.sum(dim=1, keepdim=True)
        mean = (local * share[..., None]).sum(dim=1, keepdim=True)
    whole = mean.expand_as(local)
    flag = torch.ones_like(local[..., :1])
    return torch.cat([local, whole, flag], dim=-1) * present[:, None, None]


def inverse(transformation: Tensor) -> Tensor:
    """Invert (B, 4, 4) rigid transformations."""
    result = transformation.clone()
    rotation = transformation[:, :3, :3].transpose(1, 2)
    result[:, :3, :3] = rotation
    result[:, :3, 3:] = -rotation @ transformation[:, :3, 3:]
    return result
