"""Completion decoder (Sec. 3.2, after PCN): teaches the extractor whole shapes; training only."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class CompletionDecoder(nn.Module):
    """Decode a cloud's pooled features to a coarse cloud, then fold a fine one around it."""

    grid: Tensor

    def __init__(self, width: int, coarse: int = 128, folds: int = 4) -> None:
        """Build for features of ``width`` channels; the fine cloud has ``coarse * folds`` points."""
        super().__init__()
        self.coarse, self.folds = coarse, folds
        self.pool = nn.Linear(width, 2 * width)
        self.coarse_mlp = nn.Sequential(
            nn.Linear(2 * width, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 3 * coarse)
        )
        self.fold_mlp = nn.Sequential(
            nn.Linear(2 * width + 5, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 3)
        )
        side = int(round(folds**0.5))
        axis = torch.linspace(-0.05, 0.05, side)
        self.register_buffer("grid", torch.cartesian_prod(axis, axis), persistent=False)  # (folds, 2)

    def forward(self, features: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Decode a cloud.

        Args:
            features: (B, N, V).
            valid: (B, N) bool, False for points that only fill a batch up; None: all are valid.

        Returns:
            A coarse (B, coarse, 3) and a fine (B, coarse * folds, 3) cloud.
        """
        batch = features.shape[0]
        pooled = self.pool(features)
        if valid is not None:
            pooled = pooled.masked_fill(~valid[..., None], -torch.inf)
        code = pooled.max(dim=1).values  # (B, 2V)
        coarse = self.coarse_mlp(code).view(batch, self.coarse, 3)
        centres = coarse.repeat_interleave(self.folds, dim=1)  # (B, F, 3)
        grid = self.grid.repeat(self.coarse, 1).expand(batch, -1, -1)
        context = code[:, None].expand(-1, centres.shape[1], -1)
        return coarse, centres + self.fold_mlp(torch.cat([context, centres, grid], dim=-1))


def canonical_frame(points: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Find a frame that moves with the cloud, so that invariant features can know it.

    Args:
        points: (B, N, 3).
        valid: (B, N) float, 0 for points that only fill a batch up.

    Returns:
        centre: (B, 1, 3) mean.
        axes: (B, 3, 3) rotation; ``(p - centre) @ axes`` are coordinates along the principal
            axes, signed so that the third moment along the first two is positive.
    """
    share = (valid / valid.sum(dim=1, keepdim=True))[..., None]
    centre = (points * share).sum(dim=1, keepdim=True)
    centred = (points - centre) * valid[..., None]
    axes = torch.linalg.eigh(centred.transpose(1, 2) @ centred).eigenvectors.flip(-1)
    skew = ((centred @ axes) ** 3).sum(dim=1)  # (B, 3)
    axes = axes * torch.where(skew < 0, -1.0, 1.0)[:, None]
    third = torch.linalg.cross(axes[..., 0], axes[..., 1])
    return centre, torch.stack([axes[..., 0], axes[..., 1], third], dim=-1)
