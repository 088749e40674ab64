"""Clocks and scales of the protocol ``speed``."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def cpu_seconds_so_far() -> float:
    """CPU time of this process, all its threads, and the processes it has waited for."""
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


class Stopwatch:
    """Wall and CPU seconds of laps, the first of which warms up and doesn't count."""

    def __init__(self, device: torch.device | None = None) -> None:
        """Time what runs on a device; None: on the CPU."""
        self._device = device
        self._laps: list[tuple[float, float]] = []

    @contextmanager
    def lap(self) -> Iterator[None]:
        """Time the block, to the end of what it has started on the device."""
        self._finish()
        wall, cpu = time.perf_counter(), cpu_seconds_so_far()
        yield
        self._finish()
        self._laps.append((time.perf_counter() - wall, cpu_seconds_so_far() - cpu))

    @property
    def wall_seconds(self) -> float:
        """Median over the laps that count."""
        return float(np.median([wall for wall, _ in self._laps[1:]]))

    @property
    def cpu_seconds(self) -> float:
        """Median over the laps that count, of all threads and processes."""
        return float(np.median([cpu for _, cpu in self._laps[1:]]))

    @property
    def laps(self) -> int:
        """How many count."""
        return len(self._laps) - 1

    def _finish(self) -> None:
        if self._device is not None and self._device.type == "cuda":
            import torch

            torch.cuda.synchronize(self._device)


class Peak:
    """Peak memory since it was made, and what was in use then, in bytes."""

    def __init__(self, device: torch.device | None = None) -> None:
        """Watch a CUDA device's memory as PyTorch holds it; otherwise that of this process."""
        self._cuda = device if device is not None and device.type == "cuda" else None
        if self._cuda is not None:
            import torch

            torch.cuda.reset_peak_memory_stats(self._cuda)
            self.idle_bytes: int | None = torch.cuda.memory_allocated(self._cuda)
        else:
            self.idle_bytes = peak_memory()

    @property
    def peak_bytes(self) -> int | None:
        """The peak; None where the system doesn't tell."""
        if self._cuda is None:
            return peak_memory()
        import torch

        return torch.cuda.max_memory_allocated(self._cuda)


def peak_memory() -> int | None:
    """Return the most memory this process has held so far, bytes; None where the system doesn't tell."""
    # Not getrusage where it can be helped: on Linux it remembers the parent's size from before exec.
    status = _field(Path("/proc/self/status"), "VmHWM:")
    if status is not None:
        return status
    try:
        import resource
    except ImportError:  # Windows
        return None
    # No Linux to speak of is left here; macOS counts bytes, the others kilobytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def available_memory() -> int | None:
    """Return how many bytes can still be used without swapping; None where the system doesn't tell."""
    return _field(Path("/proc/meminfo"), "MemAvailable:")


def _field(file: Path, name: str) -> int | None:
    """Read a line ``name 123 kB`` of a status file of Linux, in bytes."""
    try:
        lines = file.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(name):
            return int(line.split()[1]) * 1024
    return None
