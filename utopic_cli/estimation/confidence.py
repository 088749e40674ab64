"""From signals to the probability that a transformation is right: a calibrated logistic model.

The coefficients belong to the weights they were fitted with and travel in their card. Signals are
clipped to the range met in the calibration: beyond it, the model would only guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import minimize

CLIPPED = (1.0, 99.0)
"""Percentiles of the calibration's signals that later ones are clipped to."""


@dataclass(frozen=True)
class Calibration:
    """A logistic model of ``P(right | signals)``.

    Attributes:
        signals: names of the K signals, in order.
        low: (K,) smallest value taken as it is.
        high: (K,) largest value taken as it is.
        coefficients: (K,) for signals moved to zero mean and unit deviation.
        mean: (K,) of the clipped signals.
        deviation: (K,) of the clipped signals, positive.
        intercept: log-odds at the means.
        threshold: least confidence that is trusted.
        description: what it was fitted on and how well it did, JSON-ready.
    """

    signals: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    coefficients: np.ndarray
    intercept: float
    threshold: float
    description: dict[str, Any] = field(default_factory=dict)

    def probability(self, signals: dict[str, float]) -> float:
        """Return the confidence in [0, 1].

        Args:
            signals: by name; more than the model's are allowed.

        Raises:
            ValueError: a signal of the model is missing or not finite.
        """
        missing = [name for name in self.signals if not np.isfinite(signals.get(name, np.nan))]
        if missing:
            raise ValueError(f"no finite value for the signal {', '.join(missing)}")
        values = np.array([signals[name] for name in self.signals])
        return float(self.probabilities(values[None])[0])

    def probabilities(self, values: np.ndarray) -> np.ndarray:
        """Return the confidence (N,) of (N, K) signals in the order of ``signals``."""
        standard = (np.clip(values, self.low, self.high) - self.mean) / self.deviation
        return _logistic(standard @ self.coefficients + self.intercept)

    def as_dict(self) -> dict[str, Any]:
        """Return the section of a weights' card."""
        columns = {name: getattr(self, name).tolist() for name in _COLUMNS}
        return {
            "signals": list(self.signals),
            **columns,
            "intercept": self.intercept,
            "threshold": self.threshold,
            "description": self.description,
        }

    @classmethod
    def from_dict(cls, section: dict[str, Any]) -> Calibration:
        """Read the section of a weights' card.

        Raises:
            ValueError: a part is missing, of another length than the signals, or no finite number.
        """
        try:
            signals = tuple(str(name) for name in section["signals"])
            columns = {name: np.array(section[name], dtype=np.float64) for name in _COLUMNS}
            numbers = {name: float(section[name]) for name in ("intercept", "threshold")}
            description = dict(section.get("description", {}))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"the calibration can't be read: {error!r}") from error
        for name, column in columns.items():
            if column.shape != (len(signals),) or not np.isfinite(column).all():
                raise ValueError(f"the calibration's {name} are not {len(signals)} numbers")
        sound = (columns["deviation"] > 0).all() and (columns["low"] <= columns["high"]).all()
        if not (signals and sound and np.isfinite(list(numbers.values())).all()):
            raise ValueError("the calibration's numbers make no model")
        return cls(
            signals=signals,
            low=columns["low"],
            high=columns["high"],
            mean=columns["mean"],
            deviation=columns["deviation"],
            coefficients=columns["coefficients"],
            intercept=numbers["intercept"],
            threshold=numbers["threshold"],
            description=description,
        )


_COLUMNS = ("low", "high", "mean", "deviation", "coefficients")


def fit_calibration(
    signals: Sequence[str],
    values: np.ndarray,
    right: np.ndarray,
    *,
    threshold: float,
    ridge: float = 1.0,
    description: dict[str, Any] | None = None,
) -> Calibration:
    """Fit a logistic model by penalised maximum likelihood.

    Args:
        signals: names of the K signals.
        values: (N, K) signals of N answers.
        right: (N,) bool, whether each answer was right.
        threshold: least confidence to be trusted.
        ridge: weight of half the squared coefficients beside the sum of log-losses; keeps them
            finite where the signals separate right from wrong without exception.
        description: kept with the model.

    Raises:
        ValueError: arrays that do not fit together, values that are not finite, or answers that
            are all right or all wrong.
    """
    values, right = np.asarray(values, np.float64), np.asarray(right, bool)
    if values.shape != (len(right), len(signals)) or not np.isfinite(values).all():
        raise ValueError(f"signals of shape {values.shape}; expected finite {(len(right), len(signals))}")
    if right.all() or not right.any():
        raise ValueError("a calibration needs right answers and wrong ones")
    low, high = np.percentile(values, CLIPPED, axis=0)
    clipped = np.clip(values, low, high)
    mean, deviation = clipped.mean(axis=0), clipped.std(axis=0)
    deviation = np.where(deviation > 1e-9, deviation, 1.0)
    standard = np.column_stack([(clipped - mean) / deviation, np.ones(len(right))])
    sign = np.where(right, 1.0, -1.0)

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (standard @ parameters)
        gradient = -(standard * (sign * _logistic(-margin))[:, None]).sum(axis=0)
        penalised = np.append(parameters[:-1], 0.0)
        return float(np.logaddexp(0.0, -margin).sum() + 0.5 * ridge * penalised @ penalised), (
            gradient + ridge * penalised
        )

    best = minimize(loss, np.zeros(standard.shape[1]), jac=True, method="L-BFGS-B").x
    return Calibration(
        signals=tuple(signals),
        low=low,
        high=high,
        mean=mean,
        deviation=deviation,
        coefficients=best[:-1],
        intercept=float(best[-1]),
        threshold=threshold,
        description=description or {},
    )


def _logistic(values: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), without overflow."""
    return np.exp(-np.logaddexp(0.0, -values))
