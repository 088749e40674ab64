"""Pairs cut from samples of a whole surface: the paper's protocols, and dense patches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from utopic_cli.geometry.rigid import invert, rigid
from utopic_cli.synthesis.crops import half_space_crop, nearest_crop
from utopic_cli.synthesis.range_pairs import warped_surface
from utopic_cli.synthesis.scan_pair import DegeneratePair, ScanPair, check_cloud, posed_pair
from utopic_cli.synthesis.scanner import depth_map
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.surface import Mesh, bounding_diagonal, normalised, sample_surface
from utopic_cli.synthesis.warp import SmoothWarp

OUTSIDE_SAMPLES = 30_000
OUTSIDE_VIEWS = 14


def surface_pair(
    mesh: Mesh,
    rng: np.random.Generator,
    sampling: str = "independent",
    keep: float = 0.7,
    *,
    count: int = 1024,
    noise: float = 0.01,
    clip: float = 0.05,
    rotations: str = "uniform",
    sample: np.ndarray | None = None,
    relief: SmoothWarp | None = None,
    whole: bool = False,
) -> ScanPair:
    """Make a pair by the paper's protocol (Sec. 4.1): sample, crop by half-spaces, jitter, move.

    The object is scaled to the unit sphere; ``keep * count`` points are left on each side
    (0.7: ModelNet, 717 points; 0.5: ModelLoNet, 512 points). The source is moved only as
    ``rotations`` says; the target stays in the object's frame under ``euler45``.

    Args:
        mesh: vertices (V, 3) and faces (F, 3).
        rng: source of randomness.
        sampling: ``shared`` (one sample, both clouds are crops of it: the paper's figures)
            or ``independent`` (two samples of the surface: what scanners do).
        keep: share of the points each crop keeps.
        count: points sampled.
        noise: standard deviation of the jitter per coordinate, in radii.
        clip: the jitter is cut off at this.
        rotations: ``uniform`` over SO(3) for both clouds, or ``euler45`` (the paper's: each
            Euler angle uniform in 0 to 45 degrees, translation uniform within 0.5).
        sample: (S, 3) points to draw from instead of the mesh's surface, in the mesh's frame and
            already of the scale wanted (a data set that gives points).
        relief: bends the sampled surface, of an object of extent 2; not for points that are given.
        whole: let a sample of the whole object travel with the pair.

    Returns:
        The pair; with ``shared`` sampling it says which points are the same.

    Raises:
        ValueError: unknown ``sampling`` or ``rotations``.
        DegenerateShape: the mesh has no area, or too little of it is seen from outside.
    """
    if sampling not in ("shared", "independent"):
        raise ValueError(f"sampling is {sampling!r}; expected 'shared' or 'independent'")
    if rotations not in ("uniform", "euler45"):
        raise ValueError(f"rotations is {rotations!r}; expected 'uniform' or 'euler45'")
    if sample is None:
        surface = sample_surface(normalised(mesh[0]), mesh[1], OUTSIDE_SAMPLES, rng)
        points = outer_points(
            *(surface if relief is None else (relief(surface[0]), relief.normals(*surface)))
        )
        points = dense = normalised(points[rng.permutation(len(points))].astype(np.float64))
    else:
        points = sample[rng.permutation(len(sample))].astype(np.float64)
        dense = sample_surface(*mesh, OUTSIDE_SAMPLES, rng.spawn(1)[0])[0] if whole else points
    if len(points) < 2 * count:
        raise DegeneratePair(
            f"only {len(points)} points of the surface are seen or given; {2 * count} are needed"
        )
    first = points[:count]
    second = first if sampling == "shared" else points[count : 2 * count]
    clouds, indices = [], []
    for cloud in (first, second):
        direction = rng.standard_normal(3)
        index = rng.permutation(half_space_crop(cloud, direction, keep))
        clouds.append(cloud[index] + jitter((len(index), 3), noise, clip, rng))
        indices.append(index)
    motions = None
    if rotations == "euler45":
        motions = (invert(_paper_motion(rng)), np.eye(4))
    pair = posed_pair(
        clouds[0],
        clouds[1],
        sampling,
        bounding_diagonal(points),
        rng,
        translation=0.5,
        motions=motions,
        whole=dense if whole else None,
    )
    if sampling == "independent":
        return pair
    _, *places = np.intersect1d(indices[0], indices[1], assume_unique=True, return_indices=True)
    return replace(pair, shared=np.stack(places, axis=1))


def patch_pair(
    mesh: Mesh, rng: np.random.Generator, settings: PairSettings | None = None, *, whole: bool = False
) -> ScanPair:
    """Cut two overlapping dense patches out of a whole (stretched, warped) surface.

    Args:
        mesh: vertices (V, 3) and faces (F, 3).
        rng: source of randomness.
        settings: the ``patch_*`` ranges, stretch, warp and noise.
        whole: let a sample of the whole object travel with the pair.

    Raises:
        DegeneratePair: the patches overlap too little, or have too few points.
    """
    settings = settings or PairSettings()
    surface = warped_surface(mesh, rng, settings, 60_000)
    every = np.arange(len(surface.points))
    outer = surface.points[is_outer(surface.points, surface.normals(every))].astype(np.float64)
    first_centre = outer[rng.integers(len(outer))]
    aside = rng.standard_normal(3)
    second_centre = first_centre + aside / np.linalg.norm(aside) * rng.uniform(0.1, 0.6) * surface.extent
    clouds = []
    for half, centre in enumerate((first_centre, second_centre)):
        mine = outer[half::2]
        kept = mine[nearest_crop(mine, centre, round(rng.uniform(*settings.patch_keep) * len(mine)))]
        wanted = int(np.exp(rng.uniform(*np.log(settings.patch_points))))
        kept = kept[rng.permutation(len(kept))[:wanted]]
        sigma = settings.noise[1] * rng.random() ** 2 * surface.extent
        kept = kept + jitter(kept.shape, sigma / np.sqrt(3.0), 3.0 * sigma, rng)
        check_cloud(kept, 500, surface.extent)
        clouds.append(kept)
    pair = posed_pair(
        clouds[0],
        clouds[1],
        "patch",
        surface.extent,
        rng,
        translation=settings.translation,
        whole=outer if whole else None,
    )
    if pair.smaller_overlap < settings.minimum_overlap:
        raise DegeneratePair(f"overlap {pair.smaller_overlap:.2f} is under {settings.minimum_overlap:g}")
    return pair


def outer_points(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the points of a dense surface sample that can be seen from outside (K, 3)."""
    return points[is_outer(points, normals)]


def is_outer(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Tell which points of a dense surface sample some scanner outside can see (N,) bool.

    Meshes often hold hidden walls and contact faces that no scan would ever show.

    Args:
        points: (N, 3).
        normals: (N, 3) unit normals of either sign.
    """
    number = np.arange(OUTSIDE_VIEWS) + 0.5  # directions spread by a Fibonacci spiral
    height = 1.0 - 2.0 * number / OUTSIDE_VIEWS
    turn = np.pi * (1.0 + np.sqrt(5.0)) * number
    ring = np.sqrt(1.0 - height**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    cell = bounding_diagonal(points) / 55.0
    seen = np.zeros(len(points), dtype=bool)
    for direction in directions:
        left = np.flatnonzero(~seen)
        seen[left] = depth_map(points, direction, cell).seen(left, normals[left], 0.2)[0]
    return seen


def jitter(shape: tuple[int, ...], sigma: float, clip: float, rng: np.random.Generator) -> np.ndarray:
    """Draw Gaussian noise cut off at ``clip``."""
    return np.clip(rng.standard_normal(shape) * sigma, -clip, clip)


def _paper_motion(rng: np.random.Generator) -> np.ndarray:
    x, y, z = rng.uniform(0.0, np.pi / 4.0, 3)
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return rigid(about_z @ about_y @ about_x, rng.uniform(-0.5, 0.5, 3))
