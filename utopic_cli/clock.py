"""Seconds per step, and a word to whoever watches or logs when a step starts."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)
Progress = Callable[[str], None]


class Clock:
    """A stopwatch with named steps."""

    def __init__(self, progress: Progress | None) -> None:
        """Tell ``progress`` the name of each step as it starts."""
        self._progress = progress
        self._seconds: dict[str, float] = {}
        self._step = ""
        self._since = 0.0

    def start(self, step: str) -> None:
        """End the step in hand and start another."""
        self._end()
        self._step, self._since = step, time.perf_counter()
        _log.info("%s", step)
        if self._progress is not None:
            self._progress(step)

    def stop(self) -> dict[str, float]:
        """End the last step and return seconds by step."""
        self._end()
        return self._seconds

    def _end(self) -> None:
        if self._step:
            self._seconds[self._step] = time.perf_counter() - self._since
        self._step = ""
