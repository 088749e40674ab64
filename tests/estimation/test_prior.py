from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.estimation.consensus import consensus_hypotheses
from utopic_cli.estimation.prior import ANYWHERE, Prior
from utopic_cli.geometry import rigid


def turned(degrees: float, axis: tuple[float, float, float] = (0.0, 0.6, 0.8)) -> np.ndarray:
    return rigid.rigid(
        rigid.rotation_from_vector(np.radians(degrees) * np.array(axis)), np.array([1.0, 2, 3])
    )


def test_a_bound_admits_rotations_up_to_it() -> None:
    many = np.stack([turned(angle) for angle in (0.0, 29.9, 30.1, 150.0, 180.0)])
    assert Prior(max_rotation=30.0).admits(many).tolist() == [True, True, False, False, False]
    assert ANYWHERE.admits(many).all()
    assert Prior(turned(10.0), 30.0).admits(many).tolist() == [True, True, True, False, False]
    assert Prior(turned(150.0), 30.0).admits(many).tolist() == [False, False, False, True, True]


def test_a_prior_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="not rigid"):
        Prior(np.zeros((4, 4)))
    for angle in (0.0, -5.0, 180.5, np.nan):
        with pytest.raises(ValueError, match="degrees"):
            Prior(max_rotation=angle)


def test_the_lesser_of_two_motions_is_found_where_the_greater_is_turned_too_far() -> None:
    """Nine tenths of what is consistent says a half turn; what remains is found among it all the same."""
    rng = np.random.default_rng(0)
    source = rng.uniform(-1, 1, (1000, 3))
    far, near = turned(175.0), turned(40.0)
    target = rng.uniform(-1, 1, (1000, 3)) + near[:3, 3]
    target[:450] = rigid.apply(far, source[:450])
    target[450:500] = rigid.apply(near, source[450:500])
    target[:500] += rng.normal(0, 0.005, (500, 3))
    anywhere = consensus_hypotheses(source, target, np.ones(1000), 0.03)
    assert rigid.relative_rotation_error_deg(anywhere[0].T_target_source, far) < 1.0
    bounded = consensus_hypotheses(source, target, np.ones(1000), 0.03, prior=Prior(max_rotation=90.0))
    assert rigid.relative_rotation_error_deg(bounded[0].T_target_source, near) < 1.0
    counted = consensus_hypotheses(source, target, np.ones(1000), 0.03, prior=Prior(turned(160.0), 45.0))
    assert rigid.relative_rotation_error_deg(counted[0].T_target_source, far) < 1.0


def test_the_bound_takes_nothing_from_what_it_admits() -> None:
    """Right correspondences stay consistent: no direction is turned by more than the rotation's angle."""
    rng = np.random.default_rng(1)
    source = rng.uniform(-1, 1, (300, 3))
    gt = turned(59.0)
    target = rigid.apply(gt, source) + rng.normal(0, 0.003, (300, 3))
    bounded = consensus_hypotheses(source, target, np.ones(300), 0.02, prior=Prior(max_rotation=60.0))
    free = consensus_hypotheses(source, target, np.ones(300), 0.02)
    assert bounded[0].score == pytest.approx(free[0].score, rel=1e-3)
