"""Trials of the shapes of a library: with much, little and no overlap, of two objects, mirrored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.benchmark.labelled import Trial, with_answer, without_answer
from utopic_cli.geometry.rigid import apply, nearest_rotation
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.pairs import PairSettings, evaluation_pair
from utopic_cli.synthesis.range_pairs import range_scan_pair
from utopic_cli.synthesis.scan_pair import DegeneratePair, ScanPair, check_cloud, measure_overlap
from utopic_cli.synthesis.settings import Range
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.synthesis.surface import bounding_diagonal
from utopic_cli.synthesis.surface_pairs import patch_pair, surface_pair

SETTINGS = PairSettings(
    points=(3_000, 30_000),  # so densities differ by up to 10
    rough_probability=0.15,
    outlier_share=(0.002, 0.1),
    patch_points=(3_000, 20_000),
    surface_points=(500, 1_500),
)
"""What the scans are like; validation's, with noise up to 2 % of the extent and more outliers."""

BANDS: tuple[Range, ...] = ((0.1, 0.3), (0.3, 0.5), (0.5, 0.9))
LITTLE: Range = (0.02, 0.1)
LEAST_POINTS = 500
GAP: Range = (0.02, 0.06)
"""Width of the gap between disjoint scans, in extents of the object."""

CLEARLY_APART = 0.01
"""A shape is told from its mirror image, or from itself turned, if, laid on it as well as can be, the
points of the one are on average farther from the other than this share of the extent."""


SYMMETRIC = 0.006
"""A shape counts as symmetric if a turn lays it on itself to within this (see ``CLEARLY_APART``): as near
as a scan's noise. Opposite sides of it look like one side seen twice: its trials are a kind of their own."""


