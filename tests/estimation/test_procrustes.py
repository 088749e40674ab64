from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.estimation.procrustes import procrustes_batch, procrustes_shared, weighted_procrustes
from utopic_cli.geometry import rigid


@pytest.mark.parametrize("seed", range(5))
def test_exact_on_known_correspondences_far_from_the_origin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gt = rigid.rigid(rigid.random_rotation(rng), rng.normal(0, 100, 3))
    source = rng.normal(0, 1, (20, 3)) + 50.0
    T = weighted_procrustes(source, rigid.apply(gt, source), rng.random(20) + 0.1)
    assert np.abs(T - gt).max() < 1e-10


def test_outliers_of_zero_weight_change_nothing() -> None:
    rng = np.random.default_rng(0)
    gt = rigid.rigid(rigid.random_rotation(rng), np.array([1.0, 2.0, 3.0]))
    source = rng.normal(size=(30, 3))
    target = rigid.apply(gt, source)
    target[10:] += rng.normal(0, 10, (20, 3))
    weights = np.where(np.arange(30) < 10, 1.0, 0.0)
    assert np.abs(weighted_procrustes(source, target, weights) - gt).max() < 1e-12
    assert np.abs(weighted_procrustes(source, target, np.ones(30)) - gt).max() > 0.1


def test_minimises_the_weighted_error() -> None:
    rng = np.random.default_rng(4)
    source, target, weights = rng.normal(size=(12, 3)), rng.normal(size=(12, 3)), rng.random(12)

    def error(T: np.ndarray) -> float:
        return float((weights * ((rigid.apply(T, source) - target) ** 2).sum(axis=1)).sum())

    best = weighted_procrustes(source, target, weights)
    for _ in range(200):
        nearby = rigid.rigid(
            rigid.nearest_rotation(best[:3, :3] + rng.normal(0, 0.02, (3, 3))),
            best[:3, 3] + rng.normal(0, 0.02, 3),
        )
        assert error(nearby) >= error(best)


def test_a_mirror_image_gets_a_rotation_all_the_same() -> None:
    source = np.random.default_rng(1).normal(size=(15, 3))
    T = weighted_procrustes(source, source * [1.0, 1.0, -1.0], np.ones(15))
    assert rigid.is_rigid(T)


def test_points_in_a_plane_suffice() -> None:
    rng = np.random.default_rng(3)
    gt = rigid.rigid(rigid.random_rotation(rng), rng.normal(size=3))
    source = rng.normal(size=(10, 3)) * [1.0, 1.0, 0.0]
    assert np.abs(weighted_procrustes(source, rigid.apply(gt, source), np.ones(10)) - gt).max() < 1e-10


@pytest.mark.parametrize(
    ("source", "weights"),
    [
        (np.eye(3)[:2], np.ones(2)),
        (np.eye(3), np.zeros(3)),
        (np.eye(3), np.array([1.0, 1.0, 0.0])),
        (np.outer(np.arange(5.0), [1.0, 2.0, 3.0]), np.ones(5)),
        (np.ones((4, 3)), np.ones(4)),
        (np.eye(3), np.array([1.0, -1.0, 1.0])),
        (np.eye(3), np.array([1.0, np.nan, 1.0])),
    ],
    ids=["two points", "no weight", "two weighted", "a line", "one place", "negative", "not a number"],
)
def test_what_determines_no_rotation_is_refused(source: np.ndarray, weights: np.ndarray) -> None:
    with pytest.raises(ValueError):
        weighted_procrustes(source, source, weights)


def test_batch_equals_one_by_one() -> None:
    rng = np.random.default_rng(8)
    source, target, weights = rng.normal(size=(6, 9, 3)), rng.normal(size=(6, 9, 3)), rng.random((6, 9))
    together, spread = procrustes_batch(source, target, weights)
    for i in range(6):
        assert np.allclose(together[i], weighted_procrustes(source[i], target[i], weights[i]), atol=1e-12)
    assert ((spread > 0) & (spread <= 1)).all()


def test_shared_pairs_are_solved_as_single_problems_are() -> None:
    rng = np.random.default_rng(7)
    source = rng.standard_normal((40, 3)) + 20.0
    target = rng.standard_normal((40, 3)) - [5.0, 300.0, 0.0]
    weights = rng.uniform(0, 1, (6, 40)) * (rng.random((6, 40)) < 0.4)
    together, spread = procrustes_shared(source, target, weights)
    one_by_one, expected = procrustes_batch(
        np.broadcast_to(source, (6, 40, 3)), np.broadcast_to(target, (6, 40, 3)), weights
    )
    np.testing.assert_allclose(together, one_by_one, atol=1e-9)
    np.testing.assert_allclose(spread, expected, atol=1e-9)
