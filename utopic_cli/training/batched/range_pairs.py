"""Pairs of virtual range scans, many at once: the batched ``synthesis.range_pairs``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from utopic_cli.synthesis.range_pairs import (
    CANDIDATE_VIEWS,
    CELLS_ACROSS,
    LEAST_POINTS,
    ROUGH_CELLS_ACROSS,
    ROUGH_SAMPLES,
)
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.training.batched.draws import Draws
from utopic_cli.training.batched.meshes import MeshBatch
from utopic_cli.training.batched.raw_pairs import RawPairs, are_thick, smaller_overlap
from utopic_cli.training.batched.scanner import depth_maps
from utopic_cli.training.batched.surface import Surfaces, warped_surfaces

MOST_VIEWS = 3


def range_scan_pairs(meshes: MeshBatch, band: Tensor, draws: Draws, settings: PairSettings) -> RawPairs:
    """Scan each object from two sides.

    Args:
        meshes: B meshes.
        band: (B, 2) lower and upper end of the overlap aimed at.
        draws: source of randomness.
        settings: probabilities and ranges.
    """
    count = len(meshes.vertices)
    wanted = draws.log_uniform(count, 2, low=settings.points[0], high=settings.points[1]).long()
    per_point, least, most = settings.dense_samples
    samples = (per_point * wanted.sum(dim=1)).clamp(least, most)
    surfaces = warped_surfaces(meshes, samples, most + most % 2, draws, settings)
    overlap = band[:, 0] + (band[:, 1] - band[:, 0]) * draws.uniform(count)
    directions = choose_views(surfaces, samples, overlap, draws, settings)
    pairs = scan_pairs(surfaces, directions, wanted, draws, settings)
    pairs = pairs.but(surfaces.sound & are_thick(pairs, LEAST_POINTS))
    measured = smaller_overlap(pairs, draws)
    thinned = (measured > settings.thin_above) & ~draws.chance(settings.keep_above, count)
    return pairs.but((measured >= settings.minimum_overlap) & ~thinned)


def choose_views(
    surfaces: Surfaces, samples: Tensor, wanted_overlap: Tensor, draws: Draws, settings: PairSettings
) -> Tensor:
    """Choose two viewing directions (B, 2, 3) whose scans overlap about as much as wanted (B,).

    Overlap is foreseen from a rough visibility test of the same few samples under a handful of
    candidate directions.
    """
    count = len(surfaces.points)
    first = draws.direction(count)
    low, high = settings.view_angle
    steps = torch.arange(CANDIDATE_VIEWS, device=draws.device) + draws.uniform(count, CANDIDATE_VIEWS)
    angles = torch.deg2rad(low + (high - low) * steps / CANDIDATE_VIEWS)
    candidates = draws.aside(first[:, None].expand(-1, CANDIDATE_VIEWS, -1), angles)
    directions = torch.cat([first[:, None], candidates], dim=1)  # (B, C + 1, 3)
    views = directions.shape[1]
    few = slice(0, min(ROUGH_SAMPLES, surfaces.points.shape[1]))
    thinner = (samples / (few.stop - few.start)).sqrt()
    cell = torch.maximum(surfaces.extent / ROUGH_CELLS_ACROSS, surfaces.cell * thinner)
    limit = sum(settings.grazing_cosine) / 2.0

    def for_views(values: Tensor) -> Tensor:
        return values.repeat_interleave(views, dim=0)

    view = depth_maps(
        for_views(surfaces.points[:, few]), directions.reshape(-1, 3), for_views(cell), ROUGH_CELLS_ACROSS + 1
    )
    seen = view.seen(for_views(surfaces.normals[:, few]), limit)[0].view(count, views, -1)
    seen &= surfaces.wanted[:, None, few]
    both = (seen[:, 1:] & seen[:, :1]).sum(dim=2)
    larger = torch.maximum(seen[:, 1:].sum(dim=2), seen[:, :1].sum(dim=2)).clamp_min(1)
    best = (both / larger - wanted_overlap[:, None]).abs().argmin(dim=1)
    second = candidates[torch.arange(count, device=draws.device), best]
    return torch.stack([first, second], dim=1)


def scan_pairs(
    surfaces: Surfaces, directions: Tensor, wanted: Tensor, draws: Draws, settings: PairSettings
) -> RawPairs:
    """Scan the two halves of each sample from one or more sides each.

    Args:
        surfaces: B objects.
        directions: (B, 2, 3) of the first view of each side.
        wanted: (B, 2) int64 points.
        draws: source of randomness.
        settings: probabilities and ranges.
    """
    scans, device = 2 * len(surfaces.points), draws.device
    direction, wanted = directions.reshape(scans, 3), wanted.reshape(scans)
    several = draws.chance(settings.several_views_probability, scans)
    views = torch.where(several, 2 + draws.chance(0.5, scans).long(), 1)
    share = -(-wanted // views)
    limit = draws.uniform(scans, low=settings.grazing_cosine[0], high=settings.grazing_cosine[1])
    sigma = settings.noise[0] + (settings.noise[1] - settings.noise[0]) * draws.uniform(scans).square()
    low, high = settings.rough_noise
    rough = draws.chance(settings.rough_probability, scans)
    sigma = torch.where(rough, draws.uniform(scans, low=low, high=high), sigma)
    slanted = draws.chance(settings.slant_probability, scans)
    ramp = draws.direction(scans) * draws.chance(settings.ramp_probability, scans)[:, None]
    width = settings.points[1] + MOST_VIEWS
    points = torch.zeros(scans, width, 3, device=device)
    towards, mask = points.clone(), torch.zeros(scans, width, dtype=torch.bool, device=device)
    spread = math.radians(settings.several_views_spread)
    for number in range(MOST_VIEWS):
        scan = torch.arange(scans, device=device) if number == 0 else (views > number).nonzero()[:, 0]
        if len(scan) == 0:
            break
        seen_from = direction[scan]
        if number > 0:
            seen_from = draws.aside(seen_from, spread * draws.uniform(len(scan), low=0.3, high=1.0))
        rows, half = scan // 2, scan % 2
        own, extent = surfaces[rows], surfaces.extent[rows]
        view = depth_maps(own.points, seen_from, own.cell, CELLS_ACROSS + 1).half(half)
        mine, normals, counts = (_half(values, half) for values in (own.points, own.normals, own.wanted))
        near = view.near_front() & counts
        # Of twice as many candidates as wanted, those that are seen: as many as a costlier test
        # would have been spent on. Each is a candidate by itself, so their number varies a little.
        ease = 2 * share[scan] / near.sum(dim=1).clamp_min(1)
        candidate = near & (draws.uniform(*near.shape) < ease[:, None])
        seen, cosine = view.seen(normals, limit[scan])
        weight = torch.where(slanted[scan, None], cosine, 1.0)
        across = (mine * ramp[scan, None]).sum(-1) / extent[:, None]
        ramped = (ramp[scan] != 0).any(dim=1)[:, None]
        weight = weight * torch.where(ramped, 5.0 ** (across + 0.5).clamp(0.0, 1.0), 1.0)
        # The smallest of Exp(1) / weight are a draw without replacement, weighted.
        key = -torch.log1p(-draws.uniform(*near.shape)) / weight
        key = torch.where(candidate & seen, key, torch.inf)
        ordered, index = key.sort(dim=1)
        ordered, index = ordered[:, : int(width)], index[:, : int(width)]
        column = torch.arange(index.shape[1], device=device)
        taken = ordered.isfinite() & (column < share[scan, None])
        error = draws.normal(*index.shape).clamp(-3.0, 3.0) * (sigma[scan] * extent)[:, None]
        hit = mine.gather(1, index[..., None].expand(-1, -1, 3)) + error[..., None] * seen_from[:, None]
        place = (number * share[scan, None] + column)[taken]
        row = scan[:, None].expand_as(taken)[taken]
        points[row, place], mask[row, place] = hit[taken], True
        towards[row, place] = seen_from[:, None].expand_as(hit)[taken]
    both = surfaces.extent.repeat_interleave(2)
    mask = _with_holes(points, mask, both, draws, settings)
    points = _with_outliers(points, mask, direction, both, draws, settings)
    shape = (scans // 2, 2)
    return RawPairs(
        points.view(*shape, width, 3),
        mask.view(*shape, width),
        towards.view(*shape, width, 3),
        ~several.view(shape),
        draws.rotation(scans).view(*shape, 3, 3),
        surfaces.extent,
        torch.ones_like(surfaces.sound),
    )


def _half(values: Tensor, half: Tensor) -> Tensor:
    """Return the first or second half of each row (W, N, ...) by ``half`` (W,)."""
    count = len(values)
    split = values.view(count, 2, values.shape[1] // 2, *values.shape[2:])
    return split[torch.arange(count, device=half.device), half]


def _with_holes(points: Tensor, mask: Tensor, extent: Tensor, draws: Draws, settings: PairSettings) -> Tensor:
    """Take 1 to 4 balls around points of a cloud out of some masks (S, P)."""
    scans, most = len(points), 4
    centres = points.gather(1, draws.rows(mask, most)[..., None].expand(-1, -1, 3))
    radius = draws.uniform(scans, most, low=settings.hole_radius[0], high=settings.hole_radius[1])
    number = 1 + draws.below(torch.tensor(4, device=draws.device), scans, 1)
    number = number * draws.chance(settings.hole_probability, scans, 1)
    radius = torch.where(torch.arange(most, device=draws.device) < number, radius, 0.0) * extent[:, None]
    for hole in range(most):
        far = (points - centres[:, hole, None]).square().sum(-1) > radius[:, hole, None].square()
        mask = mask & (far | (radius[:, hole, None] == 0))
    return mask


def _with_outliers(
    points: Tensor, mask: Tensor, direction: Tensor, extent: Tensor, draws: Draws, settings: PairSettings
) -> Tensor:
    """Replace a few points (S, P, 3): half by points flying on their ray, half by any in the box.

    Each point is replaced by itself, so the number of outliers varies a little around the share.
    """
    low, high = settings.outlier_share
    share = draws.uniform(len(points), low=low, high=high)
    share = (share * draws.chance(settings.outlier_probability, len(points)))[:, None]
    chance = draws.uniform(*mask.shape)
    flying, stray = chance < share / 2, (chance >= share / 2) & (chance < share)
    lowest = torch.where(mask[..., None], points, torch.inf).amin(dim=1, keepdim=True)
    highest = torch.where(mask[..., None], points, -torch.inf).amax(dim=1, keepdim=True)
    back = draws.uniform(*mask.shape, high=0.15) * extent[:, None]
    flown = points - back[..., None] * direction[:, None]
    anywhere = lowest + (highest - lowest) * draws.uniform(*points.shape)
    points = torch.where(flying[..., None], flown, points)
    return torch.where((stray & mask)[..., None], anywhere, points)
