from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.geometry.outliers import astray, scattered


def ball(rng: np.random.Generator, count: int) -> np.ndarray:
    points = rng.standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.35])
@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_points_in_the_air_are_told_from_a_surface(share: float, scale: float) -> None:
    rng = np.random.default_rng(0)
    surface = ball(rng, 6000)
    air = rng.uniform(-1.5, 1.5, (int(6000 * share / (1 - share)), 3))
    air = air[np.abs(np.linalg.norm(air, axis=1) - 1.0) > 0.2]
    alone = scattered(scale * np.concatenate([surface, air]))
    assert not alone[:6000].any()
    assert alone[6000:].mean() > 0.75  # a dozen random points may look flat by chance


def test_a_surface_that_thins_out_is_no_scatter() -> None:
    # A floor as a scanner in its middle sees it: a hundred times sparser far away.
    rng = np.random.default_rng(1)
    radius, angle = 10.0 ** rng.uniform(0.0, 2.0, 8000), rng.uniform(0.0, 2.0 * np.pi, 8000)
    floor = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.normal(0, 0.01, 8000)], axis=1)
    assert scattered(floor).mean() < 0.002


def test_lines_of_a_scanner_are_no_scatter() -> None:
    steps = np.linspace(0.0, 2.0 * np.pi, 900, endpoint=False)
    rings = [r * np.stack([np.cos(steps), np.sin(steps), 0.05 * r + 0 * steps], axis=1) for r in range(1, 40)]
    assert not scattered(np.concatenate(rings)).any()


def test_of_a_handful_of_points_nothing_is_told() -> None:
    assert not scattered(np.random.default_rng(2).uniform(-1, 1, (30, 3))).any()


def test_a_return_at_the_origin_is_astray_and_the_far_end_of_a_scan_is_not() -> None:
    rng = np.random.default_rng(3)
    radius, angle = 10.0 ** rng.uniform(0.0, 2.0, 4000), rng.uniform(0.0, 2.0 * np.pi, 4000)
    floor = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.normal(0, 0.01, 4000)], axis=1)
    assert not astray(floor).any()
    site = np.concatenate([floor + [4e5, 5e6, 100.0], np.zeros((3, 3))])
    assert astray(site).tolist() == [False] * 4000 + [True] * 3


def test_places_held_many_times_are_no_scatter() -> None:
    places = np.random.default_rng(4).standard_normal((80, 3))
    assert not scattered(np.repeat(places, 20, axis=0)).any()
