"""Exact meshes of symmetric solids, and of solids that one feature keeps from being so.

A mesh is vertices (V, 3) float64 and faces (F, 3) int64, about the origin, of radius about 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.range_pairs import Mesh
from utopic_cli.synthesis.surface import sample_surface

SEGMENTS = 180  # round things are off by less than a thousandth of their radius
ENDLESS = 3.0  # half the length of what has no ends


@dataclass(frozen=True)
class Solid:
    """A mesh that some motions map onto itself.

    Attributes:
        name: what it is.
        mesh: vertices and faces.
        endless: axes along which a scan shows a window only, never the ends.
    """

    name: str
    mesh: Mesh
    endless: tuple[int, ...] = ()


def symmetric_solid(rng: np.random.Generator) -> Solid:
    """Draw one of ``SYMMETRIC`` in random proportions."""
    name = list(SYMMETRIC)[rng.integers(len(SYMMETRIC))]
    make, endless = SYMMETRIC[name]
    return Solid(name, make(rng), endless)


def nearly_symmetric_solid(rng: np.random.Generator) -> Solid:
    """Draw a symmetric solid with ends and give it one feature: a knob, a block, a handle or a notch."""
    names = [name for name, (_, endless) in SYMMETRIC.items() if not endless]
    name = names[rng.integers(len(names))]
    base = SYMMETRIC[name][0](rng)
    feature = ("knob", "block", "handle")[rng.integers(3)]
    if name in _OUTLINES and rng.random() < 0.4:
        return Solid(f"{name} with a notch", extruded(_notched(_OUTLINES[name](rng), rng), _height(rng)))
    place = sample_surface(*base, 64, rng)[0][rng.integers(64)].astype(np.float64)
    if feature == "knob":
        part = _ball(rng.uniform(0.12, 0.3))
    elif feature == "block":
        part = box(rng.uniform(0.1, 0.3, 3))
    else:
        part = _ring(rng.uniform(0.2, 0.35), rng.uniform(0.05, 0.09))
    vertices = part[0] @ random_rotation(rng).T + place
    return Solid(f"{name} with a {feature}", joined(base, (vertices, part[1])))


def box(halves: np.ndarray) -> Mesh:
    """Return a box about the origin by its half edges (3,)."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.asarray(halves)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])


def revolved(profile: np.ndarray) -> Mesh:
    """Turn a profile (K, 2), rows (radius, height), about the third axis."""
    turn = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rings = [np.column_stack([radius * circle, np.full(SEGMENTS, height)]) for radius, height in profile]
    return np.concatenate(rings), _between_rings(len(profile), SEGMENTS)


def extruded(outline: np.ndarray, half_height: float, *, capped: bool = True) -> Mesh:
    """Extrude an outline (K, 2), star-shaped about the origin, along the third axis."""
    count = len(outline)
    ends = [np.column_stack([outline, np.full(count, height)]) for height in (-half_height, half_height)]
    vertices, faces = np.concatenate(ends), _between_rings(2, count)
    if not capped:
        return vertices, faces
    around, after = np.arange(count), np.roll(np.arange(count), -1)
    bottom = np.column_stack([np.full(count, 2 * count), after, around])
    top = np.column_stack([np.full(count, 2 * count + 1), around + count, after + count])
    centres = np.array([[0.0, 0.0, -half_height], [0.0, 0.0, half_height]])
    return np.concatenate([vertices, centres]), np.concatenate([faces, bottom, top])


