"""Trials of things whose geometry misleads: symmetric solids, nearly symmetric ones, rooms."""

from __future__ import annotations

import numpy as np

from utopic_cli.benchmark.labelled import Trial, with_answer
from utopic_cli.benchmark.solids import (
    Solid,
    box,
    extruded,
    joined,
    nearly_symmetric_solid,
    symmetric_solid,
)
from utopic_cli.synthesis.range_pairs import Mesh
from utopic_cli.synthesis.scan_pair import DegeneratePair, check_cloud, posed_pair
from utopic_cli.synthesis.scanner import range_scan, ray_noise
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.synthesis.surface import bounding_diagonal, face_areas, sample_surface

LEAST_POINTS, MOST_POINTS = 2_000, 20_000
SAMPLES = 120_000
LEAST_OVERLAP = 0.15
ROOM_SAMPLES = 250_000
ROOM_CELL = np.radians(1.5)  # angle that one ray of the scanner in a room stands for
ROOM_SLACK = 0.12  # of the range: what lies no farther behind the nearest thing is seen


def symmetric(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Two scans of a symmetric solid, or two windows of an endless plane, pipe or profile.

    The label goes by the true motion like everywhere else; many others fit as well, so the right
    one is hit by luck only.
    """
    return _scanned(symmetric_solid(rng), "symmetric", rng)


def near_symmetric(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Two scans of a symmetric solid with one feature, which both, one or none of them may show."""
    return _scanned(nearly_symmetric_solid(rng), "near-symmetric", rng)


def room(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Two panoramic views from two places inside one furnished room, some cut to a sector."""
    mesh, halves = furnished_room(rng)
    extent = bounding_diagonal(mesh[0])
    clouds = []
    for _ in range(2):
        place = rng.uniform(-0.7, 0.7, 3) * halves
        place[2] = rng.uniform(-0.3, 0.3) * halves[2]
        points = sample_surface(*mesh, ROOM_SAMPLES, rng)[0].astype(np.float64)
        points = points[seen_from_within(points, place)]
        rays = points - place
        if rng.random() < 0.5:
            yaw = (np.arctan2(rays[:, 1], rays[:, 0]) + rng.uniform(0.0, 2.0 * np.pi)) % (2.0 * np.pi)
            kept = yaw < rng.uniform(2.5, 5.0)
            points, rays = points[kept], rays[kept]
        distance = np.linalg.norm(rays, axis=1)
        # Rays spread evenly over the angles, so the density falls with the square of the distance.
        order = np.argsort(rng.exponential(size=len(points)) * np.maximum(distance, 0.5) ** 2)
        chosen = order[: _count(rng)]
        error = ray_noise(len(chosen), rng.uniform(0.0, 0.001) * extent, rng)
        points = points[chosen] + (error / distance[chosen])[:, None] * rays[chosen]
        check_cloud(points, LEAST_POINTS, extent)
        clouds.append(points)
    pair = posed_pair(clouds[0], clouds[1], "room", extent, rng, translation=1.0)
    if pair.smaller_overlap < LEAST_OVERLAP:
        raise DegeneratePair(f"overlap {pair.smaller_overlap:.2f} is under {LEAST_OVERLAP:g}")
    return with_answer("room", pair, "room")


def furnished_room(rng: np.random.Generator) -> tuple[Mesh, np.ndarray]:
    """Make a room with 5 to 10 boxes and cylinders on its floor and walls.

    Returns:
        mesh: vertices and faces, z up, about the room's middle.
        halves: (3,) half the room's sides.
    """
    halves = np.array([rng.uniform(1.5, 4.0), rng.uniform(1.5, 4.0), rng.uniform(1.2, 1.6)])
    parts = [box(halves)]
    for _ in range(rng.integers(5, 11)):
        size = rng.uniform(0.15, 0.6, 3) * np.array([1.0, 1.0, 1.3])
        if rng.random() < 0.3:
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
    return joined(*parts), halves


def seen_from_within(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Tell which points (N, 3) of a dense sample a scanner at ``place`` (3,) sees all round -> (N,) bool.

    The nearest range in and around each cell of a map of longitude and latitude hides what is
    farther by more than ``ROOM_SLACK`` of it.
    """
    rays = points - place
    distance = np.linalg.norm(rays, axis=1)
    across, up = round(2.0 * np.pi / ROOM_CELL), round(np.pi / ROOM_CELL)
    column = ((np.arctan2(rays[:, 1], rays[:, 0]) / (2.0 * np.pi) + 0.5) * across).astype(int) % across
    row = np.minimum((np.arccos(np.clip(rays[:, 2] / distance, -1.0, 1.0)) / np.pi * up).astype(int), up - 1)
    nearest = np.full((up, across), np.inf)
    np.minimum.at(nearest, (row, column), distance)
    around = np.pad(np.pad(nearest, ((0, 0), (1, 1)), mode="wrap"), ((1, 1), (0, 0)), mode="edge")
    nearest = np.minimum.reduce([around[i : i + up, j : j + across] for i in range(3) for j in range(3)])
    return distance <= nearest[row, column] * (1.0 + ROOM_SLACK)


def _scanned(solid: Solid, kind: str, rng: np.random.Generator) -> Trial:
    """Scan a solid twice from independent sides, with little noise."""
    vertices, faces = solid.mesh
    axes = list(solid.endless)
    window = rng.uniform(1.2, 2.0, len(axes))
    middle = rng.uniform(-1.0, 1.0, len(axes))
    clouds = []
    for scan in range(2):
        view = rng.standard_normal(3)
        view[axes] *= 0.3  # an endless thing is not seen along itself
        view /= np.linalg.norm(view)
        if len(axes) == 2:
            view *= np.sign(view[2])  # both see the same side of a plane
        points, normals = sample_surface(vertices, faces, SAMPLES, rng)
        if scan:
            middle = middle + rng.uniform(0.15, 0.8) * window * rng.choice([-1.0, 1.0], len(axes))
        inside = (np.abs(points[:, axes] - middle) < window / 2.0).all(axis=1)
        points, normals = points[inside], normals[inside]
        extent = bounding_diagonal(points)
        area = float(face_areas(vertices, faces).sum())
        cell = max(extent / 170.0, float(np.sqrt(3.0 * area / SAMPLES)))
        noise = float(rng.choice([0.0, rng.uniform(0.0, 0.003)])) * extent
        seen = range_scan(points, normals, view, rng, cell=cell, count=_count(rng), noise=noise)
        check_cloud(seen.points, LEAST_POINTS, extent)
        clouds.append(seen.points)
    pair = posed_pair(clouds[0], clouds[1], kind, extent, rng, translation=1.0)
    if pair.smaller_overlap < LEAST_OVERLAP:
        raise DegeneratePair(f"overlap {pair.smaller_overlap:.2f} is under {LEAST_OVERLAP:g}")
    return with_answer(kind, pair, solid.name)


def _count(rng: np.random.Generator) -> int:
    return int(np.exp(rng.uniform(*np.log([LEAST_POINTS, MOST_POINTS]))))
