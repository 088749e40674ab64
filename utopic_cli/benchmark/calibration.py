"""Fitting the confidence: labelled trials, registered as a user's files are, teach what signals mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from utopic_cli.benchmark.held_out import made_of
from utopic_cli.benchmark.pool import each
from utopic_cli.benchmark.reliability import (
    accepted_at,
    auroc,
    brier,
    expected_calibration_error,
    threshold_for,
)
from utopic_cli.benchmark.trials import calibration_half, trial
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.estimation.confidence import Calibration, fit_calibration
from utopic_cli.pipeline import register
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.verdict import ruled_out

MOST_RISK = 0.01
"""Of the answers that are trusted, at most this share is to be wrong, measured out of fold."""

LEAST_CONFIDENCE = 0.8
"""Nor is a single answer trusted that is more likely wrong than once in five times."""

FOLDS = 10
RIDGE = 3.0
FEWEST = 40

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Outcome:
    """The answer to one trial.

    Attributes:
        number: of the trial.
        kind: of the trial.
        right: whether the answer was right.
        signals: by name.
    """

    number: int
    kind: str
    right: bool
    signals: dict[str, float]


def calibrate(
    shapes: ShapeLibrary,
    data: str,
    trials: int = 800,
    seed: int = 0,
    options: AlignOptions | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Calibration:
    """Fit the confidence of some weights.

    Args:
        shapes: a library; only ``trials.calibration_half`` of it is used.
        data: what to call it.
        trials: how many.
        seed: of the trials; the pipeline's is among the options.
        options: of the pipeline, above all the weights; the defaults if None.
        workers: processes, each with one thread; the result does not depend on their number.
        progress: called with (trials done, trials in all, what goes on).

    Raises:
        InputError: no held-out shapes, no trial can be made of them, the weights can't be used, or
            their answers are all right or all wrong.
        UsageError: a number makes no sense.
    """
    if trials < FEWEST or workers < 1 or seed < 0:
        raise UsageError(f"give at least {FEWEST} trials, one worker, and a seed that is not negative")
    half = calibration_half(shapes)

    def tell(done: int, of: int) -> None:
        if progress is not None:
            progress(done, of, f"trials of {data}")

    task = partial(_task, half, data, seed, options or AlignOptions())
    outcomes = [outcome for outcome in each(task, trials, workers, tell) if outcome is not None]
    about = {"data": data, "shapes": len(half), "trials": trials, "seed": seed}
    try:
        return fit(outcomes, about)
    except ValueError as error:
        raise InputError(f"{data}: {error}; give more trials or other shapes") from error


def fit(outcomes: list[Outcome], about: dict[str, Any]) -> Calibration:
    """Fit to outcomes, and choose the threshold by answers that the model had not seen.

    Args:
        outcomes: of many trials.
        about: where they come from; kept in the description.

    Raises:
        ValueError: too few outcomes, or all right or all wrong.
    """
    if len(outcomes) < FEWEST:
        raise ValueError(f"only {len(outcomes)} trials gave an answer; a calibration needs {FEWEST}")
    names = tuple(outcomes[0].signals)
    values = np.array([[outcome.signals[name] for name in names] for outcome in outcomes])
    right = np.array([outcome.right for outcome in outcomes])
    unseen = _out_of_fold(names, values, right)
    acceptable = np.where([ruled_out(outcome.signals) for outcome in outcomes], 0.0, unseen)
    threshold = threshold_for(acceptable, right, MOST_RISK)
    # Where the surest answer is wrong, only what is surer than all of them may pass.
    threshold = 1.0 if threshold is None else max(threshold, LEAST_CONFIDENCE)
    accepted = accepted_at(acceptable, right, threshold)
    description = {
        **about,
        "answers": len(outcomes),
        "right": int(right.sum()),
        "kinds": {
            kind: [
                sum(outcome.kind == kind for outcome in outcomes),
                sum(outcome.kind == kind and outcome.right for outcome in outcomes),
            ]
            for kind in sorted({outcome.kind for outcome in outcomes})
        },
        "out_of_fold": {
            "auroc": auroc(unseen, right),
            "brier": brier(unseen, right),
            "expected_calibration_error": expected_calibration_error(unseen, right),
            "right_accepted": accepted.right.share if accepted.right else None,
            "accepted_wrong": accepted.wrong.share if accepted.wrong else None,
        },
    }
    return fit_calibration(names, values, right, threshold=threshold, ridge=RIDGE, description=description)


def _out_of_fold(names: tuple[str, ...], values: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Confidence (N,) of each answer by a model fitted to other answers."""
    unseen = np.empty(len(right))
    # Right and wrong ones are dealt out in turn, so that every fold has both.
    fold = np.empty(len(right), dtype=np.int64)
    fold[np.argsort(right, kind="stable")] = np.arange(len(right)) % FOLDS
    for number in range(FOLDS):
        held = fold == number
        model = fit_calibration(names, values[~held], right[~held], threshold=1.0, ridge=RIDGE)
        unseen[held] = model.probabilities(values[held])
    return unseen


def _task(
    shapes: ShapeLibrary, data: str, seed: int, options: AlignOptions
) -> Callable[[int], Outcome | None]:
    return partial(outcome_of, shapes, data, seed, options)


def outcome_of(
    shapes: ShapeLibrary, data: str, seed: int, options: AlignOptions, number: int
) -> Outcome | None:
    """Make trial ``number`` and register it; None where no transformation follows from the scans.

    Raises:
        InputError: no such trial can be made of the shapes.
    """
    with made_of(data):
        made = trial(shapes, seed, number)
    try:
        result = register(made.source, made.target, options)
    except InputError:
        return None
    return Outcome(number, made.kind, made.right(result.T_target_source), result.signals)
