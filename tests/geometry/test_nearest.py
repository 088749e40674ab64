from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.bridge import cpu_threads
from utopic_cli.geometry.nearest import MANY, nearest, search_threads


def test_two_threads_find_what_one_finds() -> None:
    rng = np.random.default_rng(0)
    tree = cKDTree(rng.standard_normal((300, 3)))
    points = rng.standard_normal((2, MANY, 3))  # enough for two
    with search_threads(2):
        distance, index = nearest(tree, points, within=0.2)
    expected = tree.query(points, distance_upper_bound=0.2, workers=1)
    np.testing.assert_array_equal(distance, expected[0])
    np.testing.assert_array_equal(index, expected[1])
    assert np.isinf(distance).any() and index.max() == 300  # nothing within reach
    few, _ = nearest(tree, points[0, :5], range(1, 4))
    assert few.shape == (5, 3)


class Recorder(cKDTree):
    """A tree that remembers in how many threads it was searched."""

    workers = 0

    def query(self, points, *, workers, **kwargs):
        self.workers = workers
        return super().query(points, workers=workers, **kwargs)


def threads_of(tree: Recorder, points: np.ndarray) -> int:
    nearest(tree, points)
    return tree.workers


def test_threads_are_as_many_as_allowed_and_worth_it() -> None:
    rng = np.random.default_rng(0)
    tree, points = Recorder(rng.standard_normal((300, 3))), rng.standard_normal((3 * MANY, 3))
    assert threads_of(tree, points) == 1
    with search_threads(2):
        assert threads_of(tree, points) == 2
        assert threads_of(tree, points[: 2 * MANY - 1]) == 1
        with cpu_threads(3) as threads:  # what a registration is given reaches its searches
            assert (threads, threads_of(tree, points)) == (3, 3)
        assert threads_of(tree, points) == 2
    assert threads_of(tree, points) == 1
