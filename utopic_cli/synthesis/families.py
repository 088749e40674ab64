"""Families of random parts beside free blends: slabs, lattices, profiles, lathe parts, symmetries.

Each takes grid nodes (R, R, R, 3) float32 and a generator, and returns a function that is
negative inside, within about 1 of the origin.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.implicit import (
    ball,
    bend,
    blend,
    box,
    carve,
    gyroid,
    limb,
    post,
    prism,
    ring,
    struts,
    twist,
)

_UPRIGHT = np.eye(3)
_ORIGIN = np.zeros(3)


def relief_slab(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A plate, flat or bent, with panels, an embossed pattern or strokes like letters on it."""
    local = bend(points, float(rng.choice([0.0, rng.uniform(-0.9, 0.9)])))
    halves = np.array([rng.uniform(0.6, 0.85), rng.uniform(0.4, 0.7), rng.uniform(0.12, 0.22)])
    flat = np.concatenate([local[..., :2], np.zeros_like(local[..., :1])], axis=-1)
    height = np.zeros(points.shape[:-1], dtype=np.float32)
    for motif in rng.choice(3, rng.integers(1, 4)):
        lift = rng.uniform(0.07, 0.16) * rng.choice([-0.6, 1.0])
        if motif == 0:
            outline = np.minimum.reduce([_panel(flat, halves, rng) for _ in range(rng.integers(2, 7))])
        elif motif == 1:
            outline = _strokes(flat, halves, rng)
        else:
            waves = rng.standard_normal((rng.integers(1, 3), 2))
            waves *= (rng.uniform(9.0, 16.0) / np.linalg.norm(waves, axis=1))[:, None]
            outline = 0.1 * np.cos(flat[..., :2] @ waves.T + rng.uniform(0, 6, len(waves))).prod(axis=-1)
        height += lift * np.clip(0.5 - outline / 0.08, 0.0, 1.0)
    body = box(local, _ORIGIN, halves + np.array([0.0, 0.0, 0.3]), _UPRIGHT, 0.02)
    slab = np.maximum(np.maximum(body, local[..., 2] - halves[2] - height), -local[..., 2] - halves[2])
    for _ in range(rng.integers(0, 3)):
        hole = (float(rng.uniform(-0.8, 0.8) * halves[0]), float(rng.uniform(-0.8, 0.8) * halves[1]))
        slab = carve(slab, post(local, hole, rng.uniform(0.08, 0.15), 1.0), 0.0)
    return slab


