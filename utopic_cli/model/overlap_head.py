"""Overlap heads (Sec. 3.4): the probability that a point lies where the scans overlap."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from utopic_cli.model.one_thread import one_thread


class OverlapHead(nn.Module):
    """A linear layer on the final features; matched mass and the first estimate are further witnesses."""

    def __init__(self, width: int) -> None:
        """Build for features of ``width`` channels."""
        super().__init__()
        self.linear = nn.Linear(width, 1)
        self.mass_gain = nn.Parameter(torch.tensor(0.5))
        self.mean_gain = nn.Parameter(torch.tensor(1.0))

    @one_thread()
    def forward(self, features: Tensor, slack: Tensor, mean: Tensor) -> Tensor:
        """Return overlap logits.

        Args:
            features: (B, N, V) after the second transformer.
            slack: (B, N) unmatched mass in [0, 1].
            mean: (B, N) mean of the overlap distribution, in logits.

        Returns:
            (B, N).
        """
        matched = torch.logit((1.0 - slack).clamp(1e-4, 1.0 - 1e-4))
        return self.linear(features).squeeze(-1).float() + self.mass_gain * matched + self.mean_gain * mean
