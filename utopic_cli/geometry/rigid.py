"""Rigid transformations as (4, 4) float64 matrices: build, apply, compare."""

from __future__ import annotations

import numpy as np


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the (4, 4) matrix of ``p -> rotation @ p + translation``."""
    transformation = np.eye(4)
    transformation[:3, :3] = rotation
    transformation[:3, 3] = translation
    return transformation


def apply(transformation: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Move (..., 3) points by a (4, 4) transformation."""
    return points @ transformation[:3, :3].T + transformation[:3, 3]


def invert(transformation: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid transformation, exactly rigid again."""
    rotation = transformation[:3, :3].T
    return rigid(rotation, -rotation @ transformation[:3, 3])


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Draw a (3, 3) rotation uniformly from SO(3), by a random unit quaternion."""
    w, x, y, z = _unit(rng.standard_normal(4))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation about a (3,) vector by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a (3, 3) matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def is_rigid(transformation: np.ndarray, tolerance: float = 1e-6) -> bool:
    """Tell whether a (4, 4) matrix is a rotation and a translation, no scale or mirror."""
    rotation = transformation[:3, :3]
    return bool(
        np.isfinite(transformation).all()
        and np.abs(rotation @ rotation.T - np.eye(3)).max() <= tolerance
        and np.linalg.det(rotation) > 0
        and np.abs(transformation[3] - [0, 0, 0, 1]).max() <= tolerance
    )


def rotation_angle_deg(rotation: np.ndarray) -> float:
    """Return the angle of a (3, 3) rotation in degrees, accurate near 0 and 180."""
    axis = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.degrees(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1.0)))


def relative_rotation_error_deg(transformation: np.ndarray, gt_transformation: np.ndarray) -> float:
    """RRE: the angle in degrees between the rotations of two transformations."""
    return rotation_angle_deg(transformation[:3, :3] @ gt_transformation[:3, :3].T)


def relative_translation_error(
    transformation: np.ndarray, gt_transformation: np.ndarray, centre: np.ndarray | None = None
) -> float:
    """RTE: how far apart two transformations put one point, in the points' units.

    Args:
        transformation: (4, 4).
        gt_transformation: (4, 4) known answer.
        centre: (3,) the source point to compare at; the origin if None, which is the usual
            difference of translation vectors. For scans far from the origin use the source's
            centroid, or a rotation error is counted again as a translation error.
    """
    point = np.zeros(3) if centre is None else centre
    return float(np.linalg.norm(apply(transformation, point) - apply(gt_transformation, point)))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
