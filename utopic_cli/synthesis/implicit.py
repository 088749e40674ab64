"""Solids given by a function of space, and their surface as a triangle mesh."""

from __future__ import annotations

import numpy as np


def grid_points(resolution: int, half_width: float = 1.2) -> np.ndarray:
    """Return the nodes (R, R, R, 3) float32 of a cubic grid centred at the origin."""
    axis = np.linspace(-half_width, half_width, resolution, dtype=np.float32)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def surface_net(values: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extract the zero level set of a sampled function (naive surface nets).

    Each grid cube that the surface crosses gets one vertex, at the mean of the crossings of
    its edges; each crossed grid edge gets a quadrilateral between its four cubes.

    Args:
        values: (R, R, R) the function, negative inside, positive all round the border.
        points: (R, R, R, 3) the grid's nodes.

    Returns:
        vertices: (V, 3) float64.
        faces: (F, 3) int64, wound so that normals point outwards.

    Raises:
        ValueError: the surface is empty or touches the border.
    """
    inside = values < 0
    border = np.ones(values.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    if not inside.any() or (inside & border).any():
        raise ValueError("the solid is empty or touches the border of the grid")
    cubes = np.array(values.shape) - 1
    sums = np.zeros((cubes.prod(), 3))
    counts = np.zeros(cubes.prod())
    quads = []
    strides = np.array([cubes[1] * cubes[2], cubes[2], 1])
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        upper = tuple(slice(s, None) for s in step)
        lower = tuple(slice(None, -1 if s else None) for s in step)
        node = np.argwhere(inside[lower] != inside[upper])  # (E, 3) lower end of each crossed edge
        start, end = tuple(node.T), tuple((node + step).T)
        share = values[start] / (values[start] - values[end])
        crossing = points[start] + share[:, None] * (points[end] - points[start])
        first, second = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        around = [(node - a * first - b * second) @ strides for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
        for cube in around:
            counts += np.bincount(cube, minlength=len(counts))
            for column in range(3):
                sums[:, column] += np.bincount(cube, crossing[:, column], minlength=len(counts))
        quad = np.stack(around, axis=1)
        quads.append(np.where(inside[start][:, None], quad, quad[:, ::-1]))
    quad = np.concatenate(quads)
    used = np.flatnonzero(counts)
    number = np.full(len(counts), -1)
    number[used] = np.arange(len(used))
    quad = number[quad]
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return sums[used] / counts[used, None], faces


def ball(points: np.ndarray, centre: np.ndarray, radii: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Distance-like function of an ellipsoid with semi-axes ``radii``, turned by ``turn`` (3, 3)."""
    scaled = (points - centre.astype(np.float32)) @ (turn / radii).astype(np.float32)
    return (np.sqrt(np.einsum("...d,...d->...", scaled, scaled)) - 1.0) * float(radii.min())


def box(
    points: np.ndarray, centre: np.ndarray, halves: np.ndarray, turn: np.ndarray, rounding: float
) -> np.ndarray:
    """Distance of a rounded box with half edges ``halves``."""
    local = (points - centre.astype(np.float32)) @ turn.astype(np.float32)
    over = np.abs(local) - (halves - rounding).astype(np.float32)
    outside = np.maximum(over, 0.0)
    inside = np.minimum(over.max(axis=-1), 0.0)
    return np.sqrt(np.einsum("...d,...d->...", outside, outside)) + inside - rounding


def limb(
    points: np.ndarray, start: np.ndarray, end: np.ndarray, start_radius: float, end_radius: float
) -> np.ndarray:
    """Distance-like function of a rod with round ends whose radius changes along it."""
    axis = (end - start).astype(np.float32)
    offset = points - start.astype(np.float32)
    along = np.clip(offset @ axis / max(float(axis @ axis), 1e-9), 0.0, 1.0)
    offset = offset - along[..., None] * axis
    return np.sqrt(np.einsum("...d,...d->...", offset, offset)) - (
        start_radius + along * (end_radius - start_radius)
    )


def ring(
    points: np.ndarray, centre: np.ndarray, turn: np.ndarray, radius: float, thickness: float
) -> np.ndarray:
    """Distance of a torus about the third axis of ``turn`` (3, 3)."""
    local = (points - centre.astype(np.float32)) @ turn.astype(np.float32)
    out = np.hypot(local[..., 0], local[..., 1]) - radius
    return np.hypot(out, local[..., 2]) - thickness


def blend(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Union of two solids with a fillet of about ``width`` (0: a sharp seam)."""
    if width <= 0:
        return np.minimum(a, b)
    reach = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - reach * reach * width * 0.25


def carve(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Take solid ``b`` out of solid ``a``, with an edge rounded by about ``width``."""
    return -blend(-a, b, width)


def prism(points: np.ndarray, corners: np.ndarray, half_height: float) -> np.ndarray:
    """Distance of a polygon (P, 2) in the first two axes, extruded along the third."""
    flat = points[..., :2].reshape(-1, 2).astype(np.float32)
    nearest = np.full(len(flat), np.inf, dtype=np.float32)
    inside = np.zeros(len(flat), dtype=bool)
    for a, b in zip(corners.astype(np.float32), np.roll(corners, -1, axis=0).astype(np.float32)):
        side, offset = b - a, flat - a
        along = np.clip(offset @ side / max(float(side @ side), 1e-9), 0.0, 1.0)
        apart = offset - along[:, None] * side
        nearest = np.minimum(nearest, np.einsum("nd,nd->n", apart, apart))
        crosses = (a[1] > flat[:, 1]) != (b[1] > flat[:, 1])  # even-odd rule
        left = side[0] * offset[:, 1] - side[1] * offset[:, 0] > 0
        inside ^= crosses & (left == (b[1] > a[1]))
    outline = (np.sqrt(nearest) * np.where(inside, -1.0, 1.0)).reshape(points.shape[:-1])
    return np.maximum(outline, np.abs(points[..., 2]) - half_height).astype(np.float32)


def post(points: np.ndarray, centre: tuple[float, float], radius: float, half_height: float) -> np.ndarray:
    """Distance of an upright cylinder (a hole, when carved), ``half_height`` to both sides of 0."""
    across = np.hypot(points[..., 0] - centre[0], points[..., 1] - centre[1]) - radius
    return np.maximum(across, np.abs(points[..., 2]) - half_height)


def gyroid(points: np.ndarray, wavelength: float, thickness: float) -> np.ndarray:
    """Distance-like function of a gyroid's wall, which fills all space."""
    wave = 2.0 * np.pi / wavelength
    sine, cosine = np.sin(wave * points), np.cos(wave * points)
    level = np.einsum("...d,...d->...", sine, np.roll(cosine, -1, axis=-1))
    return np.abs(level) / wave / 1.5 - thickness / 2.0


def struts(points: np.ndarray, spacing: float, radius: float) -> np.ndarray:
    """Distance of round rods along the edges of a cubic lattice, which fill all space."""
    local = points - spacing * np.round(points / spacing)
    square = local * local
    return np.sqrt(square.sum(axis=-1) - square.max(axis=-1)) - radius


def bend(points: np.ndarray, curvature: float) -> np.ndarray:
    """Return where points were before the first axis was bent towards the third."""
    if abs(curvature) < 1e-3:
        return points
    x, y, z = (points[..., i] for i in range(3))
    centre = 1.0 / curvature
    side = np.sign(centre)  # the axis is below the centre, or above it
    radius = side * np.hypot(x, centre - z)
    angle = np.arctan2(x, side * (centre - z))
    return np.stack([angle * abs(centre), y, centre - radius], axis=-1).astype(np.float32)


def twist(points: np.ndarray, rate: float) -> np.ndarray:
    """Return where points were before a twist about the third axis, ``rate`` radians a unit."""
    x, y, z = (points[..., i] for i in range(3))
    cosine, sine = np.cos(rate * z), np.sin(rate * z)
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1).astype(np.float32)
