"""Exact meshes of symmetric solids, and of solids that one feature keeps from being so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.solids import SEGMENTS, box, extruded, joined, revolved
from utopic_cli.synthesis.surface import Mesh, sample_surface

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
