from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.geometry import rigid


def turn(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


@pytest.mark.parametrize("seed", range(4))
def test_inverse_undoes_far_from_the_origin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = rigid.rigid(rigid.random_rotation(rng), rng.normal(0, 1e6, 3))
    points = rng.normal(size=(50, 3))
    assert np.abs(rigid.apply(rigid.invert(T), rigid.apply(T, points)) - points).max() < 1e-8
    assert rigid.is_rigid(T, 1e-12) and rigid.is_rigid(rigid.invert(T), 1e-12)


def test_random_rotations_are_uniform() -> None:
    rng = np.random.default_rng(0)
    rotations = np.stack([rigid.random_rotation(rng) for _ in range(4000)])
    assert np.abs(rotations.mean(axis=0)).max() < 0.04
    # Uniform over SO(3), the angle has density (1 - cos a) / pi: mean pi / 2 + 2 / pi.
    angles = [rigid.rotation_angle_deg(R) for R in rotations]
    assert np.mean(angles) == pytest.approx(np.degrees(np.pi / 2 + 2 / np.pi), abs=1.5)


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 1e-3, 45.0, 90.0, 179.999999, 180.0])
def test_rotation_angle_is_accurate_at_both_ends(degrees: float) -> None:
    assert rigid.rotation_angle_deg(turn(degrees)) == pytest.approx(degrees, abs=1e-9)


def test_errors_compare_two_transformations() -> None:
    gt = rigid.rigid(turn(30.0), np.array([1.0, 2.0, 3.0]))
    T = rigid.rigid(turn(33.0), np.array([1.0, 2.0, 3.5]))
    assert rigid.relative_rotation_error_deg(T, gt) == pytest.approx(3.0)
    assert rigid.relative_translation_error(T, gt) == pytest.approx(0.5)
    on_axis = rigid.relative_translation_error(T, gt, np.array([0.0, 0.0, 9.0]))
    off_axis = rigid.relative_translation_error(T, gt, np.array([100.0, 0.0, 0.0]))
    assert on_axis == pytest.approx(0.5) and off_axis == pytest.approx(
        np.hypot(200 * np.sin(np.radians(1.5)), 0.5)
    )


def test_nearest_rotation_is_proper() -> None:
    rng = np.random.default_rng(1)
    rotation = rigid.random_rotation(rng)
    assert np.abs(rigid.nearest_rotation(3.0 * rotation) - rotation).max() < 1e-12
    mirrored = rigid.nearest_rotation(rotation @ np.diag([1.0, 1.0, -1.0]))
    assert np.linalg.det(mirrored) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "matrix",
    [np.diag([2.0, 1, 1, 1]), np.diag([1.0, 1, -1, 1]), np.zeros((4, 4)), np.full((4, 4), np.nan)],
    ids=["scale", "mirror", "zeros", "nan"],
)
def test_is_rigid_refuses(matrix: np.ndarray) -> None:
    assert not rigid.is_rigid(matrix)
    shifted = np.eye(4)
    shifted[3, 0] = 1.0
    assert not rigid.is_rigid(shifted)
