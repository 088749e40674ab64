from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.geometry.outliers import scattered


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
