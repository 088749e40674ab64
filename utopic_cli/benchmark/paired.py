"""Means over test pairs with their standard errors, and differences on the same pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

COVERAGE = 0.95


@dataclass(frozen=True)
class Figure:
    """A mean over pairs.

    Attributes:
        value: the figure.
        error: its standard error over the pairs; None of a single pair.
        pairs: how many had a value.
    """

    value: float
    error: float | None
    pairs: int


@dataclass(frozen=True)
class Difference:
    """The mean difference of two methods on the same pairs.

    Attributes:
        value: of the one minus the other.
        low: lower end of its 95 % interval over the pairs; None of a single pair.
        high: upper end.
        pairs: on how many both had a value.
        p_value: probability that chance among pairs alone makes so large a difference.
    """

    value: float
    low: float | None
    high: float | None
    pairs: int
    p_value: float


def mean_figure(values: Sequence[float | None]) -> Figure | None:
    """Average the values there are; None if there are none."""
    known = np.array([value for value in values if value is not None])
    return Figure(float(known.mean()), _standard_error(known), len(known)) if len(known) else None


def root_mean_square_figure(squares: Sequence[float | None]) -> Figure | None:
    """Return the root of the mean of each pair's mean square, with the error that follows from the mean's."""
    mean = mean_figure(squares)
    if mean is None:
        return None
    root = float(np.sqrt(mean.value))
    return Figure(
        root, None if mean.error is None else mean.error / (2.0 * root) if root else 0.0, mean.pairs
    )


def paired_difference(values: Sequence[float | None], others: Sequence[float | None]) -> Difference | None:
    """Compare two methods pair by pair, which leaves out how hard the pairs are.

    Args:
        values: one a pair; None where there is none.
        others: of the same pairs in the same order.

    Returns:
        The mean difference with Student's interval; None if no pair has both values.

    Raises:
        ValueError: the two are not of the same number of pairs.
    """
    if len(values) != len(others):
        raise ValueError(f"{len(values)} and {len(others)} values can't be paired")
    gaps = np.array([a - b for a, b in zip(values, others) if a is not None and b is not None])
    if not len(gaps):
        return None
    mean, error = float(gaps.mean()), _standard_error(gaps)
    if error is None:
        return Difference(mean, None, None, 1, 1.0)
    half = float(student.ppf(0.5 + COVERAGE / 2.0, len(gaps) - 1)) * error
    if error == 0.0:  # all alike: as likely as so many coins on one side
        p_value = 2.0 ** (1 - len(gaps)) if mean else 1.0
    else:
        p_value = float(2.0 * student.sf(abs(mean) / error, len(gaps) - 1))
    return Difference(mean, mean - half, mean + half, len(gaps), p_value)


def _standard_error(values: np.ndarray) -> float | None:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
