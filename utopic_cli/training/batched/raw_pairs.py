"""Pairs of clouds in one frame, before they are moved apart and sampled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from utopic_cli.synthesis.scan_pair import COMPARED_POINTS, MEASURED_POINTS, OVERLAP_RADIUS
from utopic_cli.training.batched.draws import Draws
from utopic_cli.training.batched.ragged import nearest_distance, squared_distances


@dataclass(frozen=True)
class RawPairs:
    """B pairs of clouds of one object each, still aligned. Side 0 is the source, side 1 the target.

    Attributes:
        points: (B, 2, P, 3) float32 in the object's frame.
        mask: (B, 2, P) bool, which of them are there.
        towards: (B, 2, P, 3) a direction on the visible side of the surface at each point: towards
            the scanner that saw it.
        one_side: (B, 2) bool, whether the whole cloud was seen from one side.
        rotation: (B, 2, 3, 3) from the object's frame to each cloud's own.
        extent: (B,) diagonal of the object's bounding box.
        good: (B,) bool, whether the pair may be used.
    """

    points: Tensor
    mask: Tensor
    towards: Tensor
    one_side: Tensor
    rotation: Tensor
    extent: Tensor
    good: Tensor

    def __getitem__(self, rows: Tensor | slice) -> RawPairs:
        """Return some of the pairs."""
        return RawPairs(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def widened(self, points: int) -> RawPairs:
        """Return the same clouds with room for ``points`` points each."""
        more = points - self.points.shape[2]
        rows = torch.nn.functional.pad
        return replace(
            self,
            points=rows(self.points, (0, 0, 0, more)),
            mask=rows(self.mask, (0, more)),
            towards=rows(self.towards, (0, 0, 0, more)),
        )

    def but(self, good: Tensor) -> RawPairs:
        """Return the pairs with ``good`` (B,) as another condition."""
        return replace(self, good=self.good & good)


def joined(parts: list[RawPairs]) -> RawPairs:
    """Put batches of pairs into one."""
    most = max(part.points.shape[2] for part in parts)
    wide = [part.widened(most) for part in parts]
    return RawPairs(
        *(torch.cat([getattr(part, name) for part in wide]) for name in RawPairs.__dataclass_fields__)
    )


def are_thick(pairs: RawPairs, least: int) -> Tensor:
    """Tell (B,) which pairs' clouds have ``least`` points, not all of them near a line."""
    weight = (pairs.mask / pairs.mask.sum(dim=2, keepdim=True).clamp_min(1))[..., None]
    centred = pairs.points - (weight * pairs.points).sum(dim=2, keepdim=True)
    x, y, z = centred.unbind(-1)
    products = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    xx, xy, xz, yy, yz, zz = ((weight[..., 0] * a * b).sum(dim=2) for a, b in products)
    covariance = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).view(-1, 2, 3, 3)
    spread = torch.linalg.eigvalsh(covariance)[..., 1].clamp_min(0.0).sqrt()  # (B, 2)
    enough = pairs.mask.sum(dim=2) >= least
    return (enough & (spread >= 0.01 * pairs.extent[:, None])).all(dim=1)


def smaller_overlap(pairs: RawPairs, draws: Draws) -> Tensor:
    """Measure (B,) the overlap ratio of the side that has less of it; see ``measure_overlap``.

    As many points are compared as there, drawn with replacement.
    """
    shares = []
    for side in (0, 1):
        own = _picked(pairs, side, draws.rows(pairs.mask[:, side], MEASURED_POINTS))
        other = _picked(pairs, 1 - side, draws.rows(pairs.mask[:, 1 - side], COMPARED_POINTS, every=True))
        radius = torch.maximum(OVERLAP_RADIUS * pairs.extent, 2.0 * _spacing(other, draws))
        shares.append((nearest_distance(own, other) < radius[:, None]).float().mean(dim=1))
    return torch.minimum(*shares)


def _picked(pairs: RawPairs, side: int, columns: Tensor) -> Tensor:
    return pairs.points[:, side].gather(1, columns[..., None].expand(-1, -1, 3))


def _spacing(points: Tensor, draws: Draws) -> Tensor:
    """Median distance (B,) of 300 points to the nearest other one (B, N, 3)."""
    some = points[:, draws.below(torch.tensor(points.shape[1], device=draws.device), 300)]
    squared = squared_distances(some, points)
    # A point that was drawn twice is one point.
    return torch.where(squared > 0, squared, torch.inf).amin(dim=2).sqrt().median(dim=1).values
