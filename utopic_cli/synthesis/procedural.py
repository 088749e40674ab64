"""Random solids with detail: blended, carved, embossed. No file needed."""

from __future__ import annotations

import numpy as np

from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.implicit import ball, blend, box, carve, grid_points, limb, ring, surface_net
from utopic_cli.synthesis.warp import random_warp


def procedural_mesh(rng: np.random.Generator, resolution: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Make a random object: a body, parts grown onto it, cuts, and a relief on its surface.

    Args:
        rng: source of randomness.
        resolution: grid nodes along each side of the object; time grows with its cube.

    Returns:
        vertices: (V, 3) float64, about the origin, radius 1 or less.
        faces: (F, 3) int64, wound outwards.
    """
    points = grid_points(resolution)
    bent = random_warp(rng, 2.0, rng.uniform(0.01, 0.03), octaves=2)(points.reshape(-1, 3))
    bent = bent.reshape(points.shape)
    solid = _body(bent, rng)
    for _ in range(rng.integers(3, 9)):
        solid = blend(solid, _part(bent, solid, points, rng), rng.choice([0.0, 0.04, 0.12]))
    for _ in range(rng.integers(0, 3)):
        solid = carve(solid, _part(bent, solid, points, rng, 0.7), rng.choice([0.0, 0.05]))
    solid = solid + _relief(bent, rng)
    margin = 0.12  # keeps the solid off the grid's border, as a rounded cut if it must
    solid = np.maximum(solid, np.sqrt(np.einsum("...d,...d->...", points, points)) - (1.2 - margin))
    return surface_net(solid, points)


def _body(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    turn = random_rotation(rng)
    size = rng.uniform(0.25, 0.6, 3)
    if rng.random() < 0.6:
        return ball(points, np.zeros(3), size, turn)
    return box(points, np.zeros(3), size, turn, 0.3 * rng.random() * size.min())


def _part(
    bent: np.ndarray, solid: np.ndarray, points: np.ndarray, rng: np.random.Generator, scale: float = 1.0
) -> np.ndarray:
    """A limb, ring, ball or box that starts somewhere on the present surface."""
    surface = np.flatnonzero(np.abs(solid.ravel()) < 2.5 * (points[1, 0, 0, 0] - points[0, 0, 0, 0]))
    centre = bent.reshape(-1, 3)[rng.choice(surface)].astype(np.float64)
    outward = centre / max(float(np.linalg.norm(centre)), 1e-6)
    turn = random_rotation(rng)
    kind = rng.choice(4, p=[0.4, 0.15, 0.25, 0.2])
    if kind == 0:
        way = outward + 0.6 * rng.standard_normal(3)
        end = centre + way / np.linalg.norm(way) * rng.uniform(0.2, 0.6) * scale
        return limb(bent, centre, end, rng.uniform(0.05, 0.18) * scale, rng.uniform(0.02, 0.14) * scale)
    if kind == 1:
        return ring(bent, centre, turn, rng.uniform(0.12, 0.3) * scale, rng.uniform(0.04, 0.08) * scale)
    size = rng.uniform(0.08, 0.3, 3) * scale
    if kind == 2:
        return ball(bent, centre, size, turn)
    return box(bent, centre, size, turn, 0.2 * size.min())


def _relief(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ridges and bumps on part of the surface, a few hundredths high."""
    relief = np.zeros(points.shape[:-1], dtype=np.float32)
    for _ in range(rng.integers(1, 4)):
        where = points - rng.uniform(-0.6, 0.6, 3).astype(np.float32)
        reach = np.exp(-np.einsum("...d,...d->...", where, where) / rng.uniform(0.1, 0.6))
        waves = rng.standard_normal((rng.integers(1, 4), 3)).astype(np.float32)
        waves *= (rng.uniform(12.0, 32.0) / np.linalg.norm(waves, axis=1))[:, None].astype(np.float32)
        pattern = np.cos(points @ waves.T).prod(axis=-1)
        relief += np.float32(rng.uniform(0.005, 0.025)) * reach * pattern
    return relief
