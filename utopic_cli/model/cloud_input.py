"""What the network sees of one cloud: sampled points and the local geometry around them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class CloudInput(NamedTuple):
    """One cloud of each pair of a batch, in a unit common to both clouds of a pair.

    Attributes:
        points: (B, N, 3) float32, centred; the larger cloud of the pair has radius about 1.
        normals: (B, N, 3) float32, oriented unit normals.
        spacing: (B,) float32, distance h between neighbouring sampled points.
        neighbours: (B, N, k) int64, nearest sampled points, the point itself left out.
        patches: for each of the three scales (B, N, K, 6) float32: offset of a neighbour in
            the dense scan over the patch radius, and that neighbour's normal.
        patch_masks: for each scale (B, N, K) bool, False where a patch has fewer than K points.
        valid: (B, N) bool, False on the rows that fill a smaller cloud of a batch up, which come
            last; None if there are none. No result depends on what those rows hold.
    """

    points: Tensor
    normals: Tensor
    spacing: Tensor
    neighbours: Tensor
    patches: tuple[Tensor, ...]
    patch_masks: tuple[Tensor, ...]
    valid: Tensor | None = None

    def to(self, device: torch.device) -> CloudInput:
        """Return the same data on another device."""
        return CloudInput(
            self.points.to(device),
            self.normals.to(device),
            self.spacing.to(device),
            self.neighbours.to(device),
            tuple(patch.to(device) for patch in self.patches),
            tuple(mask.to(device) for mask in self.patch_masks),
            None if self.valid is None else self.valid.to(device),
        )


def stack_clouds(clouds: Sequence[CloudInput]) -> CloudInput:
    """Put batches of clouds of different sizes into one batch, the smaller ones filled up."""
    most = max(cloud.points.shape[1] for cloud in clouds)

    def stacked(parts: Sequence[Tensor]) -> Tensor:
        return torch.cat([_filled(part, most) for part in parts])

    valid = [
        torch.ones(cloud.points.shape[:2], dtype=torch.bool) if cloud.valid is None else cloud.valid
        for cloud in clouds
    ]
    padded = any(len(mask[0]) < most or not bool(mask.all()) for mask in valid)
    return CloudInput(
        stacked([cloud.points for cloud in clouds]),
        stacked([cloud.normals for cloud in clouds]),
        torch.cat([cloud.spacing for cloud in clouds]),
        stacked([cloud.neighbours for cloud in clouds]),
        tuple(stacked(scale) for scale in zip(*(cloud.patches for cloud in clouds))),
        tuple(stacked(scale) for scale in zip(*(cloud.patch_masks for cloud in clouds))),
        stacked(valid) if padded else None,
    )


def _filled(values: Tensor, most: int) -> Tensor:
    """Fill (B, N, ...) up to ``most`` rows with zeros."""
    missing = most - values.shape[1]
    if not missing:
        return values
    return torch.cat([values, values.new_zeros(values.shape[0], missing, *values.shape[2:])], dim=1)


def highest(values: Tensor) -> Tensor:
    """Maximum of (B, N, K, C) over K -> (B, N, C)."""
    # Without the indices that only a gradient needs, it is several times faster.
    return values.max(dim=2).values if values.requires_grad else values.amax(dim=2)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """Pick rows: values (B, N, C), index (B, N, k) -> (B, N, k, C).

    A flat embedding lookup: the gather with the fastest backward pass on a CPU.
    """
    batch, count, width = values.shape
    offset = torch.arange(batch, device=index.device).view(batch, 1, 1) * count
    return torch.nn.functional.embedding(index + offset, values.reshape(batch * count, width))
