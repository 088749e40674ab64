"""Places on a pair, and what their uncertainties are compared by."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from utopic_cli.benchmark.pair_metrics import KnownNodes
from utopic_cli.benchmark.uncertainty import (
    MATCHED,
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


def view_of(source: np.ndarray, target: np.ndarray, scores: np.ndarray | None = None) -> NetworkView:
    nothing = np.zeros(0)
    if scores is None:
        scores = np.eye(len(source))
    return NetworkView(scores, nothing, nothing, nothing, nothing, source, target)


def known_of(points: np.ndarray, overlap: np.ndarray) -> KnownNodes:
    """What is known of a cloud and itself, unmoved."""
    return KnownNodes(cdist(points, points), 0.08, overlap, overlap, overlap, overlap)


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
    found = measure_uncertainty(pair, view_of(raw, raw), known_of(cloud.points, overlap))
    assert found.border_auc is not None and found.border_auc > 0.95  # its band is wider than the raised one
    assert found.plain_auc is not None and found.plain_auc > 0.8
    assert found.places["border"] > 0.7
    assert found.places["rich"] < found.places["plain"] < 0.35
    assert 0.1 < found.places["inside"] <= 0.3
    assert found.mean == pytest.approx(raw.mean())
    flat = measure_uncertainty(pair, view_of(0 * raw, 0 * raw), known_of(cloud.points, overlap))
    assert flat.border_auc == flat.plain_auc == 0.5


def test_places_that_a_pair_does_not_have_are_none(cloud):
    pair = PreparedPair(cloud, cloud, np.zeros(3), np.zeros(3), 1.0, 0.08)
    everywhere, raw = np.ones(len(cloud.points), dtype=bool), np.ones(len(cloud.points))
    found = measure_uncertainty(pair, view_of(raw, raw), known_of(cloud.points, everywhere))
    assert found.places["border"] is None and found.places["outside"] is None and found.border_auc is None


def test_wrong_matches_are_counted_by_place_and_compared_with_right_ones(cloud):
    x, y = cloud.points[:, 0], cloud.points[:, 1]
    overlap = x < 2.0
    corrugated = (y > 0.5) & (x > 1.0) & (x < 3.0)
    # What is corrugated is matched with the far end, all else with itself.
    best = np.where(corrugated, x.argmax(), np.arange(len(x)))
    scores = np.eye(len(x))[best]
    raw = np.where(corrugated, 0.2, 0.1)
    pair = PreparedPair(cloud, cloud, np.zeros(3), np.zeros(3), 1.0, 0.08)
    found = measure_uncertainty(pair, view_of(raw, raw, scores), known_of(cloud.points, overlap))
    assert found.hits["plain"] > 0.9 and found.hits["rich"] < 0.6
    assert found.hits["rich"] < found.hits["inside"] < found.hits["plain"]
    assert found.wrong_auc is not None and found.wrong_auc > 0.95
    turned = measure_uncertainty(pair, view_of(-raw, -raw, scores), known_of(cloud.points, overlap))
    assert turned.wrong_auc == pytest.approx(1.0 - found.wrong_auc)


def test_area_under_the_curve_against_brute_force():
    rng = np.random.default_rng(0)
    high, low = rng.integers(0, 9, 40), rng.integers(0, 7, 50)
    expected = np.mean((high[:, None] > low) + 0.5 * (high[:, None] == low))
    assert area_under_curve(high, low) == pytest.approx(expected)
    assert area_under_curve([], low) is None


def test_pairs_that_fail_are_compared_with_the_others():
    def pair(mean, border):
        return UncertaintyByPlace(
            mean, {**dict.fromkeys(PLACES), "border": border}, 0.7, None, 0.6, dict.fromkeys(MATCHED)
        )

    found = summarise_uncertainty(
        [pair(0.1, 0.2), pair(0.3, 0.4), pair(0.2, None)], right=[True, False, True]
    )
    assert found.failed == pytest.approx(0.3) and found.right == pytest.approx(0.15)
    assert found.failed_auc == 1.0 and found.border_auc == pytest.approx(0.7)
    assert found.places["border"] == pytest.approx(0.3) and found.plain_auc is None
