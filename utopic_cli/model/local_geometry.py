"""Rotation-invariant local geometry: what a surface looks like around a point, in any pose."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from utopic_cli.model.cloud_input import CloudInput, highest

EDGE_INVARIANTS = 9


def edge_invariants(offset: Tensor, normal: Tensor, neighbour_normal: Tensor) -> Tensor:
    """Describe a neighbour relative to a point by numbers no rigid motion changes.

    The signed twist is what tells a left-handed shape from its mirror image.

    Args:
        offset: (..., 3) from the point to its neighbour, over a reference length.
        normal: (..., 3) unit normal at the point.
        neighbour_normal: (..., 3) unit normal at the neighbour.

    Returns:
        (..., 9): distance, height over the tangent plane, tangential distance, their squares'
        sum, cosine between normals, neighbour's normal along the offset, its radial tilt, the
        signed twist, and squared height.
    """
    squared = (offset * offset).sum(-1)
    distance = (squared + 1e-8).sqrt()
    height = (offset * normal).sum(-1)
    tangential = (squared - height * height).clamp_min(0).add(1e-6).sqrt()
    cosine = (normal * neighbour_normal).sum(-1)
    slope = (offset * neighbour_normal).sum(-1)
    tilt = (slope - height * cosine) / (tangential + 0.05)
    twist = (torch.linalg.cross(normal.expand_as(offset), offset) * neighbour_normal).sum(-1)
    twist = twist / (tangential + 0.05)
    return torch.stack(
        [distance, height, tangential, squared, cosine, slope, tilt, twist, height * height], dim=-1
    )


class LocalGeometryEncoder(nn.Module):
    """Encode the dense scan around each sampled point at three scales.

    One small PointNet a scale over the invariants of the patch; maximum and mean over the
    patch, then a linear layer.
    """

    def __init__(self, width: int, hidden: int = 48, scales: int = 3) -> None:
        """Build encoders of ``width`` output channels for each of ``scales`` scales."""
        super().__init__()
        self.points = nn.ModuleList(
            nn.Sequential(
                nn.Linear(EDGE_INVARIANTS, 32), nn.LeakyReLU(0.2), nn.Linear(32, hidden), nn.LeakyReLU(0.2)
            )
            for _ in range(scales)
        )
        self.summary = nn.ModuleList(nn.Linear(2 * hidden, width) for _ in range(scales))
        self.norm = nn.LayerNorm(scales * width)

    def forward(self, cloud: CloudInput) -> Tensor:
        """Return (B, N, scales * width) features."""
        encoded = []
        for patch, mask, points, summary in zip(
            cloud.patches, cloud.patch_masks, self.points, self.summary, strict=True
        ):
            invariants = edge_invariants(patch[..., :3], cloud.normals[:, :, None], patch[..., 3:])
            per_point = points(invariants)  # (B, N, K, hidden)
            outside = ~mask[..., None]
            strongest = highest(per_point.masked_fill(outside, -1e4))
            strongest = strongest.masked_fill(~mask.any(dim=2, keepdim=True), 0.0)
            count = mask.sum(dim=2, keepdim=True).clamp_min(1)
            mean = per_point.masked_fill(outside, 0.0).sum(dim=2) / count
            encoded.append(summary(torch.cat([strongest, mean], dim=-1)))
        return nn.functional.leaky_relu(self.norm(torch.cat(encoded, dim=-1)), 0.2)
