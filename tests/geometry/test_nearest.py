from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

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
