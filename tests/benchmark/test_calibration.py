"""Fitting the confidence to outcomes whose truth is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from utopic_cli.benchmark import calibration
from utopic_cli.benchmark.calibration import MOST_RISK, Outcome, calibrate, fit, outcome_of
from utopic_cli.errors import InputError, UsageError

FINE = {"fixed": -1.0, "contradiction": -2.5, "plausibility": 0.0, "spread": -3.0, "stiffness": 0.5}


def outcomes(count: int, seed: int, steepness: float = 6.0) -> list[Outcome]:
    """Answers that are right with a probability that grows with their margin."""
    rng = np.random.default_rng(seed)
    margin = rng.uniform(-1.0, 1.0, count)
    right = rng.random(count) < 1.0 / (1.0 + np.exp(-steepness * margin))
    noise = rng.normal(size=count)
    return [
        Outcome(
            i,
            "scans" if i % 3 else "disjoint",
            bool(right[i]),
            {"margin": margin[i], "noise": noise[i], **FINE},
        )
        for i in range(count)
    ]


def test_the_fit_describes_what_it_rests_on() -> None:
    found = fit(outcomes(600, 0), {"data": "made up"})
    about = found.description
    assert about["data"] == "made up" and about["answers"] == 600
    assert about["kinds"]["disjoint"][0] == 200 and sum(n for n, _ in about["kinds"].values()) == 600
    assert sum(right for _, right in about["kinds"].values()) == about["right"]
    seen = about["out_of_fold"]
    assert 0.9 < seen["auroc"] < 1.0 and seen["expected_calibration_error"] < 0.06
    assert seen["accepted_wrong"] <= MOST_RISK and 0.05 < seen["right_accepted"] < 1.0
    assert found.coefficients[0] > 5 * abs(found.coefficients[1])


def test_the_threshold_holds_on_other_outcomes() -> None:
    found = fit(outcomes(3000, 1), {})
    accepted = [o for o in outcomes(3000, 2) if found.probability(o.signals) >= found.threshold]
    assert len(accepted) > 100
    assert np.mean([not o.right for o in accepted]) < 3 * MOST_RISK


def test_what_is_ruled_out_anyway_does_not_raise_the_threshold() -> None:
    def accepted(fixed: float) -> float:
        loud = {"margin": 1.0, "noise": 0.0, **FINE, "fixed": fixed}
        wrong = [Outcome(3000 + i, "symmetric", False, loud) for i in range(30)]
        return fit(outcomes(3000, 4, 12.0) + wrong, {}).description["out_of_fold"]["right_accepted"]

    assert accepted(-4.0) > 1.5 * accepted(-2.0)


def test_the_clearer_the_signals_the_more_is_accepted() -> None:
    shares = [
        fit(outcomes(1000, 3, steepness), {}).description["out_of_fold"]["right_accepted"]
        for steepness in (4.0, 100.0)
    ]
    assert shares[1] > 3 * shares[0] and shares[1] > 0.7


def test_where_the_surest_answer_is_wrong_nothing_is_trusted() -> None:
    made = [Outcome(i, "scans", i % 2 == 0, {"margin": float(i % 2), **FINE}) for i in range(100)]
    made[1] = Outcome(1, "scans", False, {"margin": -5.0, **FINE})
    found = fit(made, {})
    worst = max(found.probability({"margin": value, **FINE}) for value in (-5.0, 0.0, 1.0))
    assert found.threshold > worst or found.description["out_of_fold"]["accepted_wrong"] <= MOST_RISK


def test_too_few_or_one_sided_outcomes_are_refused() -> None:
    with pytest.raises(ValueError, match="only 12 trials"):
        fit(outcomes(12, 0), {})
    right = [Outcome(i, "scans", True, {"margin": 1.0, **FINE}) for i in range(50)]
    with pytest.raises(ValueError, match="right answers and wrong ones"):
        fit(right, {})


@pytest.mark.parametrize("wrong", [{"trials": 5}, {"workers": 0}, {"seed": -1}])
def test_numbers_that_make_no_sense_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(UsageError):
        calibrate(SimpleNamespace(), "shapes", **wrong)  # type: ignore[arg-type]


def test_a_trial_becomes_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    made = SimpleNamespace(kind="scans", source=None, target=None, right=lambda T: bool(T[0, 0]))
    monkeypatch.setattr(calibration, "trial", lambda shapes, seed, number: made)
    answer = SimpleNamespace(T_target_source=np.eye(4), signals={"margin": 0.5})
    monkeypatch.setattr(calibration, "register", lambda source, target, options: answer)
    assert outcome_of(None, "", 0, None, 7) == Outcome(7, "scans", True, {"margin": 0.5})  # type: ignore[arg-type]

    def nothing_follows(*_: object) -> None:
        raise InputError("no transformation")

    monkeypatch.setattr(calibration, "register", nothing_follows)
    assert outcome_of(None, "", 0, None, 7) is None  # type: ignore[arg-type]
