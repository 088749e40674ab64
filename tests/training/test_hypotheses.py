"""What the network is shown in training: none, nearly right, and settled wrong transformations."""

from __future__ import annotations

import numpy as np

from tests.model.conftest import bumpy_points
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import prepare
from utopic_cli.training.hypotheses import MOST_ROTATION_DEG, draw_hypothesis


def test_shares_and_ranges_are_as_said():
    rng = np.random.default_rng(0)
    gt = rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
    points = bumpy_points(600, 0)
    source = PointCloud(rigid.apply(rigid.invert(gt), points))
    prepared = prepare(source, PointCloud(bumpy_points(500, 1)), 100)
    known = prepared.normalise(gt)
    drawn = [draw_hypothesis(prepared, known, rng) for _ in range(120)]
    absent = [present for _, present in drawn].count(0.0)
    assert 30 < absent < 66  # 40 %
    errors = np.array([rigid.relative_rotation_error_deg(T, known) for T, present in drawn if present])
    nearly_right = errors[errors <= MOST_ROTATION_DEG + 1e-6]
    assert 0.5 < len(nearly_right) / len(errors) < 0.9
    assert np.median(nearly_right) < MOST_ROTATION_DEG / 2
    assert all(rigid.is_rigid(T, 1e-6) for T, _ in drawn)
