"""Overlap heads (Sec. 3.4): the probability that a point lies where the scans overlap."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class OverlapHead(nn.Module):
    """A linear layer on the final features, and the point's matched mass as a second witness."""

    def __init__(self, width: int) -> None:
        """Build for features of ``width`` channels."""
        super().__init__()
        self.linear = nn.Linear(width, 1)
        self.mass_gain = nn.Parameter(torch.tensor(0.5))

    def forward(self, features: Tensor, slack: Tensor) -> Tensor:
        """Return overlap logits (B, N) from features (B, N, V) and slack mass (B, N) in [0, 1]."""
        matched = torch.logit((1.0 - slack).clamp(1e-4, 1.0 - 1e-4))
        return self.linear(features).squeeze(-1).float() + self.mass_gain * matched
