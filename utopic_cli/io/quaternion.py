"""Rotations as unit quaternions in the order x y z w, as TUM and ROS write them."""

from __future__ import annotations

import numpy as np

from utopic_cli.io.records import FormatError

_UNIT_LENGTH = 1e-3  # how far from 1 a length may be: files with few digits are common


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Return a (3, 3) rotation as (4,) x y z w with w >= 0."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(canonical=True)


def rigid_of(translation: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return the (4, 4) matrix of a (3,) translation and a (4,) quaternion x y z w.

    Raises:
        FormatError: the quaternion's length is not 1.
    """
    from scipy.spatial.transform import Rotation

    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _UNIT_LENGTH:  # NaN too
        raise FormatError(f"has a quaternion of length {length:.6g}, not 1; check the order x y z w")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    matrix[:3, 3] = translation
    return matrix
