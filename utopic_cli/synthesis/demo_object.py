"""The object of ``utopic demo``: a small sitting dragon, the same on every machine."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from utopic_cli.synthesis.implicit import ball, blend, box, carve, grid_points, limb, ring, surface_net
from utopic_cli.synthesis.scan_pair import ScanPair, posed_pair
from utopic_cli.synthesis.scanner import range_scan
from utopic_cli.synthesis.surface import bounding_diagonal, normalised, sample_surface

SAMPLES = 300_000


@lru_cache(maxsize=1)
def demo_mesh(resolution: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Model a sitting dragon with wings, a coiled tail, a collar and a scaly back.

    No two sides of it are alike, so its pose is never ambiguous.

    Args:
        resolution: grid nodes along each side.

    Returns:
        vertices: (V, 3) float64, radius 1; z is up.
        faces: (F, 3) int64, wound outwards.
    """
    points = grid_points(resolution)
    at, upright = np.array, np.eye(3)
    body = ball(points, at([0.0, 0.0, -0.2]), at([0.42, 0.36, 0.5]), upright)
    body = body + _scales(points)
    belly = ball(points, at([0.18, 0.0, -0.25]), at([0.32, 0.28, 0.4]), upright) + _stripes(points)
    solid = blend(body, belly, 0.08)
    neck = limb(points, at([0.05, 0.0, 0.15]), at([0.2, 0.03, 0.5]), 0.22, 0.15)
    solid = blend(solid, neck, 0.12)
    head = ball(points, at([0.25, 0.05, 0.62]), at([0.24, 0.2, 0.19]), upright)
    snout = limb(points, at([0.35, 0.08, 0.58]), at([0.58, 0.14, 0.52]), 0.12, 0.085)
    head = blend(head, snout, 0.1)
    mouth = box(points, at([0.56, 0.14, 0.49]), at([0.16, 0.2, 0.015]), upright, 0.01)
    head = carve(head, mouth, 0.02)
    for side in (-1.0, 1.0):
        head = blend(head, ball(points, at([0.38, 0.06 + 0.12 * side, 0.7]), at([0.06] * 3), upright), 0.02)
        nostril = ball(points, at([0.64, 0.15 + 0.045 * side, 0.55]), at([0.022] * 3), upright)
        head = carve(head, nostril, 0.01)
    left_horn = _chain(points, [(0.15, 0.16, 0.75), (0.02, 0.26, 0.92), (-0.12, 0.27, 0.98)], 0.06, 0.02)
    right_horn = _chain(points, [(0.15, -0.06, 0.76), (0.1, -0.2, 0.9), (0.16, -0.32, 0.93)], 0.06, 0.03)
    head = blend(blend(head, left_horn, 0.04), right_horn, 0.04)
    solid = blend(solid, head, 0.08)
    collar_turn = np.linalg.qr(at([[1.0, 0.0, 0.35], [0.0, 1.0, 0.1], [-0.35, 0.0, 1.0]]))[0]
    solid = blend(solid, ring(points, at([0.14, 0.015, 0.36]), collar_turn, 0.185, 0.03), 0.0)
    solid = blend(solid, ball(points, at([0.33, 0.05, 0.26]), at([0.05] * 3), upright), 0.0)
    for side, lift in ((-1.0, 0.0), (1.0, 0.18)):
        foot = limb(points, at([0.2, 0.24 * side, -0.62]), at([0.5, 0.34 * side, -0.68]), 0.14, 0.1)
        joints = [(0.15, 0.3 * side, 0.1), (0.38, 0.42 * side, lift), (0.55, 0.28 * side, 0.05 + 1.6 * lift)]
        arm = _chain(points, joints, 0.1, 0.06)
        solid = blend(blend(solid, foot, 0.06), arm, 0.06)
        for toe in (-1.0, 0.0, 1.0):
            base = at([0.48, 0.34 * side + 0.05 * toe, -0.7])
            tip = at([0.6, 0.34 * side + 0.075 * toe, -0.72])
            solid = blend(solid, limb(points, base, tip, 0.05, 0.03), 0.02)
        solid = blend(solid, _wing(points, side, spread=0.75 if side > 0 else 0.45), 0.05)
    turn = np.linspace(0.0, 1.6 * np.pi, 12)
    coil = [
        (-0.35 - 0.25 * np.sin(t / 2), -0.55 * np.sin(t) * (0.4 + t / 8), -0.62 + 0.04 * t + 0.1 * np.cos(t))
        for t in turn
    ]
    solid = blend(solid, _chain(points, coil, 0.15, 0.035), 0.06)
    for height, size in ((0.3, 0.07), (0.12, 0.09), (-0.08, 0.1), (-0.28, 0.09)):
        spike = at([-0.33 - 0.1 * (0.3 - abs(height)), 0.0, height])
        solid = blend(solid, limb(points, spike, spike + at([-0.16, 0.03, 0.1]), size, 0.02), 0.03)
    vertices, faces = surface_net(solid, points)
    return normalised(vertices), faces


