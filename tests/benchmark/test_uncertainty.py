"""Places on a pair, and what their uncertainties are compared by."""

from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.benchmark.uncertainty import (
    PLACES,
    UncertaintyByPlace,
    area_under_curve,
    measure_uncertainty,
    relief,
    summarise_uncertainty,
)
from utopic_cli.bridge import NetworkView
from utopic_cli.preprocess import PreparedPair, sample


def ridge_and_plane() -> np.ndarray:
    """A sheet over [0, 4] x [0, 1]: corrugated for y > 0.5 where 1 < x < 3, flat elsewhere."""
    x, y = np.meshgrid(np.arange(0, 4, 0.02), np.arange(0, 1, 0.02), indexing="ij")
    z = 0.15 * np.sin(14.0 * x) * ((y > 0.5) & (x > 1) & (x < 3))
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def cloud():
    return sample(ridge_and_plane(), 0.08, 400)


def view_of(source: np.ndarray, target: np.ndarray) -> NetworkView:
    nothing = np.zeros(0)
    return NetworkView(nothing, nothing, nothing, nothing, nothing, source, target)


def test_relief_is_high_on_a_corrugated_part_and_none_on_a_plane(cloud):
    x, y = cloud.points[:, 0], cloud.points[:, 1]
    rough = (y > 0.6) & (x > 1.2) & (x < 2.8)
    assert relief(cloud)[rough].min() > 10 * np.median(relief(cloud)[(y < 0.4)])


def test_uncertainty_is_told_apart_by_place(cloud):
    x, y = cloud.points[:, 0], cloud.points[:, 1]
    overlap = x < 2.0
    corrugated = (y > 0.5) & (x > 1.0) & (x < 3.0)
    raw = np.where(np.abs(x - 2.0) < 0.2, 0.9, np.where(corrugated, 0.1, 0.3))
    pair = PreparedPair(cloud, cloud, np.zeros(3), np.zeros(3), 1.0, 0.08)
    found = measure_uncertainty(pair, view_of(raw, raw), overlap, overlap)
    assert found.border_auc is not None and found.border_auc > 0.95  # its band is wider than the raised one
    assert found.plain_auc is not None and found.plain_auc > 0.8
    assert found.places["border"] > 0.7
    assert found.places["rich"] < found.places["plain"] < 0.35
    assert 0.1 < found.places["inside"] <= 0.3
    assert found.mean == pytest.approx(raw.mean())
    flat = measure_uncertainty(pair, view_of(0 * raw, 0 * raw), overlap, overlap)
    assert flat.border_auc == flat.plain_auc == 0.5


def test_places_that_a_pair_does_not_have_are_none(cloud):
    pair = PreparedPair(cloud, cloud, np.zeros(3), np.zeros(3), 1.0, 0.08)
    everywhere, raw = np.ones(len(cloud.points), dtype=bool), np.ones(len(cloud.points))
    found = measure_uncertainty(pair, view_of(raw, raw), everywhere, everywhere)
    assert found.places["border"] is None and found.places["outside"] is None and found.border_auc is None


def test_area_under_the_curve_against_brute_force():
    rng = np.random.default_rng(0)
    high, low = rng.integers(0, 9, 40), rng.integers(0, 7, 50)
    expected = np.mean((high[:, None] > low) + 0.5 * (high[:, None] == low))
    assert area_under_curve(high, low) == pytest.approx(expected)
    assert area_under_curve([], low) is None


def test_pairs_that_fail_are_compared_with_the_others():
    def pair(mean, border):
        return UncertaintyByPlace(mean, {**dict.fromkeys(PLACES), "border": border}, 0.7, None)

    found = summarise_uncertainty(
        [pair(0.1, 0.2), pair(0.3, 0.4), pair(0.2, None)], right=[True, False, True]
    )
    assert found.failed == pytest.approx(0.3) and found.right == pytest.approx(0.15)
    assert found.failed_auc == 1.0 and found.border_auc == pytest.approx(0.7)
    assert found.places["border"] == pytest.approx(0.3) and found.plain_auc is None
