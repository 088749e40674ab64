"""The pace of a run: when to stop, how fast it goes, and what it has been asked by signals."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch


class InterruptedRun(KeyboardInterrupt):
    """Ctrl-C ended a run after it was saved and exported.

    Attributes:
        weights: path of the exported weights.
    """

    def __init__(self, weights: Path) -> None:
        """Say where the weights are."""
        super().__init__()
        self.weights = weights


@dataclass(frozen=True)
class Limits:
    """When to stop before the schedule ends.

    Attributes:
        minutes: most minutes of this session; None for no limit.
        asked: tells whether somebody asked to stop.
        started: by the monotonic clock.
    """

    minutes: float | None
    asked: Callable[[], bool]
    started: float = field(default_factory=time.monotonic)

    def seconds_left(self) -> float:
        """Seconds until time is up; infinite without a limit."""
        if self.minutes is None:
            return math.inf
        return 60.0 * self.minutes - (time.monotonic() - self.started)


class Meter:
    """Sums since the last record; read as floats only then, so that a GPU is never waited for."""

    def __init__(self) -> None:
        """Start counting now."""
        self.begun = time.monotonic()
        self.waited = 0.0
        self.pairs = self.batches = 0
        self.sums: dict[str, torch.Tensor] = {}

    def add(self, terms: dict[str, torch.Tensor], pairs: int) -> None:
        """Count one batch."""
        for name, term in terms.items():
            self.sums[name] = self.sums.get(name, torch.zeros_like(term.detach())) + term.detach()
        self.pairs, self.batches = self.pairs + pairs, self.batches + 1

    def seconds(self) -> float:
        """Seconds since the last record."""
        return time.monotonic() - self.begun

    def rate(self) -> float:
        """Pairs a second."""
        return self.pairs / max(self.seconds(), 1e-9)

    def read(self) -> dict[str, float]:
        """Return speed, share of the time spent waiting for pairs, and mean loss terms."""
        means = {name: round(float(value) / self.batches, 4) for name, value in self.sums.items()}
        waiting = self.waited / max(self.seconds(), 1e-9)
        return {"pairs_per_s": round(self.rate(), 2), "waiting": round(waiting, 3), **means}


@contextmanager
def caught_signals() -> Iterator[list[int]]:
    """Collect SIGTERM and the first Ctrl-C, so that the step in hand is finished and saved."""
    received: list[int] = []

    def note(number: int, _: object) -> None:
        if number in received:
            raise KeyboardInterrupt
        received.append(number)

    previous = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
