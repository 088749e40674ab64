"""Pairs of scans from within furnished rooms, many at once: the batched ``synthesis.rooms``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from utopic_cli.synthesis.rooms import CELL, NEAREST, NOISE, SAMPLES, SECTOR, SLACK
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.training.batched.draws import Draws, unit
from utopic_cli.training.batched.meshes import MeshBatch
from utopic_cli.training.batched.raw_pairs import RawPairs, are_thick, smaller_overlap
from utopic_cli.training.batched.surface import extent_of, sample_surfaces


def room_pairs(meshes: MeshBatch, draws: Draws, settings: PairSettings) -> RawPairs:
    """Scan each room all round from two places, some of the scans cut to a sector.

    Args:
        meshes: B rooms about the origin, z up, in metres.
        draws: source of randomness.
        settings: ``room_points`` and ``minimum_overlap``.
    """
    count, device = len(meshes.vertices), draws.device
    halves, extent = meshes.vertices.amax(dim=1), extent_of(meshes.vertices)
    least, most = settings.room_points
    clouds, masks, towards = [], [], []
    sound = torch.ones(count, dtype=torch.bool, device=device)
    for _ in range(2):
        surfaces = sample_surfaces(meshes, torch.full((count,), SAMPLES, device=device), SAMPLES, draws)
        points = surfaces.points * (extent / 2.0)[:, None, None]  # back from the unit sphere
        place = draws.uniform(count, 3, low=-0.7, high=0.7) * halves
        place[:, 2] = draws.uniform(count, low=-0.3, high=0.3) * halves[:, 2]
        rays = points - place[:, None]
        distance = rays.square().sum(-1).sqrt()
        turn = draws.uniform(count, 1, high=2.0 * math.pi)
        yaw = (torch.atan2(rays[..., 1], rays[..., 0]) + turn) % (2.0 * math.pi)
        sector = draws.uniform(count, low=SECTOR[0], high=SECTOR[1])
        sector = torch.where(draws.chance(0.5, count), sector, 7.0)
        seen = seen_from_within(rays, distance) & (yaw < sector[:, None])
        # Rays spread evenly over the angles, so the density falls with the square of the distance.
        key = -torch.log1p(-draws.uniform(*distance.shape)) * distance.clamp_min(NEAREST).square()
        ordered, index = torch.where(seen, key, torch.inf).sort(dim=1)
        wanted = draws.log_uniform(count, low=least, high=most).long()
        columns = torch.arange(min(most, SAMPLES), device=device)
        mask = ordered[:, : len(columns)].isfinite() & (columns < wanted[:, None])
        index = index[:, : len(columns), None].expand(-1, -1, 3)
        sight = unit(rays.gather(1, index))
        sigma = draws.uniform(count, high=NOISE) * extent
        error = draws.normal(*mask.shape).clamp(-3.0, 3.0) * sigma[:, None]
        clouds.append(points.gather(1, index) + error[..., None] * sight)
        masks.append(mask)
        towards.append(-sight)
        sound &= surfaces.sound
    pairs = RawPairs(
        torch.stack(clouds, dim=1),
        torch.stack(masks, dim=1),
        torch.stack(towards, dim=1),
        torch.zeros(count, 2, dtype=torch.bool, device=device),
        draws.rotation(2 * count).view(count, 2, 3, 3),
        extent,
        sound,
    )
    pairs = pairs.but(are_thick(pairs, least))
    return pairs.but(smaller_overlap(pairs, draws) >= settings.minimum_overlap)


def seen_from_within(rays: Tensor, distance: Tensor) -> Tensor:
    """Tell (B, N) which points of dense samples scanners inside see; see ``synthesis.rooms``.

    Args:
        rays: (B, N, 3) from each scanner to the points.
        distance: (B, N) their lengths.
    """
    across, up = round(2.0 * math.pi / CELL), round(math.pi / CELL)
    column = ((torch.atan2(rays[..., 1], rays[..., 0]) / (2.0 * math.pi) + 0.5) * across).long() % across
    height = (rays[..., 2] / distance.clamp_min(1e-9)).clamp(-1.0, 1.0)
    row = (height.acos() / math.pi * up).long().clamp_max(up - 1)
    cell = row * across + column
    nearest = torch.full((len(rays), up * across), torch.inf, device=rays.device)
    nearest.scatter_reduce_(1, cell, distance, "amin")
    around = nearest.view(-1, up, across)
    around = torch.cat([around[:, :, -1:], around, around[:, :, :1]], dim=2)
    around = torch.cat([around[:, :1], around, around[:, -1:]], dim=1)
    windows = [around[:, i : i + up, j : j + across] for i in range(3) for j in range(3)]
    nearest = torch.stack(windows).amin(dim=0).view(-1, up * across)
    return distance <= nearest.gather(1, cell) * (1.0 + SLACK)
