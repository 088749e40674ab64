from __future__ import annotations

import numpy as np

from utopic_cli.estimation.constellation import SCALES, alike, constellations
from utopic_cli.geometry import rigid


def plain_sheet(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), np.zeros(count)])


def test_they_are_the_same_in_any_pose_and_unit(gt_transformation: np.ndarray) -> None:
    points = np.random.default_rng(0).normal(size=(90, 3))
    found = constellations(points, 0.2)
    assert found.shape == (90, 5 * len(SCALES))
    moved = rigid.apply(gt_transformation, 1000.0 * points)
    np.testing.assert_allclose(constellations(moved, 200.0), found, atol=1e-9)


def test_by_hand() -> None:
    # One neighbour at a distance of 1: nothing spreads, and its mean is where it is.
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    for scale, values in zip(SCALES, constellations(points, 0.5)[0].reshape(-1, 5), strict=True):
        weight = np.exp(-0.5 * (2.0 / scale) ** 2)
        np.testing.assert_allclose(values[:2], [np.log(weight + 0.05), 2.0 / scale], rtol=1e-9)
        np.testing.assert_allclose(values[2:], [0.0, 0.0, 2.0 / scale], atol=1e-9)


def test_shared_points_of_a_plain_sheet_are_told_and_others_are_not(gt_transformation: np.ndarray) -> None:
    sheet = plain_sheet(500, 0)
    gap = 0.5 / np.sqrt(500 / 4)  # mean distance to the nearest of points at random
    rng = np.random.default_rng(1)
    source, target = (sheet + rng.normal(0.0, 0.2 * gap, sheet.shape) for _ in range(2))
    target = rigid.apply(gt_transformation, target)
    scores = alike(source, target, gap)
    assert scores.shape == (500, 500) and scores.min() >= 0.0 and scores.max() <= 1.0
    assert (scores.argmax(axis=1) == np.arange(500)).mean() > 0.3
    other = rigid.apply(gt_transformation, plain_sheet(500, 2))
    found = alike(source, other, gap).argmax(axis=1)
    distance = np.linalg.norm(rigid.apply(gt_transformation, source) - other[found], axis=1)
    assert (distance < gap).mean() < 0.03
