"""Pairs of virtual range scans: the training pairs that look most like users' files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.scan_pair import DegeneratePair, ScanPair, check_cloud, posed_pair
from utopic_cli.synthesis.scanner import DepthMap, depth_map, ray_noise
from utopic_cli.synthesis.settings import PairSettings, Range
from utopic_cli.synthesis.surface import (
    Mesh,
    bounding_diagonal,
    face_areas,
    face_normals,
    normalised,
    sample_faces,
)
from utopic_cli.synthesis.warp import SmoothWarp, compacting_stretch, random_stretch, random_warp

CELLS_ACROSS = 170  # grid cells to one extent: about 100 to 130 across an object as seen
SAMPLES_PER_CELL = 3.0  # of a surface seen straight on; fewer would leave holes in its front
ROUGH_CELLS_ACROSS = 50
ROUGH_SAMPLES = 10_000
CANDIDATE_VIEWS = 6
LEAST_POINTS = 500


@dataclass(frozen=True)
class WarpedSurface:
    """A dense sample of a whole object, with normals computed only where asked for.

    Attributes:
        points: (N, 3) float32 in the object's frame.
        rest_points: (N, 3) float32 before the warp.
        face: (N,) the mesh face of each sample.
        face_normals: (F, 3) float32 before the warp.
        warp: the warp, or None.
        extent: diagonal of the bounding box.
        cell: edge of a visibility cell that the sample fills without holes.
    """

    points: np.ndarray
    rest_points: np.ndarray
    face: np.ndarray
    face_normals: np.ndarray
    warp: SmoothWarp | None
    extent: float
    cell: float

    def normals(self, index: np.ndarray) -> np.ndarray:
        """Return the unit normals (K, 3) of samples ``index`` (K,), of either sign."""
        normals = self.face_normals.take(self.face.take(index), axis=0)
        if self.warp is None:
            return normals
        return self.warp.normals(self.rest_points.take(index, axis=0), normals)


def warped_surface(
    mesh: Mesh, rng: np.random.Generator, settings: PairSettings, samples: int
) -> WarpedSurface:
    """Stretch, sample and warp a mesh at random.

    Args:
        mesh: vertices (V, 3) and faces (F, 3).
        rng: source of randomness.
        settings: probabilities of stretch and warp.
        samples: size of the sample.
    """
    vertices, faces = normalised(mesh[0]), mesh[1]
    if rng.random() < settings.compact_probability:
        vertices = normalised(vertices @ compacting_stretch(vertices, rng.uniform(*settings.compact)))
    if rng.random() < settings.stretch_probability:
        vertices = normalised(vertices @ random_stretch(rng, settings.stretch))
    points, face = sample_faces(vertices, faces, samples, rng)
    warp = None
    moved = points
    if rng.random() < settings.warp_probability or maps_onto_itself(points, rng):
        extent = bounding_diagonal(points)
        warp = random_warp(rng, extent, rng.uniform(*settings.warp_strength))
        moved = warp(points)
    extent = bounding_diagonal(moved)
    area = float(face_areas(vertices, faces).sum()) * (1.0 if warp is None else 1.25)  # the warp adds area
    cell = max(extent / CELLS_ACROSS, float(np.sqrt(SAMPLES_PER_CELL * area / samples)))
    return WarpedSurface(moved, points, face, face_normals(vertices, faces), warp, extent, cell)


def maps_onto_itself(points: np.ndarray, rng: np.random.Generator) -> bool:
    """Tell whether half a turn about a principal axis maps a sampled surface onto itself.

    Args:
        points: (N, 3) sample of the surface.
        rng: draws the 1,000 points compared.
    """
    few = points[rng.permutation(len(points))[:2000]].astype(np.float64)
    few -= few.mean(axis=0)
    axes = np.linalg.eigh(few.T @ few)[1]
    probe, tree = few[:600] @ axes, cKDTree(few[600:] @ axes)
    spacing = tree.query(probe)[0].mean()
    turns = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    return any(tree.query(probe * turn)[0].mean() < 1.25 * spacing for turn in turns)


def range_scan_pair(
    mesh: Mesh,
    rng: np.random.Generator,
    settings: PairSettings | None = None,
    band: Range | None = None,
    *,
    whole: bool = False,
) -> ScanPair:
    """Scan one object from two sides and move the scans apart.

    The two scans share no point: they are drawn from disjoint halves of a dense sample.

    Args:
        mesh: vertices (V, 3) and faces (F, 3); winding and scale don't matter.
        rng: source of randomness.
        settings: probabilities and ranges; the training mixture's if None.
        band: overlap of the smaller side to aim at; drawn from ``settings.bands`` if None.
            The result can miss it: an object need not have such a pair of views.
        whole: let a sample of the whole object travel with the pair.

    Raises:
        DegeneratePair: too few visible points, overlap under the minimum, or drawn above
            ``thin_above`` and thinned out. Draw again.
    """
    settings = settings or PairSettings()
    fewest, most_points = np.log(settings.points)
    wanted = np.exp(rng.uniform(fewest, most_points, 2)).astype(int)
    per_point, least, most = settings.dense_samples
    surface = warped_surface(mesh, rng, settings, int(np.clip(per_point * wanted.sum(), least, most)))
    if band is None:
        band = settings.bands[rng.integers(len(settings.bands))]
    directions = _two_views(surface, rng, settings, float(rng.uniform(*band)))
    clouds: list[np.ndarray] = []
    viewpoints: list[np.ndarray | None] = []
    for half, (direction, count) in enumerate(zip(directions, wanted)):
        several = rng.random() < settings.several_views_probability
        views = [direction]
        if several:
            spread = np.radians(settings.several_views_spread)
            aside = rng.uniform(0.3, 1.0, rng.integers(1, 3)) * spread
            views += [_turned(direction, float(angle), rng) for angle in aside]
        clouds.append(_scan(surface, views, half, count, rng, settings))
        viewpoints.append(None if several else direction)
    pair = posed_pair(
        clouds[0],
        clouds[1],
        "range_scan",
        surface.extent,
        rng,
        translation=settings.translation,
        viewpoints=(viewpoints[0], viewpoints[1]),
        whole=surface.points if whole else None,
    )
    overlap = pair.smaller_overlap
    if overlap < settings.minimum_overlap:
        raise DegeneratePair(f"overlap {overlap:.2f} is under {settings.minimum_overlap:g}")
    if overlap > settings.thin_above and rng.random() >= settings.keep_above:
        raise DegeneratePair(f"overlap {overlap:.2f} was thinned out")
    return pair


def _two_views(
    surface: WarpedSurface, rng: np.random.Generator, settings: PairSettings, wanted_overlap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Choose two viewing directions whose scans overlap about as much as wanted.

    Overlap is foreseen from a rough visibility test of the same few samples under a handful
    of candidate directions.
    """
    index = np.arange(rng.integers(0, 8), len(surface.points), max(1, len(surface.points) // ROUGH_SAMPLES))
    points, normals = surface.points.take(index, axis=0), surface.normals(index)
    cell = max(surface.extent / ROUGH_CELLS_ACROSS, surface.cell * np.sqrt(len(surface.points) / len(index)))
    limit = float(np.mean(settings.grazing_cosine))

    everything = np.arange(len(index))

    def seen_from(direction: np.ndarray) -> np.ndarray:
        return depth_map(points, direction, float(cell)).seen(everything, normals, limit)[0]

    first = random_rotation(rng)[0]
    seen_first = seen_from(first)
    low, high = settings.view_angle
    steps = (np.arange(CANDIDATE_VIEWS) + rng.random(CANDIDATE_VIEWS)) / CANDIDATE_VIEWS
    candidates = [_turned(first, np.radians(low + (high - low) * step), rng) for step in steps]
    misses = []
    for direction in candidates:
        seen = seen_from(direction)
        larger = max(1, int(seen.sum()), int(seen_first.sum()))
        misses.append(abs(float((seen & seen_first).sum()) / larger - wanted_overlap))
    return first, candidates[int(np.argmin(misses))]


def _scan(
    surface: WarpedSurface,
    views: list[np.ndarray],
    half: int,
    count: int,
    rng: np.random.Generator,
    settings: PairSettings,
) -> np.ndarray:
    """Scan one half of the sample from one or more sides -> (N, 3) float64, object's frame."""
    share = -(-count // len(views))
    slanted = rng.random() < settings.slant_probability
    ramp = _unit(rng.standard_normal(3)) if rng.random() < settings.ramp_probability else None
    limit = rng.uniform(*settings.grazing_cosine)
    sigma = settings.noise[0] + (settings.noise[1] - settings.noise[0]) * rng.random() ** 2
    if settings.rough_probability > 0 and rng.random() < settings.rough_probability:
        sigma = rng.uniform(*settings.rough_noise)
    parts = []
    for direction in views:
        view = depth_map(surface.points, direction, surface.cell)
        index, cosine = _seen(surface, view, half, 2 * share, limit, rng)
        weight = cosine if slanted else np.ones(len(index))
        if ramp is not None:
            across = surface.points.take(index, axis=0) @ ramp / surface.extent
            weight = weight * np.exp(np.log(5.0) * np.clip(across + 0.5, 0.0, 1.0))
        # The smallest of Exp(1) / weight are a draw without replacement, weighted.
        chosen = index[np.argsort(rng.exponential(size=len(index)) / weight)[:share]]
        error = ray_noise(len(chosen), sigma * surface.extent, rng)
        parts.append(surface.points.take(chosen, axis=0) + error[:, None] * direction)
    points = np.concatenate(parts)
    if rng.random() < settings.hole_probability:
        points = _with_holes(points, surface.extent, rng, settings)
    check_cloud(points, LEAST_POINTS, surface.extent)
    if rng.random() < settings.outlier_probability:
        points = _with_outliers(points, views[0], surface.extent, rng, settings)
    return points.take(rng.permutation(len(points)), axis=0)


def _seen(
    surface: WarpedSurface, view: DepthMap, half: int, enough: int, limit: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return up to ``enough`` visible samples of one half, and their viewing cosines.

    Normals are the costly part, so the cheap depth test comes first, and no more samples
    than needed go on.
    """
    near = 2 * np.flatnonzero(view.near_front(slice(half, None, 2))) + half
    near = near[rng.permutation(len(near))[:enough]]
    seen, cosine = view.seen(near, surface.normals(near), limit)
    return near[seen], cosine[seen].astype(np.float64)


def _with_holes(
    points: np.ndarray, extent: float, rng: np.random.Generator, settings: PairSettings
) -> np.ndarray:
    """Take out 1 to 4 balls around points of the cloud."""
    keep = np.ones(len(points), dtype=bool)
    for _ in range(rng.integers(1, 5)):
        centre = points[rng.integers(len(points))] if len(points) else np.zeros(3)
        radius = rng.uniform(*settings.hole_radius) * extent
        keep &= np.square(points - centre).sum(axis=1) > radius**2
    return points[keep]


def _with_outliers(
    points: np.ndarray, direction: np.ndarray, extent: float, rng: np.random.Generator, settings: PairSettings
) -> np.ndarray:
    """Replace a few points: half by points flying on their own ray, half by any in the box."""
    count = int(rng.uniform(*settings.outlier_share) * len(points))
    which = rng.permutation(len(points))[:count]
    flying, stray = which[: count // 2], which[count // 2 :]
    points = points.copy()
    points[flying] -= rng.uniform(0.0, 0.15, len(flying))[:, None] * extent * direction
    points[stray] = rng.uniform(points.min(axis=0), points.max(axis=0), (len(stray), 3))
    return points


def _turned(direction: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Return a unit vector ``angle`` (radians) away from a unit vector, to a random side."""
    aside = rng.standard_normal(3)
    aside = _unit(aside - (aside @ direction) * direction)
    return np.cos(angle) * direction + np.sin(angle) * aside


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
