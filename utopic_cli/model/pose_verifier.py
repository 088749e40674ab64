"""The verifier: how plausible is a transformation, by a close-up of both scans under it.

Not in the paper. Matches propose several poses, and averages over the surfaces choose among them badly
where a half turn fits nearly as well. This small set network (in the manner of PointNet: the same layers for
every point, then pooling) learned on right and wrong poses that the solve had proposed for simulated pairs.
With it comes how to read overlap from a pose: where it is right, whether the other scan comes near tells more
than the network, which was also shown poses that are not.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor, nn

from utopic_cli.model.one_thread import one_thread

LARGEST = 5.0
"""Standard deviations; features are cut off beyond."""

POOLS = 4

MEETING_REACH = 1.1
"""Distance, in node spacings, within which the other scan shows the same piece of surface."""

STEEPNESS = 6.0

UNREAD = (8.0, -4.0, 0.0)
"""How overlap is read by a verifier that has learned nothing: even at ``MEETING_REACH``."""


def meeting(gap: np.ndarray) -> np.ndarray:
    """Tell how far points meet the other scan (N,): 1 upon it, half at ``MEETING_REACH``, 0 away from it.

    A point overlaps if the other scan comes within that reach, which under a right pose can be seen. Under
    one a little off it can't quite, so the step is soft.

    Args:
        gap: (N,) distance to the other scan's nearest node, in node spacings.
    """
    return np.asarray(1.0 / (1.0 + (gap / MEETING_REACH) ** STEEPNESS))


class PoseVerifier(nn.Module):
    """Close-ups in, logits out: how plausible each is, as the logarithm of the odds that it is right.

    Attributes:
        sizes: the arguments that it was built with.
        overlap: (3,) how to read overlap from a pose: slope and shift that turn how far a point meets the
            other scan under a right pose into log-odds, and the share that overlaps where none was found.
    """

    point_mean: Tensor
    point_scale: Tensor
    whole_mean: Tensor
    whole_scale: Tensor
    overlap: Tensor

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
        self.register_buffer("overlap", torch.tensor(UNREAD))
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

    def read_overlap(self, gap: np.ndarray, odds: float) -> np.ndarray:
        """Return probabilities of overlap (N,) under a pose.

        Where the scans meet under it holds if it is right; if it is not, nothing is known but what is usual
        then.

        Args:
            gap: (N,) as of ``meeting``, under that pose.
            odds: log-odds that the pose is right.
        """
        slope, shift, usual = self.overlap.tolist()
        right = expit(odds)
        return np.asarray(right * expit(slope * meeting(gap) + shift) + (1.0 - right) * usual)

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
