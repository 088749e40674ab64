"""The virtual range scanner of ``synthesis.scanner``, for many views at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from utopic_cli.synthesis.scanner import STEEPEST
from utopic_cli.training.batched.draws import unit
from utopic_cli.training.batched.ragged import cross, turned


@dataclass(frozen=True)
class DepthMaps:
    """W dense samples, each seen along an orthographic line of sight.

    Attributes:
        frame: (W, 3, 3) rows: right, up, and the direction towards the scanner.
        cell: (W,) edge length of a grid cell across the line of sight.
        local: (W, N, 3) the samples in the frames; the third coordinate is the height.
        cells: (W, N) int64 the grid cell of each sample, of all W grids in a row.
        front: (W * cells, 3) the front-most sample of each cell, in the frames; of no meaning where empty.
        occluder: (W * cells,) height of the surface in and around each cell: the fourth highest
            of 3 x 3.
    """

    frame: Tensor
    cell: Tensor
    local: Tensor
    cells: Tensor
    front: Tensor
    occluder: Tensor

    def half(self, number: Tensor) -> DepthMaps:
        """Ask only about the first (0) or second (1) half of each view's samples, by ``number`` (W,)."""
        views, samples = self.cells.shape
        each = torch.arange(views, device=number.device)
        local = self.local.view(views, 2, samples // 2, 3)[each, number]
        return replace(self, local=local, cells=self.cells.view(views, 2, samples // 2)[each, number])

    def near_front(self) -> Tensor:
        """Cheap first cut: which samples (W, N) can be visible, without normals."""
        lowest = self.occluder[self.cells] - self.cell[:, None] * (1.5 + 1.1 * STEEPEST)
        return self.local[..., 2] >= lowest

    def seen(self, normals: Tensor, minimum_cosine: Tensor | float) -> tuple[Tensor, Tensor]:
        """Tell which samples belong to the front surface and are not seen too grazingly.

        The rules are those of ``synthesis.scanner.DepthMap.seen``.

        Args:
            normals: (W, N, 3) unit normals of either sign, in the samples' own frame.
            minimum_cosine: (W,) or one for all.

        Returns:
            seen: (W, N) bool.
            cosine: (W, N) of the viewing angle, not negative.
        """
        facing = turned(normals, self.frame)
        facing = torch.where(facing[..., 2:] < 0, -facing, facing)
        cosine = facing[..., 2]
        bounded = cosine.clamp(1.0 / STEEPEST, 1.0)
        slope = (1.0 - bounded.square()).sqrt() / bounded
        rise = (facing * (self.front[self.cells] - self.local)).sum(-1)
        cell = self.cell[:, None]
        on_top = rise <= cell * (0.25 + 0.35 * bounded)
        on_top &= self.local[..., 2] >= self.occluder[self.cells] - cell * (1.5 + 1.1 * slope)
        if isinstance(minimum_cosine, Tensor):
            minimum_cosine = minimum_cosine[:, None]
        return on_top & (cosine > minimum_cosine), cosine


def view_frames(direction: Tensor) -> Tensor:
    """Return (W, 3, 3) rows right, up, and the unit ``direction`` (W, 3) towards the scanner."""
    helper = torch.eye(3, device=direction.device)[direction.abs().argmin(dim=1)]
    right = unit(cross(helper, direction))
    return torch.stack([right, cross(direction, right), direction], dim=1)


def depth_maps(points: Tensor, direction: Tensor, cell: Tensor, side: int) -> DepthMaps:
    """Project dense samples along lines of sight.

    Args:
        points: (W, N, 3) samples of whole surfaces, about 3 or more to a cell.
        direction: (W, 3) unit vectors towards the scanners, far away.
        cell: (W,) edge length of a grid cell.
        side: no bounding box is wider than this many cells.
    """
    views, samples = points.shape[:2]
    frame = view_frames(direction)
    local = turned(points, frame)
    low = local.amin(dim=1, keepdim=True)
    # The clamps keep an object of no size, which is thrown away later, from pointing anywhere.
    at = ((local - low)[..., :2] / cell.clamp_min(1e-9)[:, None, None]).long().clamp(0, side)
    wide = side + 3  # one empty cell around the grid, which has side + 1
    cells = (at[..., 0] + 1) * wide + at[..., 1] + 1
    cells += wide * wide * torch.arange(views, device=points.device)[:, None]
    flat = cells.view(-1)
    height = torch.full((views * wide * wide,), -torch.inf, device=points.device)
    heights = local[..., 2].reshape(-1)
    height.scatter_reduce_(0, flat, heights, "amax")
    number = torch.arange(views * samples, device=points.device)
    top = torch.zeros(views * wide * wide, dtype=torch.int64, device=points.device)
    top.scatter_reduce_(0, flat, torch.where(heights == height[flat], number, 0), "amax")
    front = local.reshape(-1, 3)[top]
    occluder = _fourth_highest(height.view(views, wide, wide)).view(-1)
    return DepthMaps(frame, cell, local, cells, front, occluder)


def _fourth_highest(height: Tensor) -> Tensor:
    """Return the fourth highest (W, S, S) of each cell's 3 x 3 surroundings; the rim is empty."""
    ranks = [torch.full_like(height, -torch.inf) for _ in range(4)]
    around = torch.nn.functional.pad(height, (1, 1, 1, 1), value=-torch.inf)
    side = height.shape[1]
    for i in range(3):
        for j in range(3):
            value = around[:, i : i + side, j : j + side]
            for rank in range(4):  # insert it into the four highest so far
                ranks[rank], value = torch.maximum(ranks[rank], value), torch.minimum(ranks[rank], value)
    return ranks[3]
