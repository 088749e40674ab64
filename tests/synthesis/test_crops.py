from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.synthesis.crops import half_space_crop, nearest_crop


@pytest.mark.parametrize(("keep", "count"), [(0.7, 717), (0.5, 512), (1.0, 1024)])
def test_half_space_crop_keeps_the_papers_counts_on_one_side(keep, count):
    points = np.random.default_rng(0).standard_normal((1024, 3))
    kept = half_space_crop(points, np.array([1.0, 2.0, 0.0]), keep)
    assert len(kept) == count == len(set(kept.tolist()))
    along = points @ [1.0, 2.0, 0.0]
    left_out = np.setdiff1d(np.arange(1024), kept)
    assert left_out.size == 0 or along[kept].min() >= along[left_out].max()


def test_nearest_crop_keeps_the_nearest():
    points = np.random.default_rng(1).standard_normal((500, 3))
    kept = nearest_crop(points, np.array([3.0, 0.0, 0.0]), 200)
    distance = np.linalg.norm(points - [3.0, 0.0, 0.0], axis=1)
    assert distance[kept].max() == np.sort(distance)[199]
