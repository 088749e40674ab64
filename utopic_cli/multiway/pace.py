"""How far the jobs of a batch are."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[str], None]


class Pace:
    """Says how much is done and about how long the rest takes, at the pace so far."""

    def __init__(self, kind: str, total: int, left: int, progress: Progress) -> None:
        """Begin, with so many of ``total`` jobs left."""
        self._kind = kind
        self._total = total
        self._before = total - left
        self._done = 0
        self._begin = time.monotonic()
        self._progress = progress
        if left:
            progress(f"{self._before}/{total} {kind}")

    def step(self, name: str) -> None:
        """Count one more."""
        self._done += 1
        each = (time.monotonic() - self._begin) / self._done
        done = self._before + self._done
        minutes, seconds = divmod(round(each * (self._total - done)), 60)
        left = f"{each:.1f} s each, about {minutes}:{seconds:02d} left"
        self._progress(f"{done}/{self._total} {self._kind}, {left}: {name}")
