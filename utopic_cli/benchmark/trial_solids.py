"""Trials of things whose geometry misleads: symmetric solids, nearly symmetric ones, rooms."""

from __future__ import annotations

import numpy as np

from utopic_cli.benchmark.labelled import Trial, with_answer
from utopic_cli.benchmark.solids import Solid, nearly_symmetric_solid, symmetric_solid
from utopic_cli.synthesis.rooms import furnished_room, scanned_twice
from utopic_cli.synthesis.scan_pair import DegeneratePair, check_cloud, posed_pair
from utopic_cli.synthesis.scanner import range_scan
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.synthesis.surface import bounding_diagonal, face_areas, sample_surface

LEAST_POINTS, MOST_POINTS = 2_000, 20_000
SAMPLES = 120_000
LEAST_OVERLAP = 0.15


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
    """Two panoramic views from two places inside one room furnished with boxes and cylinders."""
    room = furnished_room(rng)
    pair = scanned_twice(room, rng, points=(LEAST_POINTS, MOST_POINTS), least_overlap=LEAST_OVERLAP)
    return with_answer("room", pair, "room")


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