def lattice(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A body filled with a gyroid or with struts, with massive parts that hold it."""
    turn = random_rotation(rng)
    size = rng.uniform(0.55, 0.9, 3)
    body = ball(points, _ORIGIN, size, turn) if rng.random() < 0.5 else box(points, _ORIGIN, size, turn, 0.1)
    inner = (points + rng.uniform(-1.0, 1.0, 3).astype(np.float32)) @ random_rotation(rng).astype(np.float32)
    if rng.random() < 0.5:
        filling = gyroid(inner, rng.uniform(0.7, 1.1), rng.uniform(0.12, 0.2))
    else:
        filling = struts(inner, rng.uniform(0.4, 0.6), rng.uniform(0.07, 0.11))
    solid = np.maximum(body, filling)
    for _ in range(rng.integers(1, 4)):
        core = _feature(points, rng, points[_on_surface(points, solid, rng)], 1.5)
        solid = blend(solid, np.maximum(body, core), 0.04)
    if rng.random() < 0.4:  # a plate on one side
        way = random_rotation(rng)[0].astype(np.float32)
        solid = np.minimum(solid, np.maximum(body, np.abs(points @ way - 0.3 * size.min()) - 0.08))
    return solid


def extruded(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random profile, extruded, with holes, bosses and notches, then bent or twisted."""
    half_height = rng.uniform(0.15, 0.8)
    reach = np.sqrt(1.0 - half_height**2)
    local = points
    if half_height > 0.35:
        local = twist(local, rng.uniform(-2.0, 2.0) * rng.integers(0, 2))
        # The long axis is the third: bent as the first.
        local = bend(local[..., ::-1], rng.uniform(-1.0, 1.0) * rng.integers(0, 2))[..., ::-1]
    count = int(rng.integers(4, 10))
    angle = np.sort(2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count)
    radius = reach * rng.uniform(0.35, 1.0, count)
    corners = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    solid = prism(local, corners, half_height)
    for _ in range(rng.integers(0, 4)):
        spot = rng.uniform(-0.45, 0.45, 2) * reach
        hole = (float(spot[0]), float(spot[1]))
        if rng.random() < 0.6:
            solid = carve(solid, post(local, hole, rng.uniform(0.08, 0.18), 2.0), 0.0)
        else:
            boss = post(local, hole, rng.uniform(0.1, 0.2), half_height + rng.uniform(0.08, 0.2))
            solid = blend(solid, np.maximum(boss, -local[..., 2]), 0.03)
    for _ in range(rng.integers(1, 4)):
        centre = np.array([*(corners[rng.integers(count)] * 0.8), rng.uniform(-1, 1) * half_height])
        part = box(local, centre, rng.uniform(0.07, 0.25, 3), random_rotation(rng), 0.0)
        solid = carve(solid, part, 0.0) if rng.random() < 0.6 else blend(solid, part, 0.03)
    return solid


def lathe(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A turned part, massive or hollow, with a few features off its axis."""
    half_height = rng.uniform(0.4, 0.85)
    spacing = 2.0 * half_height / 5.0  # no flange thinner than the grid can hold
    knots = np.linspace(-half_height, half_height, 6) + spacing * rng.uniform(-0.25, 0.25, 6)
    radii = rng.uniform(0.18, 0.65, len(knots))
    height, out = points[..., 2], np.hypot(points[..., 0], points[..., 1])
    profile = np.interp(height, knots, radii)
    if rng.random() < 0.4:  # steps instead of cones
        profile = radii[np.clip(np.searchsorted(knots, height), 0, len(knots) - 1)]
    slope = 0.6  # cones are steep: what is left of a unit gradient
    solid = np.maximum((out - profile) * slope, np.abs(height) - half_height)
    if rng.random() < 0.5:
        wall = rng.uniform(0.12, 0.18)
        hollow = np.maximum((out - np.maximum(profile - wall, 0.05)) * slope, -half_height + 0.15 - height)
        solid = np.maximum(solid, -hollow)
    for _ in range(rng.integers(1, 4)):
        spot = int(rng.integers(len(knots)))
        angle = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        centre = 0.9 * radii[spot] * way + np.array([0.0, 0.0, 0.8 * knots[spot]])
        kind = rng.integers(4)
        if kind == 0:  # a handle
            turn = np.stack([way, [0.0, 0.0, 1.0], np.cross(way, [0.0, 0.0, 1.0])], axis=1)
            handle = ring(points, centre, turn, rng.uniform(0.2, 0.32), rng.uniform(0.06, 0.09))
            solid = blend(solid, np.maximum(handle, (0.5 * radii.min() - out)), 0.04)
        elif kind == 1:  # a spout
            end = centre + 0.35 * way + np.array([0.0, 0.0, rng.uniform(-0.2, 0.4)])
            solid = blend(solid, limb(points, centre, end, 0.13, rng.uniform(0.06, 0.12)), 0.04)
        elif kind == 2:  # a slot
            solid = carve(solid, box(points, centre, rng.uniform(0.08, 0.25, 3), _UPRIGHT, 0.0), 0.0)
        else:  # a lug
            lug = box(points, centre, rng.uniform(0.1, 0.25, 3), random_rotation(rng), 0.02)
            solid = blend(solid, lug, 0.03)
    return solid


def nearly_symmetric(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An n-fold or mirror symmetric part, broken by one or two small features."""
    folds = int(rng.choice([1, 2, 3, 4, 5, 6], p=[0.3, 0.15, 0.2, 0.15, 0.1, 0.1]))
    if folds == 1:
        local = np.concatenate([np.abs(points[..., :1]), points[..., 1:]], axis=-1)
    else:
        angle = np.arctan2(points[..., 1], points[..., 0])
        wedge = 2.0 * np.pi / folds
        angle = angle - wedge * np.round(angle / wedge)
        out = np.hypot(points[..., 0], points[..., 1])
        local = np.stack([out * np.cos(angle), out * np.sin(angle), points[..., 2]], axis=-1)
    size = np.array([*([rng.uniform(0.25, 0.5)] * 2), rng.uniform(0.2, 0.6)])
    solid = ball(points, _ORIGIN, size, _UPRIGHT)
    if rng.random() < 0.5:
        solid = post(points, (0.0, 0.0), float(size[0]), float(size[2]))
    for _ in range(rng.integers(2, 5)):
        part = _feature(local, rng, local[_on_surface(points, solid, rng)], 1.5)
        solid = carve(solid, part, 0.0) if rng.random() < 0.25 else blend(solid, part, 0.04)
    for _ in range(rng.integers(1, 3)):
        part = _feature(points, rng, points[_on_surface(points, solid, rng)], 0.9)
        solid = carve(solid, part, 0.0) if rng.random() < 0.4 else blend(solid, part, 0.02)
    return solid


def _on_surface(
    points: np.ndarray, solid: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw a grid node near the surface of a solid; returns its index."""
    cell = np.linalg.norm(points[1, 0, 0] - points[0, 0, 0])
    near = np.flatnonzero(np.abs(solid.ravel()) < cell)
    return np.unravel_index(rng.choice(near), solid.shape)  # type: ignore[return-value]


def _feature(points: np.ndarray, rng: np.random.Generator, centre: np.ndarray, scale: float) -> np.ndarray:
    """A ball, box or limb at a place (3,)."""
    centre = centre.astype(np.float64)
    kind = rng.integers(3)
    if kind == 0:
        return ball(points, centre, rng.uniform(0.1, 0.25, 3) * scale, random_rotation(rng))
    if kind == 1:
        return box(points, centre, rng.uniform(0.08, 0.22, 3) * scale, random_rotation(rng), 0.02)
    way = centre / max(float(np.linalg.norm(centre)), 1e-6) + 0.5 * rng.standard_normal(3)
    end = centre + 0.3 * scale * way
    return limb(points, centre, end, 0.12 * scale, 0.08 * scale)


def _panel(flat: np.ndarray, halves: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    centre = np.array([*(rng.uniform(-0.8, 0.8, 2) * halves[:2]), 0.0])
    size = np.array([*rng.uniform(0.08, 0.3, 2), 1.0])
    angle = rng.choice([0.0, rng.uniform(0.0, np.pi)])
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return box(flat, centre, size, turn, 0.0)


def _strokes(flat: np.ndarray, halves: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Several polylines of two or three strokes, side by side like letters of a word."""
    letters = int(rng.integers(2, 5))
    width = 1.6 * halves[0] / letters
    outline = np.full(flat.shape[:-1], np.inf, dtype=np.float32)
    for letter in range(letters):
        low = -0.8 * halves[0] + letter * width
        joints = np.stack(
            [low + width * rng.uniform(0.1, 0.85, 4), 0.75 * halves[1] * rng.uniform(-1, 1, 4), np.zeros(4)],
            1,
        )
        for a, b in pairwise(joints):
            outline = np.minimum(outline, limb(flat, a, b, 0.05, 0.05))
    return outline
