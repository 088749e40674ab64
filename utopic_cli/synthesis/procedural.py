"""Random solids rich in detail, of several families. No file needed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import label

from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.families import extruded, lathe, lattice, nearly_symmetric, relief_slab
from utopic_cli.synthesis.implicit import ball, blend, box, carve, grid_points, limb, ring, surface_net
from utopic_cli.synthesis.surface import normalised
from utopic_cli.synthesis.warp import random_warp

_RADIUS = 1.08  # the grid ends at 1.2; what is beyond is cut off, round


def blended(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A body, parts grown onto it, cuts, and a relief on its surface."""
    bent = _warped(points, rng, rng.uniform(0.01, 0.03), 2)
    solid = _body(bent, rng)
    for _ in range(rng.integers(3, 9)):
        solid = blend(solid, _part(bent, solid, points, rng), rng.choice([0.0, 0.04, 0.12]))
    for _ in range(rng.integers(0, 3)):
        solid = carve(solid, _part(bent, solid, points, rng, 0.7), rng.choice([0.0, 0.05]))
    return solid + _relief(bent, rng)


def displaced(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A blend in a strongly warped space, its surface displaced by several octaves of waves."""
    bent = _warped(points, rng, rng.uniform(0.03, 0.06), 3)
    solid = _body(bent, rng)
    for _ in range(rng.integers(2, 6)):
        solid = blend(solid, _part(bent, solid, points, rng, 1.3), 0.15)
    height, ridged = rng.uniform(0.03, 0.06), rng.random() < 0.5
    for wave in (7.0, 12.0, 20.0):
        waves = rng.standard_normal((3, 3)).astype(np.float32)
        waves *= (wave / np.linalg.norm(waves, axis=1))[:, None].astype(np.float32)
        bumps = np.sin(bent @ waves.T + rng.uniform(0, 6, 3).astype(np.float32)).mean(axis=-1)
        solid = solid - height * ((1.0 - 2.0 * np.abs(bumps)) if ridged else 1.7 * bumps)
        height *= 0.5
    return solid


# Shares of the families that ``procedural_mesh`` draws from.
FAMILIES: dict[str, tuple[float, Callable[[np.ndarray, np.random.Generator], np.ndarray]]] = {
    "blended": (0.25, blended),
    "displaced": (0.15, displaced),
    "relief_slab": (0.12, relief_slab),
    "lattice": (0.1, lattice),
    "extruded": (0.15, extruded),
    "lathe": (0.11, lathe),
    "nearly_symmetric": (0.12, nearly_symmetric),
}


def procedural_mesh(
    rng: np.random.Generator, resolution: int = 64, family: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Make a random object: closed, in one piece, of a family drawn by the shares of ``FAMILIES``.

    Args:
        rng: source of randomness.
        resolution: grid nodes along each side of the object; time grows with its cube.
        family: make one of this family.

    Returns:
        vertices: (V, 3) float64, radius 1 about the centre of their bounding box.
        faces: (F, 3) int64, wound outwards.
    """
    names = list(FAMILIES)
    drawn = str(rng.choice(names, p=[share for share, _ in FAMILIES.values()]))
    make = FAMILIES[family or drawn][1]
    points = grid_points(resolution)
    turned = points @ random_rotation(rng).astype(np.float32)
    solid = make(turned, rng)
    solid = np.maximum(solid, np.sqrt(np.einsum("...d,...d->...", points, points)) - _RADIUS)
    vertices, faces = surface_net(_largest_piece(solid), points)
    return normalised(vertices), faces


def _largest_piece(solid: np.ndarray) -> np.ndarray:
    """Drop what a cut or a part beside the body left floating."""
    pieces, count = label(solid < 0)
    if count <= 1:
        return solid
    largest = np.argmax(np.bincount(pieces.ravel())[1:]) + 1
    return np.where((solid < 0) & (pieces != largest), -solid, solid)


def _warped(points: np.ndarray, rng: np.random.Generator, strength: float, octaves: int) -> np.ndarray:
    warp = random_warp(rng, 2.0, strength, octaves=octaves)
    return warp(points.reshape(-1, 3)).reshape(points.shape)


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
    cell = np.linalg.norm(points[1, 0, 0] - points[0, 0, 0])
    surface = np.flatnonzero(np.abs(solid.ravel()) < 2.5 * cell)
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
