"""Nearest neighbours of many points, in as many threads as there are to spare."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from scipy.spatial import cKDTree

MANY = 4000
"""Points worth a thread of their own: looking them up takes some fifty times as long as starting it."""

_threads: ContextVar[int] = ContextVar("threads", default=1)


@contextmanager
def search_threads(count: int) -> Iterator[None]:
    """Let ``nearest`` use up to ``count`` threads within a ``with`` block."""
    before = _threads.set(count)
    try:
        yield
    finally:
        _threads.reset(before)


def nearest(
    tree: cKDTree, points: np.ndarray, k: int | list[int] | range = 1, within: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Look up neighbours; the answer is the same whatever the number of threads.

    Args:
        tree: of the points to find.
        points: (..., 3) where to look from.
        k: as of ``cKDTree.query``: how many neighbours, or which.
        within: neighbours farther away are not found.

    Returns:
        Distances and rows, (...) or (..., k); inf and the number of points where none is found.
    """
    threads = max(1, min(_threads.get(), points.size // (3 * MANY)))
    distance, index = tree.query(points, k=k, distance_upper_bound=within, workers=threads)
    return distance, index
