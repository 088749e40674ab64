from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.benchmark.reliability import (
    accepted_at,
    accepted_where,
    auroc,
    brier,
    expected_calibration_error,
    reliability_bins,
    risk_coverage,
    threshold_for,
)

CONFIDENCE = np.array([0.9, 0.8, 0.8, 0.3, 0.1])
RIGHT = np.array([True, True, False, True, False])


def test_auroc_counts_pairs_and_halves_ties():
    # Six pairs of a right and a wrong one: .9 beats both, .8 ties one and beats one, .3 loses one, beats one.
    assert auroc(CONFIDENCE, RIGHT) == pytest.approx((2 + 1.5 + 1) / 6)
    assert auroc(np.array([0.9, 0.1]), np.array([True, False])) == 1.0
    assert auroc(np.array([0.1, 0.9]), np.array([True, False])) == 0.0
    assert auroc(np.full(4, 0.5), np.array([True, False, True, False])) == 0.5


def test_auroc_needs_right_and_wrong_answers():
    assert auroc(np.array([0.1, 0.9]), np.array([True, True])) is None


def test_brier_of_a_hand_made_case():
    expected = (0.1**2 + 0.2**2 + 0.8**2 + 0.7**2 + 0.1**2) / 5
    assert brier(CONFIDENCE, RIGHT) == pytest.approx(expected)
    assert brier(np.array([1.0, 0.0]), np.array([True, False])) == 0.0


def test_bins_hold_every_answer_once_with_edges_to_the_upper_bin():
    confidence = np.array([0.0, 0.1, 0.0999, 0.5, 0.95, 1.0])
    bins = reliability_bins(confidence, np.array([False, False, True, True, True, False]))
    assert [one.count for one in bins] == [2, 1, 0, 0, 0, 1, 0, 0, 0, 2]
    assert bins[0].confidence == pytest.approx(0.04995)
    assert bins[0].right is not None and bins[0].right.share == 0.5
    assert bins[2].confidence is None and bins[2].right is None
    assert (bins[9].low, bins[9].high) == (pytest.approx(0.9), 1.0)


def test_calibration_error_weighs_bins_by_their_answers():
    # Bins: {.1} says .1, is 0; {.3} says .3, is 1; {.8, .8} says .8, is .5; {.9} says .9, is 1.
    expected = (0.1 + 0.7 + 2 * 0.3 + 0.1) / 5
    assert expected_calibration_error(CONFIDENCE, RIGHT) == pytest.approx(expected)
    assert expected_calibration_error(CONFIDENCE, RIGHT, bins=1) == pytest.approx(abs(0.58 - 0.6))


def test_a_calibrated_confidence_has_a_small_error_and_an_overconfident_one_a_large_one():
    rng = np.random.default_rng(0)
    truth = rng.random(20_000)
    right = rng.random(len(truth)) < truth
    assert expected_calibration_error(truth, right) < 0.015
    assert expected_calibration_error(np.where(truth > 0.5, 0.99, 0.01), right) > 0.2
    assert auroc(truth, right) == pytest.approx(auroc(truth**3, right))  # the order is all that counts


def test_risk_coverage_accepts_equals_together():
    curve = risk_coverage(CONFIDENCE, RIGHT)
    np.testing.assert_allclose(curve.threshold, [0.9, 0.8, 0.3, 0.1])
    np.testing.assert_allclose(curve.coverage, [0.2, 0.6, 0.8, 1.0])
    np.testing.assert_allclose(curve.risk, [0.0, 1 / 3, 0.25, 0.4])
    np.testing.assert_allclose(curve.recall, [1 / 3, 2 / 3, 1.0, 1.0])


def test_the_curve_agrees_with_acceptance_at_each_of_its_thresholds():
    rng = np.random.default_rng(1)
    confidence = rng.integers(0, 20, 200) / 20.0
    right = rng.random(200) < confidence
    curve = risk_coverage(confidence, right)
    for threshold, coverage, risk, recall in zip(curve.threshold, curve.coverage, curve.risk, curve.recall):
        found = accepted_at(confidence, right, float(threshold))
        assert found.wrong is not None and found.right is not None
        assert found.coverage.share == pytest.approx(coverage)
        assert found.wrong.share == pytest.approx(risk)
        assert found.right.share == pytest.approx(recall)


def test_acceptance_says_how_sure_its_small_rates_are():
    accepted = np.array([True] * 100 + [False] * 50)
    right = np.array([True] * 99 + [False] * 51)
    found = accepted_where(accepted, right)
    assert (found.wrong.count, found.wrong.of) == (1, 100)
    assert found.wrong.low < 0.01 < found.wrong.high and found.wrong.high == pytest.approx(0.0545, abs=1e-3)
    assert found.right.share == 1.0 and found.right.high == 1.0


def test_nothing_accepted_and_nothing_right_have_no_rates():
    nothing = accepted_at(CONFIDENCE, RIGHT, 0.95)
    assert nothing.wrong is None and nothing.right is not None and nothing.right.share == 0.0
    assert accepted_at(CONFIDENCE, np.zeros(5, bool), 0.5).right is None


def test_the_threshold_for_a_risk_is_the_lowest_one_that_keeps_it():
    assert threshold_for(CONFIDENCE, RIGHT, 0.0) == 0.9
    assert threshold_for(CONFIDENCE, RIGHT, 0.3) == pytest.approx(0.3)
    assert threshold_for(CONFIDENCE, RIGHT, 1.0) == pytest.approx(0.1)
    assert threshold_for(np.array([0.9, 0.5]), np.array([False, True]), 0.01) is None


@pytest.mark.parametrize("confidence", [np.array([1.2]), np.array([np.nan]), np.array([]), np.array([[0.5]])])
def test_what_is_no_confidence_is_refused(confidence):
    with pytest.raises(ValueError, match="confidence"):
        brier(confidence, np.ones(len(confidence), bool))
