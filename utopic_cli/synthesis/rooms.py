"""Furnished rooms seen from within: mostly plain walls, which say that they overlap but not where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.synthesis.scan_pair import DegeneratePair, ScanPair, check_cloud, posed_pair
from utopic_cli.synthesis.scanner import ray_noise
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.synthesis.solids import box, extruded, joined
from utopic_cli.synthesis.surface import Mesh, bounding_diagonal, sample_surface

SAMPLES = 250_000
CELL = np.radians(1.5)  # angle that one ray of the scanner stands for
SLACK = 0.12  # of the range: what lies no farther behind the nearest thing is seen
NOISE = 0.001  # of the extent, at most
NEAREST = 0.5  # metres; what is nearer gets no more rays
SECTOR = (2.5, 5.0)  # radians that are left of every second scan
SHAPES_AMONG_FURNITURE = 0.6


@dataclass(frozen=True)
class Room:
    """A room about the origin, z up, in metres.

    Attributes:
        mesh: vertices and faces of the walls and of what stands before them.
        halves: (3,) half the room's sides.
    """

    mesh: Mesh
    halves: np.ndarray


def room_pair(
    library: ShapeLibrary, rng: np.random.Generator, settings: PairSettings, *, whole: bool = False
) -> ScanPair:
    """Scan a room furnished with boxes, cylinders and shapes of the library from two places.

    Args:
        library: the meshes.
        rng: source of randomness.
        settings: ``room_points``, ``translation`` and ``minimum_overlap``.
        whole: let a sample of the whole room travel with the pair.

    Raises:
        DegeneratePair: the scans overlap too little, or have too few points.
    """
    return scanned_twice(
        furnished_room(rng, library),
        rng,
        points=settings.room_points,
        least_overlap=settings.minimum_overlap,
        translation=settings.translation,
        whole=whole,
    )


def furnished_room(rng: np.random.Generator, library: ShapeLibrary | None = None) -> Room:
    """Make a room with 5 to 10 things on its floor and walls.

    Args:
        rng: source of randomness.
        library: more than half of the things are its shapes; all are boxes and cylinders if None.
    """
    halves = np.array([rng.uniform(1.5, 4.0), rng.uniform(1.5, 4.0), rng.uniform(1.2, 1.6)])
    parts = [box(halves)]
    for _ in range(rng.integers(5, 11)):
        size = rng.uniform(0.15, 0.6, 3) * np.array([1.0, 1.0, 1.3])
        if library is not None and rng.random() < SHAPES_AMONG_FURNITURE:
            vertices, faces = _fitted(library.mesh(library.draw(rng)), size)
        elif rng.random() < 0.3:
            turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
            vertices, faces = extruded(size[0] * np.column_stack([np.cos(turn), np.sin(turn)]), size[2])
        else:
            vertices, faces = box(size)
        yaw = float(rng.choice([0.0, rng.uniform(0.0, np.pi)]))
        turned = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
        )
        place = np.array([*rng.uniform(-1.0, 1.0, 2) * (halves[:2] - 0.3), size[2] - halves[2]])
        if rng.random() < 0.3:  # a cupboard on a wall
            side = int(rng.integers(2))
            place[side] = rng.choice([-1.0, 1.0]) * halves[side]
            place[2] = rng.uniform(-0.3, 0.8) * halves[2]
        # Nothing reaches through a wall.
        parts.append((np.clip(vertices @ turned.T + place, -halves, halves), faces))
    return Room(joined(*parts), halves)


def scanned_twice(
    room: Room,
    rng: np.random.Generator,
    *,
    points: tuple[int, int],
    least_overlap: float,
    translation: float = 1.0,
    whole: bool = False,
) -> ScanPair:
    """Scan a room all round from two places, some of the scans cut to a sector.

    Args:
        room: what is scanned.
        rng: source of randomness.
        points: fewest and most points of a scan, log-uniform.
        least_overlap: of the side that has less of it.
        translation: each scan is moved by up to this much along each axis (times the extent).
        whole: let a sample of the whole room travel with the pair.

    Raises:
        DegeneratePair: the scans overlap too little, or have too few points.
    """
    extent = bounding_diagonal(room.mesh[0])
    source, target = (_scanned(room, extent, rng, points) for _ in range(2))
    everything = sample_surface(*room.mesh, SAMPLES, rng.spawn(1)[0])[0] if whole else None
    pair = posed_pair(source, target, "room", extent, rng, translation=translation, whole=everything)
    if pair.smaller_overlap < least_overlap:
        raise DegeneratePair(f"overlap {pair.smaller_overlap:.2f} is under {least_overlap:g}")
    return pair


def seen_from_within(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Tell which points (N, 3) of a dense sample a scanner at ``place`` (3,) sees all round -> (N,) bool.

    The nearest range in and around each cell of a map of longitude and latitude hides what is
    farther by more than ``SLACK`` of it.
    """
    rays = points - place
    distance = np.linalg.norm(rays, axis=1)
    across, up = round(2.0 * np.pi / CELL), round(np.pi / CELL)
    column = ((np.arctan2(rays[:, 1], rays[:, 0]) / (2.0 * np.pi) + 0.5) * across).astype(int) % across
    row = np.minimum((np.arccos(np.clip(rays[:, 2] / distance, -1.0, 1.0)) / np.pi * up).astype(int), up - 1)
    nearest = np.full((up, across), np.inf)
    np.minimum.at(nearest, (row, column), distance)
    around = np.pad(np.pad(nearest, ((0, 0), (1, 1)), mode="wrap"), ((1, 1), (0, 0)), mode="edge")
    nearest = np.minimum.reduce([around[i : i + up, j : j + across] for i in range(3) for j in range(3)])
    return distance <= nearest[row, column] * (1.0 + SLACK)


def _scanned(room: Room, extent: float, rng: np.random.Generator, counts: tuple[int, int]) -> np.ndarray:
    place = rng.uniform(-0.7, 0.7, 3) * room.halves
    place[2] = rng.uniform(-0.3, 0.3) * room.halves[2]
    points = sample_surface(*room.mesh, SAMPLES, rng)[0].astype(np.float64)
    points = points[seen_from_within(points, place)]
    rays = points - place
    if rng.random() < 0.5:
        yaw = (np.arctan2(rays[:, 1], rays[:, 0]) + rng.uniform(0.0, 2.0 * np.pi)) % (2.0 * np.pi)
        kept = yaw < rng.uniform(*SECTOR)
        points, rays = points[kept], rays[kept]
    distance = np.linalg.norm(rays, axis=1)
    # Rays spread evenly over the angles, so the density falls with the square of the distance.
    order = np.argsort(rng.exponential(size=len(points)) * np.maximum(distance, NEAREST) ** 2)
    chosen = order[: int(np.exp(rng.uniform(*np.log(counts))))]
    error = ray_noise(len(chosen), rng.uniform(0.0, NOISE) * extent, rng)
    points = points[chosen] + (error / distance[chosen])[:, None] * rays[chosen]
    check_cloud(points, counts[0], extent)
    return points


def _fitted(mesh: Mesh, size: np.ndarray) -> Mesh:
    """Scale a mesh to half the height ``size[2]``, less if wide, and stand it that far under the origin."""
    vertices, faces = mesh
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    halves = np.maximum((high - low) / 2.0, 1e-9)
    scaled = (vertices - (low + high) / 2.0) * min(size[2] / halves[2], size.max() / halves.max())
    scaled[:, 2] -= scaled[:, 2].min() + size[2]
    return scaled, faces