def joined(*meshes: Mesh) -> Mesh:
    """Return several meshes as one; what of them lies inside others no scanner sees."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([faces + start for (_, faces), start in zip(meshes, starts)]),
    )


def _between_rings(rings: int, count: int) -> np.ndarray:
    """Faces of a tube of rings of ``count`` vertices each."""
    ring, place = np.meshgrid(np.arange(rings - 1), np.arange(count), indexing="ij")
    a, b = ring * count + place, ring * count + (place + 1) % count
    quads = np.stack([a, b, b + count, a + count], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _height(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.2, 0.9))


def _plane(rng: np.random.Generator) -> Mesh:
    corners = ENDLESS * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def _ball(radius: float) -> Mesh:
    angle = np.linspace(0.0, np.pi, SEGMENTS // 2)
    return revolved(radius * np.column_stack([np.sin(angle), -np.cos(angle)]))


def _ring(radius: float, thickness: float) -> Mesh:
    angle = np.linspace(0.0, 2.0 * np.pi, SEGMENTS // 2)
    return revolved(np.column_stack([radius + thickness * np.cos(angle), thickness * np.sin(angle)]))


def _cylinder(rng: np.random.Generator) -> Mesh:
    radius, half = rng.uniform(0.25, 0.8), _height(rng)
    return revolved(np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]]))


def _cone(rng: np.random.Generator) -> Mesh:
    bottom, half = rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9)
    top = bottom * float(rng.choice([0.0, rng.uniform(0.2, 0.7)]))  # pointed, or cut off
    return revolved(np.array([[0.0, -half], [bottom, -half], [top, half], [0.0, half]]))


def _turned(rng: np.random.Generator) -> Mesh:
    count = int(rng.integers(5, 10))
    height = np.linspace(-0.85, 0.85, count)
    radius = rng.uniform(0.2, 0.7, count)
    return revolved(np.column_stack([[0.0, *radius, 0.0], [-0.85, *height, 0.85]]))


def _regular(corners: int, radius: float) -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(corners) / corners
    return radius * np.column_stack([np.cos(turn), np.sin(turn)])


def _hexagon(rng: np.random.Generator) -> np.ndarray:
    return _regular(6, rng.uniform(0.4, 0.8))


def _toothed(rng: np.random.Generator) -> np.ndarray:
    """The outline of a gear with 12 to 36 teeth."""
    radius = np.tile([1.0, 1.0, 0.0, 0.0], int(rng.integers(12, 37))) * rng.uniform(0.06, 0.16) + 0.75
    return _regular(len(radius), 1.0) * radius[:, None]


def _free_outline(rng: np.random.Generator) -> np.ndarray:
    return _regular(12, 1.0) * rng.uniform(0.3, 0.8, 12)[:, None]


def _notched(outline: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Push a part of an outline (K, 2) inwards."""
    corners = np.concatenate([outline, outline[:1]])
    share = np.linspace(0.0, 1.0, 240 // len(outline) + 1, endpoint=False)[:, None, None]
    fine = (corners[:-1] + share * (corners[1:] - corners[:-1])).transpose(1, 0, 2).reshape(-1, 2)
    width = int(len(fine) * rng.uniform(0.06, 0.12))
    fine[:width] *= rng.uniform(0.55, 0.8)
    return fine


_OUTLINES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "hexagonal prism": _hexagon,
    "gear": _toothed,
}

SYMMETRIC: dict[str, tuple[Callable[[np.random.Generator], Mesh], tuple[int, ...]]] = {
    "plane": (_plane, (0, 1)),
    "sphere": (lambda rng: _ball(1.0), ()),
    "cylinder": (_cylinder, ()),
    "pipe": (lambda rng: extruded(_regular(SEGMENTS, rng.uniform(0.3, 0.7)), ENDLESS, capped=False), (2,)),
    "cone": (_cone, ()),
    "torus": (lambda rng: _ring(rng.uniform(0.5, 0.8), rng.uniform(0.12, 0.3)), ()),
    "cube": (lambda rng: box(np.full(3, 0.6)), ()),
    "box": (lambda rng: box(rng.uniform(0.2, 0.9, 3)), ()),
    "hexagonal prism": (lambda rng: extruded(_hexagon(rng), _height(rng)), ()),
    "gear": (lambda rng: extruded(_toothed(rng), rng.uniform(0.1, 0.3)), ()),
    "surface of revolution": (_turned, ()),
    "extruded profile": (lambda rng: extruded(_free_outline(rng), ENDLESS, capped=False), (2,)),
}
"""How each is made, and the axes along which it has no ends."""
