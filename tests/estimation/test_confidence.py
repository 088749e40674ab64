"""The logistic model against made-up signals whose probabilities are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from utopic_cli.estimation.confidence import Calibration, fit_calibration


def known_model(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signals (N, 2), labels drawn from known probabilities, and those."""
    values = rng.normal(0.0, 1.0, (count, 2)) * [1.0, 10.0] + [0.0, 5.0]
    probability = 1.0 / (1.0 + np.exp(-(2.0 * values[:, 0] - 0.1 * values[:, 1])))
    return values, rng.random(count) < probability, probability


@pytest.fixture(scope="module")
def model() -> Calibration:
    values, right, _ = known_model(4000, np.random.default_rng(0))
    return fit_calibration(("near", "far"), values, right, threshold=0.9, description={"pairs": 4000})


def test_known_probabilities_are_found_again(model: Calibration) -> None:
    values, _, probability = known_model(1000, np.random.default_rng(1))
    assert np.abs(model.probabilities(values) - probability).mean() < 0.02
    slopes = model.coefficients / model.deviation
    np.testing.assert_allclose(slopes, [2.0, -0.1], rtol=0.12)


def test_one_answer_equals_its_row(model: Calibration) -> None:
    one = model.probability({"far": 3.0, "near": 0.5, "other": np.nan})
    assert one == pytest.approx(model.probabilities(np.array([[0.5, 3.0]]))[0], abs=1e-15)


def test_signals_beyond_the_calibration_are_clipped_to_it(model: Calibration) -> None:
    most = model.probability({"near": model.high[0], "far": 5.0})
    assert model.probability({"near": 1e6, "far": 5.0}) == most < 1.0


def test_a_signal_that_is_missing_or_not_finite_is_an_error(model: Calibration) -> None:
    for signals in ({"near": 0.0}, {"near": 0.0, "far": np.nan}, {"near": np.inf, "far": 0.0}):
        with pytest.raises(ValueError, match="no finite value"):
            model.probability(signals)


def test_a_card_keeps_every_bit(model: Calibration) -> None:
    again = Calibration.from_dict(json.loads(json.dumps(model.as_dict())))
    values, _, _ = known_model(50, np.random.default_rng(2))
    assert np.array_equal(again.probabilities(values), model.probabilities(values))
    assert again.threshold == 0.9 and again.description == {"pairs": 4000}


@pytest.mark.parametrize(
    "damage",
    [
        lambda card: card.pop("intercept"),
        lambda card: card["mean"].pop(),
        lambda card: card.update(coefficients=[1.0, float("nan")]),
        lambda card: card.update(deviation=[0.0, 1.0]),
        lambda card: card.update(signals=None),
        lambda card: card.update(threshold="high"),
    ],
)
def test_a_damaged_card_is_an_error(model: Calibration, damage) -> None:  # type: ignore[no-untyped-def]
    card = model.as_dict()
    damage(card)
    with pytest.raises(ValueError, match="calibration"):
        Calibration.from_dict(card)


def test_signals_that_separate_give_finite_coefficients() -> None:
    values = np.linspace(-1.0, 1.0, 40)[:, None]
    model = fit_calibration(("one",), values, values[:, 0] > 0, threshold=0.5)
    assert np.isfinite(model.coefficients).all()
    assert model.probability({"one": 0.9}) > 0.9 > 0.1 > model.probability({"one": -0.9})


def test_a_constant_signal_says_nothing() -> None:
    values, right, _ = known_model(300, np.random.default_rng(3))
    values = np.column_stack([values, np.full(300, 7.0)])
    model = fit_calibration(("near", "far", "flat"), values, right, threshold=0.5)
    for flat in (7.0, 99.0):
        assert model.probability({"near": 0.2, "far": 1.0, "flat": flat}) == pytest.approx(
            model.probability({"near": 0.2, "far": 1.0, "flat": 7.0})
        )


def test_what_can_not_be_fitted_is_an_error() -> None:
    values, right, _ = known_model(20, np.random.default_rng(4))
    with pytest.raises(ValueError, match="right answers and wrong ones"):
        fit_calibration(("a", "b"), values, np.ones(20, bool), threshold=0.5)
    with pytest.raises(ValueError, match="shape"):
        fit_calibration(("a",), values, right, threshold=0.5)
    broken = values.copy()
    broken[3, 1] = np.nan
    with pytest.raises(ValueError, match="finite"):
        fit_calibration(("a", "b"), broken, right, threshold=0.5)


def test_a_stronger_ridge_gives_smaller_coefficients() -> None:
    values, right, _ = known_model(200, np.random.default_rng(5))
    loose, tight = (
        fit_calibration(("a", "b"), values, right, threshold=0.5, ridge=ridge) for ridge in (0.1, 100.0)
    )
    assert np.abs(tight.coefficients).sum() < 0.7 * np.abs(loose.coefficients).sum()
    assert replace(tight, threshold=0.1).threshold == 0.1
