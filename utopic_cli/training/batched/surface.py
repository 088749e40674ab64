"""Many objects at once as dense samples of their stretched and warped surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from utopic_cli.synthesis.range_pairs import CELLS_ACROSS, SAMPLES_PER_CELL
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.warp import LONGEST_WAVE, SHORTEST_WAVE
from utopic_cli.training.batched.draws import Draws, unit
from utopic_cli.training.batched.meshes import MeshBatch
from utopic_cli.training.batched.ragged import cross, nearest_distance, product, turned

OCTAVES, WAVES_PER_OCTAVE = 5, 4
LEAST_AREA = 1e-6  # of a mesh within the unit sphere; less is rounding


@dataclass(frozen=True)
class Surfaces:
    """Dense samples of B whole objects, in random order.

    Attributes:
        points: (B, M, 3) float32 in the objects' frames.
        normals: (B, M, 3) unit normals of either sign.
        wanted: (B, M) bool; the other samples repeat the first one and don't count.
        extent: (B,) diagonal of the bounding box.
        cell: (B,) edge of a visibility cell that the sample fills without holes.
        sound: (B,) bool, False where the mesh has no area.
    """

    points: Tensor
    normals: Tensor
    wanted: Tensor
    extent: Tensor
    cell: Tensor
    sound: Tensor

    def __getitem__(self, rows: Tensor | slice) -> Surfaces:
        """Return some of the objects."""
        return Surfaces(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def extent_of(points: Tensor) -> Tensor:
    """Return the diagonal (B,) of the bounding boxes of points (B, N, 3), never quite zero."""
    return (points.amax(dim=1) - points.amin(dim=1)).square().sum(-1).sqrt().clamp_min(1e-6)


def normalised(vertices: Tensor) -> Tensor:
    """Centre (B, V, 3) on the bounding boxes and scale the farthest to norm 1."""
    centred = vertices - (vertices.amin(dim=1, keepdim=True) + vertices.amax(dim=1, keepdim=True)) / 2
    return centred / centred.norm(dim=2).amax(dim=1).clamp_min(1e-30)[:, None, None]


def sample_surfaces(meshes: MeshBatch, samples: Tensor, most: int, draws: Draws) -> Surfaces:
    """Sample meshes as they are, scaled to the unit sphere.

    Args:
        meshes: B meshes.
        samples: (B,) int64 points wanted of each.
        most: the largest of ``samples`` there can be.
        draws: source of randomness.
    """
    return _sampled(normalised(meshes.vertices), meshes, samples, most, draws)


def warped_surfaces(
    meshes: MeshBatch, samples: Tensor, most: int, draws: Draws, settings: PairSettings
) -> Surfaces:
    """Stretch, sample and warp meshes at random: the batched ``range_pairs.warped_surface``.

    Args:
        meshes: B meshes.
        samples: (B,) int64 points wanted of each.
        most: the largest of ``samples`` there can be.
        draws: source of randomness.
        settings: probabilities of stretch and warp.
    """
    count = len(meshes.vertices)
    vertices = normalised(meshes.vertices)
    stouter = compacting_stretch(
        vertices, meshes.vertex_mask, draws.uniform(count, **_range(settings.compact))
    )
    chosen = draws.chance(settings.compact_probability, count)[:, None, None]
    vertices = normalised(torch.where(chosen, turned(vertices, stouter), vertices))
    axes = draws.rotation(count)
    most_log = math.log(settings.stretch)
    factors = draws.uniform(count, 3, low=-most_log, high=most_log).exp()
    stretch = product(axes * factors[:, None], axes.transpose(1, 2))
    chosen = draws.chance(settings.stretch_probability, count)[:, None, None]
    vertices = normalised(torch.where(chosen, turned(vertices, stretch), vertices))
    rest = _sampled(vertices, meshes, samples, most, draws)
    warped = draws.chance(settings.warp_probability, count) | map_onto_themselves(rest.points[:, :2000])
    strength = draws.uniform(count, **_range(settings.warp_strength)) * warped
    points, normals = warp(rest.points, rest.normals, rest.extent, strength, draws)
    extent = extent_of(points)
    area_cell = rest.cell * torch.where(warped, math.sqrt(1.25), 1.0)  # the warp adds area
    cell = torch.maximum(extent / CELLS_ACROSS, area_cell)
    return Surfaces(points, normals, rest.wanted, extent, cell, rest.sound)


def _sampled(vertices: Tensor, meshes: MeshBatch, samples: Tensor, most: int, draws: Draws) -> Surfaces:
    """Draw points uniformly by area; ``cell`` is what the density alone asks for."""
    count, faces = meshes.faces.shape[:2]
    flat = (meshes.faces + vertices.shape[1] * torch.arange(count, device=draws.device)[:, None, None]).view(
        -1, 3
    )
    table = vertices.reshape(-1, 3)
    origin = table[flat[:, 0]]
    first, second = table[flat[:, 1]] - origin, table[flat[:, 2]] - origin
    crosses = cross(first, second)
    twice_area = crosses.norm(dim=1)
    cumulative = twice_area.view(count, faces).double().cumsum(dim=1)
    total = cumulative[:, -1:]
    face = torch.searchsorted(cumulative, draws.uniform(count, most) * total, right=True).clamp_max(faces - 1)
    wanted = torch.arange(most, device=draws.device) < samples[:, None]
    face = (face + faces * torch.arange(count, device=draws.device)[:, None]).view(-1)
    u = draws.uniform(2, count * most)
    u = torch.where(u.sum(dim=0) > 1.0, 1.0 - u, u)  # fold the square onto the triangle
    points = origin[face] + u[0, :, None] * first[face] + u[1, :, None] * second[face]
    points = points.view(count, most, 3)
    points = torch.where(wanted[..., None], points, points[:, :1])
    normals = unit(crosses)[face].view(count, most, 3)
    area = (total[:, 0] / 2).float()
    cell = (SAMPLES_PER_CELL * area / samples).sqrt()
    sound = (area > LEAST_AREA) & area.isfinite()
    return Surfaces(points, normals, wanted, extent_of(points), cell, sound)


def compacting_stretch(vertices: Tensor, mask: Tensor, most: Tensor) -> Tensor:
    """Return the (B, 3, 3) stretches that make rods and plates stouter; see ``warp.compacting_stretch``.

    Args:
        vertices: (B, V, 3) of the objects.
        mask: (B, V) bool, which of them count.
        most: (B,) largest ratio of principal standard deviations afterwards.
    """
    weight = (mask / mask.sum(dim=1, keepdim=True))[..., None]
    centred = vertices - (weight * vertices).sum(dim=1, keepdim=True)
    covariance = ((weight * centred)[..., :, None] * centred[..., None, :]).sum(dim=1)
    variance, axes = torch.linalg.eigh(covariance)
    deviation = torch.maximum(variance, 1e-6 * variance[:, 2:]).clamp_min(1e-30).sqrt()
    factors = (deviation[:, 2:] / most[:, None] / deviation).clamp_min(1.0)
    return product(axes * factors[:, None], axes.transpose(1, 2))


def map_onto_themselves(points: Tensor) -> Tensor:
    """Tell (B,) whether half a turn about a principal axis maps a sampled surface onto itself.

    Args:
        points: (B, 2000, 3) samples; 600 are turned, the rest compared with.
    """
    centred = points - points.mean(dim=1, keepdim=True)
    axes = torch.linalg.eigh((centred[..., :, None] * centred[..., None, :]).mean(dim=1))[1]
    centred = turned(centred, axes.transpose(1, 2))
    probe, others = centred[:, :600], centred[:, 600:]
    turns = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    distance = torch.stack([nearest_distance(probe * turn, others).mean(dim=1) for turn in turns])
    return (distance[1:] < 1.25 * distance[0]).any(dim=0)


def warp(
    points: Tensor, normals: Tensor, extent: Tensor, strength: Tensor, draws: Draws
) -> tuple[Tensor, Tensor]:
    """Warp surfaces smoothly at random; see ``warp.random_warp`` and ``SmoothWarp``.

    Args:
        points: (B, M, 3).
        normals: (B, M, 3) unit.
        extent: (B,) sizes of the objects.
        strength: (B,) amplitude over wavelength; 0 leaves an object as it is.
        draws: source of randomness.

    Returns:
        The warped points (B, M, 3) and the exact unit normals there (B, M, 3).
    """
    count, waves = len(points), OCTAVES * WAVES_PER_OCTAVE
    ratio = (SHORTEST_WAVE / LONGEST_WAVE) ** (1.0 / (OCTAVES - 1))
    lengths = LONGEST_WAVE * ratio ** torch.arange(OCTAVES, device=points.device) * extent[:, None]
    octave_strength = strength[:, None] * draws.uniform(count, OCTAVES, low=0.4, high=1.6)
    wavelength = lengths.repeat_interleave(WAVES_PER_OCTAVE, dim=1)
    wavelength = wavelength * draws.uniform(count, waves, low=0.85, high=1.15)
    amplitude = octave_strength.repeat_interleave(WAVES_PER_OCTAVE, dim=1) * wavelength
    amplitude = amplitude * math.sqrt(2.0 / WAVES_PER_OCTAVE)
    wave = draws.direction(count, waves) * (2.0 * math.pi / wavelength)[..., None]
    displacement = draws.direction(count, waves) * amplitude[..., None]
    phase = draws.uniform(count, waves, high=2.0 * math.pi)
    first, second = _tangents(normals)
    moved, pushed_first, pushed_second = points.clone(), first.clone(), second.clone()
    for k in range(waves):  # one wave at a time: a third of a gigabyte less for every ten objects
        along, by = wave[:, k, None], displacement[:, k, None]  # (B, 1, 3)
        angle = (points * along).sum(-1, keepdim=True) + phase[:, k, None, None]
        slope = angle.cos()
        moved += angle.sin() * by
        pushed_first += slope * (first * along).sum(-1, keepdim=True) * by
        pushed_second += slope * (second * along).sum(-1, keepdim=True) * by
    return moved, unit(cross(pushed_first, pushed_second))


def _tangents(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (..., 3) that complete unit normals to right-handed frames."""
    x, y, z = normals.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    return first, torch.stack([b, sign + y * y * a, -y], dim=-1)


def _range(limits: tuple[float, float]) -> dict[str, float]:
    return {"low": limits[0], "high": limits[1]}
