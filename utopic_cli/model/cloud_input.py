"""What the network sees of one cloud: sampled points and the local geometry around them."""

from __future__ import annotations

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
    """

    points: Tensor
    normals: Tensor
    spacing: Tensor
    neighbours: Tensor
    patches: tuple[Tensor, ...]
    patch_masks: tuple[Tensor, ...]

    def to(self, device: torch.device) -> CloudInput:
        """Return the same data on another device."""
        return CloudInput(
            self.points.to(device),
            self.normals.to(device),
            self.spacing.to(device),
            self.neighbours.to(device),
            tuple(patch.to(device) for patch in self.patches),
            tuple(mask.to(device) for mask in self.patch_masks),
        )


def gather(values: Tensor, index: Tensor) -> Tensor:
    """Pick rows: values (B, N, C), index (B, N, k) -> (B, N, k, C).

    A flat embedding lookup: the gather with the fastest backward pass on a CPU.
    """
    batch, count, width = values.shape
    offset = torch.arange(batch, device=index.device).view(batch, 1, 1) * count
    return torch.nn.functional.embedding(index + offset, values.reshape(batch * count, width))