def demo_pair(rng: np.random.Generator, *, points: int = 20_000, noise: float = 0.0006) -> ScanPair:
    """Scan the demo object from two sides, about 60 degrees apart.

    Args:
        rng: source of the samples, the noise and the two random motions.
        points: most points a scan.
        noise: standard deviation of the range error, in extents.
    """
    vertices, faces = demo_mesh()
    extent = bounding_diagonal(vertices)
    views = [np.array([0.85, -0.35, 0.4]), np.array([0.75, 0.65, 0.15])]
    views = [view / np.linalg.norm(view) for view in views]
    clouds = []
    for view in views:
        surface, normals = sample_surface(vertices, faces, SAMPLES, rng)
        scan = range_scan(
            surface, normals, view, rng, cell=extent / 200.0, count=points, noise=noise * extent
        )
        clouds.append(scan.points)
    return posed_pair(
        clouds[0],
        clouds[1],
        "range_scan",
        extent,
        rng,
        translation=1.0,
        viewpoints=(views[0], views[1]),
    )


def _chain(
    points: np.ndarray, joints: list[tuple[float, float, float]], thick: float, thin: float
) -> np.ndarray:
    """A limb through several joints, tapering from ``thick`` to ``thin``."""
    radii = np.linspace(thick, thin, len(joints))
    solid = np.full(points.shape[:-1], np.inf, dtype=np.float32)
    for i in range(len(joints) - 1):
        link = limb(points, np.array(joints[i]), np.array(joints[i + 1]), radii[i], radii[i + 1])
        solid = np.minimum(solid, link)
    return solid


def _wing(points: np.ndarray, side: float, spread: float) -> np.ndarray:
    """A ribbed, curved membrane between the back and three fingers."""
    root = np.array([-0.25, 0.2 * side, 0.15])
    local = points - root.astype(np.float32)
    out, along, up = local[..., 1] * side, local[..., 0], local[..., 2]
    sheet = np.abs(along + 0.35 * out - 0.3 * out * out + 0.1 * np.sin(9.0 * up + 4.0 * out)) - 0.036
    outline = np.hypot((out - 0.28 * spread) / (0.45 * spread), (up - 0.18) / (0.32 + 0.15 * spread)) - 1.0
    ribs = 0.018 * np.cos(28.0 * np.arctan2(up + 0.25, out + 0.12))
    return np.maximum(sheet - ribs, outline * 0.3).astype(np.float32)


def _scales(points: np.ndarray) -> np.ndarray:
    """Overlapping scales on the back."""
    x, y, z = (points[..., i] for i in range(3))
    rows = 22.0 * z
    shift = np.pi * np.floor(rows / (2.0 * np.pi))
    bumps = np.cos(16.0 * np.arctan2(y, -x - 0.05) + shift) * np.cos(rows / 2.0) ** 2
    return (-0.02 * bumps * np.clip(-4.0 * x, 0.0, 1.0)).astype(np.float32)


def _stripes(points: np.ndarray) -> np.ndarray:
    """Horizontal folds on the belly."""
    fold = np.abs(np.sin(14.0 * points[..., 2] + 1.5 * points[..., 1]))
    return (-0.015 * fold * np.clip(4.0 * points[..., 0], 0.0, 1.0)).astype(np.float32)
