"""Pairs cut from samples of whole surfaces, many at once: the batched ``synthesis.surface_pairs``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.surface_pairs import OUTSIDE_SAMPLES, OUTSIDE_VIEWS
from utopic_cli.training.batched.draws import Draws
from utopic_cli.training.batched.meshes import MeshBatch
from utopic_cli.training.batched.ragged import product, rotations
from utopic_cli.training.batched.raw_pairs import RawPairs, are_thick, smaller_overlap
from utopic_cli.training.batched.scanner import depth_maps
from utopic_cli.training.batched.surface import (
    Surfaces,
    extent_of,
    normalised,
    sample_surfaces,
    warped_surfaces,
)

OUTSIDE_CELLS = 55
PATCH_SAMPLES = 60_000
LEAST_PATCH_POINTS = 500


def surface_pairs(meshes: MeshBatch, shared: Tensor, draws: Draws, settings: PairSettings) -> RawPairs:
    """Crop samples of whole surfaces by half-spaces and jitter them (the paper's Sec. 4.1).

    Args:
        meshes: B meshes.
        shared: (B,) bool: both clouds are crops of one sample, or of two.
        draws: source of randomness.
        settings: the ``surface_*`` ranges.
    """
    count, device = len(shared), draws.device
    keep = draws.uniform(count, low=settings.surface_keep[0], high=settings.surface_keep[1])
    wanted = draws.log_uniform(count, low=settings.surface_points[0], high=settings.surface_points[1]).long()
    sigma = draws.uniform(count, low=settings.surface_noise[0], high=settings.surface_noise[1])
    samples = torch.full((count,), OUTSIDE_SAMPLES, device=device)
    surfaces = sample_surfaces(meshes, samples, OUTSIDE_SAMPLES, draws)
    outer, outward = outer_normals(surfaces)
    enough = outer.sum(dim=1) >= 2 * wanted
    # A sample is in random order already: the first of those seen from outside are as good as any.
    most = settings.surface_points[1]
    index = torch.where(outer, torch.arange(OUTSIDE_SAMPLES, device=device), OUTSIDE_SAMPLES)
    index = index.sort(dim=1).values.clamp_max(OUTSIDE_SAMPLES - 1)
    # Every point seen fixes the scale; samples not seen stand at one that is.
    inside = outer.any(dim=1)[:, None] & ~outer
    somewhere = surfaces.points.gather(1, index[:, :1, None].expand(-1, -1, 3))
    points = normalised(torch.where(inside[..., None], somewhere, surfaces.points))
    place = torch.arange(most, device=device)[None].expand(count, -1)
    second = place + torch.where(shared, 0, wanted)[:, None]
    chosen = torch.stack([place, second], dim=1).view(count, -1)
    chosen = index.gather(1, chosen)[..., None].expand(-1, -1, 3)
    clouds = points.gather(1, chosen).view(count, 2, most, 3)
    towards = outward.gather(1, chosen).view(count, 2, most, 3)
    there = (place < wanted[:, None])[:, None].expand(-1, 2, -1)
    along = (clouds * draws.direction(count, 2)[:, :, None]).sum(-1)
    kept = (keep * wanted).round().long().clamp_min(1)
    mask = _lowest(-along, there, kept[:, None].expand(-1, 2))
    clip = settings.surface_clip
    clouds = clouds + (draws.normal(*clouds.shape) * sigma[:, None, None, None]).clamp(-clip, clip)
    nothing = torch.zeros(count, 2, dtype=torch.bool, device=device)
    if settings.surface_rotations == "euler45":
        rotation = torch.eye(3, device=device).repeat(count, 2, 1, 1)
        rotation[:, 0] = paper_rotations(count, draws).transpose(1, 2)
    else:
        rotation = draws.rotation(2 * count).view(count, 2, 3, 3)
    good = surfaces.sound & enough
    pairs = RawPairs(clouds, mask, towards, nothing, rotation, extent_of(points), good)
    return pairs.but(smaller_overlap(pairs, draws) >= settings.minimum_overlap)


def patch_pairs(meshes: MeshBatch, draws: Draws, settings: PairSettings) -> RawPairs:
    """Cut two overlapping dense patches out of each whole (stretched, warped) surface.

    Args:
        meshes: B meshes.
        draws: source of randomness.
        settings: the ``patch_*`` ranges, stretch, warp and noise.
    """
    count, device = len(meshes.vertices), draws.device
    samples = torch.full((count,), PATCH_SAMPLES, device=device)
    surfaces = warped_surfaces(meshes, samples, PATCH_SAMPLES, draws, settings)
    outer, outward = outer_normals(surfaces)
    first = surfaces.points.gather(1, draws.rows(outer, 1)[..., None].expand(-1, -1, 3))[:, 0]
    reach = draws.uniform(count, low=0.1, high=0.6) * surfaces.extent
    centres = torch.stack([first, first + draws.direction(count) * reach[:, None]], dim=1)
    shape = (count, 2, PATCH_SAMPLES // 2)
    points, normals = surfaces.points.view(*shape, 3), outward.view(*shape, 3)
    mine = outer.view(shape)
    keep = draws.uniform(count, 2, low=settings.patch_keep[0], high=settings.patch_keep[1])
    kept = (keep * mine.sum(dim=2)).round().long()
    mask = _lowest((points - centres[:, :, None]).square().sum(-1), mine, kept)
    low, high = settings.patch_points
    wanted = draws.log_uniform(count, 2, low=low, high=high).long()
    mask = _lowest(draws.uniform(*shape), mask, wanted)
    sigma = settings.noise[1] * draws.uniform(count, 2).square() * surfaces.extent[:, None]
    jitter = draws.normal(*points.shape) * (sigma / math.sqrt(3.0))[..., None, None]
    limit = 3.0 * sigma[..., None, None]
    nothing = torch.zeros(count, 2, dtype=torch.bool, device=device)
    points = points + jitter.clamp(-limit, limit)
    rotation = draws.rotation(2 * count).view(count, 2, 3, 3)
    pairs = RawPairs(points, mask, normals, nothing, rotation, surfaces.extent, surfaces.sound)
    pairs = pairs.but(are_thick(pairs, LEAST_PATCH_POINTS))
    return pairs.but(smaller_overlap(pairs, draws) >= settings.minimum_overlap)


def paper_rotations(count: int, draws: Draws) -> Tensor:
    """Draw the paper's rotations (count, 3, 3): each Euler angle uniform in 0 to 45 degrees."""
    rotation = torch.eye(3, device=draws.device).repeat(count, 1, 1)
    for axis in range(3):  # about x, then y, then z
        vectors = torch.zeros(count, 3, device=draws.device)
        vectors[:, axis] = draws.uniform(count, high=math.pi / 4.0)
        rotation = product(rotations(vectors), rotation)
    return rotation


def outer_normals(surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """Tell which samples some scanner outside can see, and on which side; see ``is_outer``.

    Returns:
        outer: (B, M) bool.
        outward: (B, M, 3) unit normals; those of outer samples face a scanner that sees them.
    """
    device, count = surfaces.points.device, len(surfaces.points)
    number = torch.arange(OUTSIDE_VIEWS, device=device) + 0.5  # directions spread by a Fibonacci spiral
    height = 1.0 - 2.0 * number / OUTSIDE_VIEWS
    turn = math.pi * (1.0 + math.sqrt(5.0)) * number
    ring = (1.0 - height.square()).sqrt()
    directions = torch.stack([ring * turn.cos(), ring * turn.sin(), height], dim=1)
    cell = extent_of(surfaces.points) / OUTSIDE_CELLS
    outer = torch.zeros_like(surfaces.wanted)
    outward = surfaces.normals.clone()
    for direction in directions:
        view = depth_maps(surfaces.points, direction.expand(count, 3), cell, OUTSIDE_CELLS + 1)
        seen = view.seen(surfaces.normals, 0.2)[0] & surfaces.wanted & ~outer
        turned_away = seen & ((surfaces.normals * direction).sum(-1) < 0)
        outward = torch.where(turned_away[..., None], -surfaces.normals, outward)
        outer |= seen
    return outer, outward


def _lowest(key: Tensor, mask: Tensor, count: Tensor) -> Tensor:
    """Keep of each row's True columns (..., N) the ``count`` (...) with the lowest keys."""
    key = torch.where(mask, key, torch.inf)
    ordered = key.sort(dim=-1).values
    last = ordered.gather(-1, (count - 1).clamp(0, key.shape[-1] - 1)[..., None])
    return mask & (key <= last) & (count > 0)[..., None]
