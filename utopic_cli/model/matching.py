"""Affinity matching (Sec. 3.3.3): a learned similarity, slack for unmatched points, Sinkhorn."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from utopic_cli.model.one_thread import one_thread


@one_thread()
def sinkhorn(affinity: Tensor, iterations: int) -> Tensor:
    """Turn affinities into a soft correspondence matrix with a slack row and column.

    Works in scaling form, u = 1 / (E v + 1), v = 1 / (E^T u + 1) with E = exp(affinity): the
    slack entries have affinity 0 and are normalised along one side only, so rows and columns
    of the result sum to one over real and slack entries (columns exactly, rows in the limit).

    Args:
        affinity: (B, N, M) float32.
        iterations: rounds of row and column normalisation.

    Returns:
        (B, N + 1, M + 1) float32; last row and column are slack, their corner 0.
    """
    kernel = affinity.float().clamp_max(30.0).exp()
    column_scale = kernel.new_ones(kernel.shape[0], kernel.shape[2], 1)  # v
    row_scale = kernel.new_ones(kernel.shape[0], kernel.shape[1], 1)  # u
    for _ in range(iterations):
        row_scale = 1.0 / (kernel @ column_scale + 1.0)
        column_scale = 1.0 / (kernel.transpose(1, 2) @ row_scale + 1.0)
    core = row_scale * kernel * column_scale.transpose(1, 2)
    scores = torch.cat([core, row_scale], dim=2)  # (B, N, M + 1)
    corner = torch.zeros_like(column_scale[:, :1])
    return torch.cat([scores, torch.cat([column_scale, corner], dim=1).transpose(1, 2)], dim=1)


@one_thread()
def _instance_norm(matrix: Tensor, real: Tensor | None) -> Tensor:
    """Zero mean and unit variance over each (N, M) map of a batch, over its real entries if given."""
    if real is None:
        centred = matrix - matrix.mean(dim=(1, 2), keepdim=True)
        return centred * torch.rsqrt(centred.square().mean(dim=(1, 2), keepdim=True) + 1e-6)
    count = real.sum(dim=(1, 2), keepdim=True)
    centred = (matrix - (matrix * real).sum(dim=(1, 2), keepdim=True) / count) * real
    return centred * torch.rsqrt(centred.square().sum(dim=(1, 2), keepdim=True) / count + 1e-6)


class AffinityMatching(nn.Module):
    """A_ij = f_i^T W f_j with a learnable symmetric W, instance norm, Sinkhorn."""

    def __init__(self, width: int, iterations: int, descriptor_skip: bool) -> None:
        """Build for features of ``width`` channels."""
        super().__init__()
        self.iterations = iterations
        self.weight = nn.Parameter(torch.eye(width) + 0.02 * torch.randn(width, width))
        # Gain and bias of the norm: the start makes most points slack, a few matched.
        self.gain = nn.Parameter(torch.tensor(1.5 if descriptor_skip else 3.0))
        self.bias = nn.Parameter(torch.tensor(-6.0))
        self.skip_gain = nn.Parameter(torch.tensor(2.5)) if descriptor_skip else None

    def forward(
        self, source: Tensor, target: Tensor, similarity: Tensor, real: Tensor | None = None
    ) -> Tensor:
        """Match features.

        Args:
            source: (B, N, V).
            target: (B, M, V).
            similarity: (B, N, M) of the descriptors.
            real: (B, N, M) bool, False where a row or column only fills up a batch; None: all real.

        Returns:
            (B, N + 1, M + 1) soft correspondences with slack.
        """
        symmetric = 0.5 * (self.weight + self.weight.T)
        affinity = ((source @ symmetric) @ target.transpose(1, 2)).float()
        affinity = self.gain * _instance_norm(affinity, real)
        if self.skip_gain is not None:
            affinity = affinity + self.skip_gain * _instance_norm(similarity.float(), real)
        affinity = affinity + self.bias
        if real is not None:
            affinity = affinity.masked_fill(~real, -torch.inf)
        return sinkhorn(affinity, self.iterations)