def scans(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Virtual range scans from two sides, in the overlap bands .1-.3, .3-.5 and .5-.9 equally often."""
    return with_answer("scans", _in_band(shapes, rng, BANDS[rng.integers(3)], SETTINGS))


def several_views(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """The same, each scan merged from two or three views."""
    settings = replace(SETTINGS, several_views_probability=1.0)
    return with_answer("several-views", _in_band(shapes, rng, BANDS[rng.integers(3)], settings))


def patch(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Two overlapping dense patches of a whole surface, all sides of it."""
    shape = shapes.draw(rng)
    pair = patch_pair(shapes.mesh(shape), rng, SETTINGS, whole=True)
    _check_symmetry(pair, rng)
    return with_answer("patch", pair, str(shapes.names[shape]))


def sparse(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Two samples of 500 to 1,500 points of a whole surface, each cut by a half-space to .5 to .9."""
    shape = shapes.draw(rng)
    pair = surface_pair(
        shapes.mesh(shape),
        rng,
        "independent",
        keep=rng.uniform(*SETTINGS.surface_keep),
        count=int(np.exp(rng.uniform(*np.log(SETTINGS.surface_points)))),
        noise=rng.uniform(*SETTINGS.surface_noise),
        whole=True,
    )
    _check_symmetry(pair, rng)
    if pair.smaller_overlap < SETTINGS.minimum_overlap:
        raise DegeneratePair(f"overlap {pair.smaller_overlap:.2f}")
    return with_answer("sparse", pair, str(shapes.names[shape]))


def little(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Range scans with an overlap of .02 to .1: an answer exists, hardly anybody can find it."""
    settings = replace(SETTINGS, minimum_overlap=LITTLE[0], view_angle=(90.0, 175.0))
    return with_answer("little", _in_band(shapes, rng, LITTLE, settings))


def symmetric_shape(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Range scans as of the kind ``scans``, of shapes that a turn lays on themselves, or all but so."""
    return with_answer(
        "symmetric-shape", _in_band(shapes, rng, BANDS[rng.integers(3)], SETTINGS, symmetric=True)
    )


def disjoint(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Two scans of one object that share no surface: its opposite sides, or its two ends.

    Whatever of the target lies nearer to the source than a gap is taken away. Opposite sides of what
    a turn maps onto itself look like one side seen twice, which is no wrong pair but an unknowable
    one; the kind ``symmetric`` has such things. Here they are stretched and strongly warped first, and
    left out if that leaves them symmetric.
    """
    shape = shapes.draw(rng)
    bent = replace(
        SETTINGS,
        minimum_overlap=0.0,
        stretch_probability=1.0,
        warp_probability=1.0,
        warp_strength=(0.03, 0.06),
    )
    if rng.random() < 0.6:
        settings = replace(bent, view_angle=(110.0, 180.0))
        pair = range_scan_pair(shapes.mesh(shape), rng, settings, (0.0, 0.05), whole=True)
    else:
        settings = replace(bent, patch_keep=(0.25, 0.45))
        pair = patch_pair(shapes.mesh(shape), rng, settings, whole=True)
    assert pair.object_points is not None  # asked for
    if turned_distance(pair.object_points, rng) < CLEARLY_APART:
        raise DegeneratePair("the shape is all but itself when turned")
    there = apply(pair.gt_T_target_source, pair.source.points)
    # No gap is narrower than the reach within which overlap is measured.
    spacings = [np.median(cKDTree(cloud).query(cloud[:300], k=2)[0][:, 1]) for cloud in _clouds(pair, there)]
    gap = max(rng.uniform(*GAP) * pair.extent, 4.0 * float(max(spacings)))
    left = pair.target.points[cKDTree(there).query(pair.target.points)[0] > gap]
    if len(left) < len(pair.target) / 3:
        raise DegeneratePair("the scans share most of what they see")
    check_cloud(left, LEAST_POINTS, pair.extent)
    overlap = measure_overlap(there, left, pair.extent, rng)
    if min(overlap.values()) >= 0.01:
        raise DegeneratePair("the scans overlap")
    return without_answer("disjoint", pair.source, PointCloud(left), str(shapes.names[shape]))


def different(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """Scans of two different objects of about one size, from different collections where there are some.

    Shapes of one collection can be all but the same, so they are paired only where there is but one.
    """
    first = second = shapes.draw(rng)
    several = len(set(shapes.sets.tolist())) > 1
    taken = shapes.sets[first] if several else shapes.names[first]
    for _ in range(100):
        second = shapes.draw(rng)
        if (shapes.sets if several else shapes.names)[second] != taken:
            break
    else:
        raise DegeneratePair("the library has but one shape")
    pairs = [range_scan_pair(shapes.mesh(one), rng, SETTINGS) for one in (first, second)]
    size = rng.uniform(0.85, 1.15) * pairs[0].extent / pairs[1].extent
    names = " | ".join(str(shapes.names[one]) for one in (first, second))
    return without_answer("different", pairs[0].source, PointCloud(pairs[1].target.points * size), names)


def mirrored(shapes: ShapeLibrary, rng: np.random.Generator) -> Trial:
    """A scan of an object and one of its mirror image, where the two differ clearly.

    A shape that some rigid motion lays on its mirror image has a right answer after all, so it is
    no wrong pair; nor are shapes used that differ from it by little more than a scan's noise. Most
    things are made mirror symmetric, so all are stretched and strongly warped first.
    """
    shape = shapes.draw(rng)
    settings = replace(SETTINGS, stretch_probability=1.0, warp_probability=1.0, warp_strength=(0.03, 0.06))
    pair = range_scan_pair(shapes.mesh(shape), rng, settings, BANDS[rng.integers(3)], whole=True)
    assert pair.object_points is not None  # asked for
    if mirror_distance(pair.object_points, rng) < CLEARLY_APART:
        raise DegeneratePair("the shape is all but its own mirror image")
    reflection = np.array([-1.0, 1.0, 1.0])  # any will do: the source's frame is a random one
    source = PointCloud(pair.source.points * reflection)
    return without_answer("mirrored", source, pair.target, str(shapes.names[shape]))


def mirror_distance(points: np.ndarray, rng: np.random.Generator) -> float:
    """Tell how far a surface is from its mirror image, laid on it as well as can be.

    Args:
        points: (N, 3) sample of the whole surface, dense.
        rng: draws the points compared.

    Returns:
        Mean distance to the nearest point, less what two samples of one surface have anyway, as a
        share of the extent.
    """
    starts = [np.diag(signs) for signs in ((-1.0, 1, 1), (1, -1.0, 1), (1, 1, -1.0), (-1.0, -1.0, -1.0))]
    # Two axes may be as good as any other two: then the plane may stand at any angle to them.
    half_turn = np.diag([1.0, -1.0])
    starts += [
        _about(axis, _turn(angle) @ half_turn) for axis in range(3) for angle in np.arange(1, 6) * 30.0
    ]
    return _self_distance(points, starts, rng)


def turned_distance(points: np.ndarray, rng: np.random.Generator) -> float:
    """Tell how far a surface is from itself, turned by 60 degrees or more and laid on itself.

    Arguments and result are those of ``mirror_distance``.
    """
    angles = (60.0, 72.0, 90.0, 120.0, 144.0, 180.0)
    return _self_distance(points, [_about(axis, _turn(angle)) for axis in range(3) for angle in angles], rng)


def _turn(angle_deg: float) -> np.ndarray:
    angle = np.radians(angle_deg)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _about(axis: int, plane: np.ndarray) -> np.ndarray:
    """Let a (2, 2) map act across an axis."""
    whole = np.eye(3)
    across = [(axis + 1) % 3, (axis + 2) % 3]
    whole[np.ix_(across, across)] = plane
    return whole


def _self_distance(points: np.ndarray, starts: list[np.ndarray], rng: np.random.Generator) -> float:
    """Lay a surface on itself from many starts (3, 3) in its principal axes' frame, by nearest points."""
    few = points[rng.permutation(len(points))[:4000]].astype(np.float64)
    few = few - few.mean(axis=0)
    few = few @ np.linalg.eigh(few.T @ few)[1]
    probe, tree = few[:500], cKDTree(few[500:])
    laid = [_laid_on(tree, probe[:150], start, np.zeros(3), steps=6) for start in starts]
    # What slid back to where it came from says nothing: every surface lies on itself.
    laid = [(turn, shift) for turn, shift in laid if np.trace(turn) < 1.0 + 2.0 * np.cos(np.radians(40.0))]
    rough = [tree.query(probe[:150] @ turn.T + shift)[0].mean() for turn, shift in laid]
    best = np.inf
    for number in np.argsort(rough)[:3]:
        turn, shift = _laid_on(tree, probe, *laid[number], steps=12)
        best = min(best, float(tree.query(probe @ turn.T + shift)[0].mean()))
    return (best - float(tree.query(probe)[0].mean())) / bounding_diagonal(few)


def _laid_on(
    tree: cKDTree, probe: np.ndarray, turn: np.ndarray, shift: np.ndarray, *, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Move a surface onto itself by nearest points; ``turn`` (3, 3) stays a rotation or a reflection."""
    centre = probe.mean(axis=0)
    mirror = np.array([np.sign(np.linalg.det(turn)), 1.0, 1.0])
    for _ in range(steps):
        there = tree.data[tree.query(probe @ turn.T + shift)[1]]
        centre_there = there.mean(axis=0)
        # The nearest rotation of the mirrored points is the nearest reflection of the points.
        turn = nearest_rotation((there - centre_there).T @ ((probe - centre) * mirror)) * mirror
        shift = centre_there - turn @ centre
    return turn, shift


def _in_band(
    shapes: ShapeLibrary,
    rng: np.random.Generator,
    band: Range,
    settings: PairSettings,
    *,
    symmetric: bool = False,
) -> ScanPair:
    pair = evaluation_pair(shapes, int(rng.integers(2**31)), 0, (band,), settings, whole=True)
    _check_symmetry(pair, rng, symmetric)
    return pair


def _check_symmetry(pair: ScanPair, rng: np.random.Generator, symmetric: bool = False) -> None:
    """Make sure that the object, sampled whole, is symmetric or is not.

    Raises:
        DegeneratePair: it is the other way round.
    """
    assert pair.object_points is not None  # asked for
    if (turned_distance(pair.object_points, rng) < SYMMETRIC) != symmetric:
        raise DegeneratePair(f"the shape is {'not ' if symmetric else ''}all but itself when turned")


def _clouds(pair: ScanPair, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return there, pair.target.points
