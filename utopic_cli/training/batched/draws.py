"""Random draws on the device, all from one generator."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Draws:
    """Draws float32 tensors on the device of a generator.

    Attributes:
        generator: the only source of randomness.
        device: where everything drawn lies.
    """

    def __init__(self, generator: torch.Generator) -> None:
        """Draw from ``generator``, on its device."""
        self.generator, self.device = generator, generator.device

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Draw evenly from [low, high)."""
        return low + (high - low) * torch.rand(shape, generator=self.generator, device=self.device)

    def log_uniform(self, *shape: int, low: float, high: float) -> Tensor:
        """Draw so that the logarithm is even over [log low, log high)."""
        return self.uniform(*shape, low=math.log(low), high=math.log(high)).exp()

    def normal(self, *shape: int) -> Tensor:
        """Draw from the standard normal distribution."""
        return torch.randn(shape, generator=self.generator, device=self.device)

    def chance(self, probability: float, *shape: int) -> Tensor:
        """Draw bool, True with a probability."""
        return self.uniform(*shape) < probability

    def below(self, limits: Tensor, *shape: int) -> Tensor:
        """Draw int64 (*shape) in [0, limit), ``limits`` broadcast against the shape; 0 where it is 0."""
        return torch.minimum((self.uniform(*shape) * limits).long(), (limits - 1).clamp_min(0))

    def direction(self, *shape: int) -> Tensor:
        """Draw unit vectors (*shape, 3), even over the sphere."""
        return unit(self.normal(*shape, 3))

    def aside(self, direction: Tensor, angle: Tensor) -> Tensor:
        """Return unit vectors (..., 3) at angles (...) (radians) from ``direction``, to random sides."""
        aside = self.normal(*direction.shape)
        aside = unit(aside - (aside * direction).sum(-1, keepdim=True) * direction)
        return angle.cos()[..., None] * direction + angle.sin()[..., None] * aside

    def rotation(self, count: int) -> Tensor:
        """Draw rotations (count, 3, 3) uniformly from SO(3), by random unit quaternions."""
        w, x, y, z = unit(self.normal(count, 4)).unbind(1)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)

    def rows(self, mask: Tensor, count: int, *, every: bool = False) -> Tensor:
        """Draw ``count`` of the True columns of each row, with replacement.

        Args:
            mask: (R, N) bool.
            count: draws per row.
            every: rows with no more True columns than that give each of them, one after the other
                and over again.

        Returns:
            (R, count) int64 columns; of no meaning in rows without any True.
        """
        rank = mask.cumsum(dim=1)
        there = rank[:, -1:]
        wanted = self.below(there, len(mask), count)
        if every:
            in_order = torch.arange(count, device=self.device) % there.clamp_min(1)
            wanted = torch.where(there <= count, in_order, wanted)
        return torch.searchsorted(rank, wanted + 1).clamp_max(mask.shape[1] - 1)


def unit(vectors: Tensor) -> Tensor:
    """Scale (..., C) vectors to length 1; a zero vector stays zero."""
    return vectors / vectors.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-30)
