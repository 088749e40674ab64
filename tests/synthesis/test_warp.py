from __future__ import annotations

import numpy as np
import pytest

from tests.synthesis.conftest import ball
from utopic_cli.synthesis.surface import sample_surface
from utopic_cli.synthesis.warp import compacting_stretch, random_stretch, random_warp, tangents, unit


def test_wavelengths_and_amplitudes_follow_the_recipe():
    warp = random_warp(np.random.default_rng(0), extent=3.0, strength=0.02)
    wavelength = 2 * np.pi / np.linalg.norm(warp.waves, axis=1) / 3.0
    assert 0.85 * 0.08 <= wavelength.min() < 0.1
    assert 1.0 < wavelength.max() <= 1.15 * 1.2
    strength = np.linalg.norm(warp.displacements, axis=1) / (wavelength * 3.0)
    assert strength.max() / strength.min() < 4.01  # in proportion, up to the draw per octave


def test_normals_of_the_warped_surface_match_finite_differences():
    rng = np.random.default_rng(1)
    points, _ = sample_surface(*ball(), 500, rng)
    normals = unit(points.astype(np.float32))
    warp = random_warp(rng, 2.0, 0.02)
    step = 1e-3
    first, second = (
        (warp(points + step * t) - warp(points - step * t)).astype(np.float64) for t in tangents(normals)
    )
    expected = unit(np.cross(first, second))
    got = warp.normals(points, normals)
    assert np.einsum("nd,nd->n", got, expected).min() > np.cos(np.radians(1.5))


def test_blocks_do_not_show():
    warp = random_warp(np.random.default_rng(2))
    points = np.random.default_rng(3).uniform(-1, 1, (20_000, 3)).astype(np.float32)
    np.testing.assert_allclose(warp(points)[9000:9010], warp(points[9000:9010]), atol=1e-5)


def test_tangents_complete_right_handed_frames():
    normals = unit(np.vstack([np.random.default_rng(4).standard_normal((200, 3)), -np.eye(3), np.eye(3)]))
    first, second = tangents(normals)
    np.testing.assert_allclose(np.cross(first, second), normals, atol=1e-12)


def test_stretch_is_within_its_limits_and_symmetric():
    for seed in range(20):
        stretch = random_stretch(np.random.default_rng(seed), 1.6)
        np.testing.assert_allclose(stretch, stretch.T, atol=1e-12)
        factors = np.linalg.eigvalsh(stretch)
        assert factors.min() >= 1 / 1.6 - 1e-9 and factors.max() <= 1.6 + 1e-9


def test_compacting_makes_a_rod_stout_and_leaves_a_ball_alone():
    rng = np.random.default_rng(5)
    rod = rng.standard_normal((3000, 3)) * [10.0, 1.0, 0.5]
    stout = rod @ compacting_stretch(rod, 2.0)
    deviation = np.sqrt(np.linalg.eigvalsh(np.cov(stout.T)))
    assert deviation.max() / deviation.min() == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_allclose(compacting_stretch(rng.standard_normal((3000, 3)), 2.0), np.eye(3), atol=1e-9)
