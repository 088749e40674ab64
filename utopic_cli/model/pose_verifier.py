"""The verifier: how plausible is a transformation, by a close-up of both scans under it.

Not in the paper. Matches propose several poses, and averages over the surfaces choose among them badly
where a half turn fits nearly as well. This small set network (in the manner of PointNet: the same layers for
every point, then pooling) learned on right and wrong poses that the solve had proposed for simulated pairs.
With it comes how to read the overlap that the network gives when it is shown a pose.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.special import expit, logit
from torch import Tensor, nn

from utopic_cli.model.one_thread import one_thread

LARGEST = 5.0
"""Standard deviations; features are cut off beyond."""

POOLS = 4


CERTAIN = 1e-4
"""Overlap is taken to be no surer than this."""


def overlap_logits(overlap: np.ndarray) -> np.ndarray:
    """Return probabilities (N,) as finite logits."""
    return np.asarray(logit(np.clip(overlap, CERTAIN, 1.0 - CERTAIN)))


class PoseVerifier(nn.Module):
    """Close-ups in, logits out: how plausible each is, as the logarithm of the odds that it is right.

    Attributes:
        sizes: the arguments that it was built with.
        reading: (3,) how to read overlap: slope and shift that turn the network's logits, shown a right
            pose, into log-odds, and the share that overlaps where no right pose was found.
    """

    point_mean: Tensor
    point_scale: Tensor
    whole_mean: Tensor
    whole_scale: Tensor
    reading: Tensor

    def __init__(self, point_features: int, whole_features: int, width: int) -> None:
        """Build with random weights.

        Args:
            point_features: of each point.
            whole_features: of the pose as a whole.
            width: hidden units.
        """
        super().__init__()
        self.sizes = {"point_features": point_features, "whole_features": whole_features, "width": width}
        for name, count in (("point", point_features), ("whole", whole_features)):
            self.register_buffer(f"{name}_mean", torch.zeros(count))
            self.register_buffer(f"{name}_scale", torch.ones(count))
        self.register_buffer("reading", torch.tensor([1.0, 0.0, 0.0]))
        self.points = nn.Sequential(
            nn.Linear(point_features, width), nn.GELU(), nn.Linear(width, width), nn.GELU()
        )
        self.attention = nn.Linear(width, POOLS)
        self.head = nn.Sequential(
            nn.Linear((POOLS + 1) * width + whole_features, width),
            nn.GELU(),
            nn.Dropout(0.2),
            nn.Linear(width, 1),
        )
        self.direct = nn.Linear(whole_features, 1)

    def normalise(self, points: Tensor, whole: Tensor) -> None:
        """Take the features' means and scales from examples (..., F) and (..., G)."""
        for name, values in (("point", points), ("whole", whole)):
            flat = values.reshape(-1, values.shape[-1]).float()
            getattr(self, f"{name}_mean").copy_(flat.mean(dim=0))
            getattr(self, f"{name}_scale").copy_(flat.std(dim=0) + 1e-3)

    def read(self, overlap: np.ndarray, odds: float) -> np.ndarray:
        """Return probabilities of overlap (N,) where the network was shown a pose.

        What it then sees holds if the pose is right; if it is not, nothing is known but what is usual then.

        Args:
            overlap: (N,) the network's.
            odds: log-odds that the pose is right.
        """
        slope, shift, usual = self.reading.tolist()
        right = expit(odds)
        return np.asarray(right * expit(slope * overlap_logits(overlap) + shift) + (1.0 - right) * usual)

    @one_thread()
    def forward(self, points: Tensor, whole: Tensor) -> Tensor:
        """Return the logits (B,).

        Args:
            points: (B, P, F), of the points of both scans.
            whole: (B, G), of the pose as a whole.
        """
        points = ((points - self.point_mean) / self.point_scale).clamp(-LARGEST, LARGEST)
        whole = ((whole - self.whole_mean) / self.whole_scale).clamp(-LARGEST, LARGEST)
        hidden = self.points(points)
        shares = torch.softmax(self.attention(hidden), dim=1)  # (B, P, POOLS)
        pooled = torch.cat([hidden.mean(dim=1), (shares.transpose(1, 2) @ hidden).flatten(1)], dim=1)
        logit: Tensor = self.head(torch.cat([pooled, whole], dim=1)) + self.direct(whole)
        return logit[:, 0]
