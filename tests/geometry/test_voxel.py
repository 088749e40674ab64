from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.geometry.voxel import cell_means, voxel_downsample, voxel_index


def test_every_point_is_averaged_into_its_own_cell() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (2000, 3))
    means, owner = voxel_downsample(points, 0.1)
    assert owner.shape == (2000,) and set(owner) == set(range(len(means)))
    for cell in range(0, len(means), 50):
        members = points[owner == cell]
        assert np.ptp(members, axis=0).max() <= 0.1
        assert means[cell] == pytest.approx(members.mean(axis=0))
    assert len(np.unique(np.floor((points - points.min(axis=0)) / 0.1), axis=0)) == len(means)


def test_downsampling_moves_with_the_cloud() -> None:
    points = np.random.default_rng(1).uniform(0, 1, (300, 3))
    here, _ = voxel_downsample(points, 0.25)
    there, _ = voxel_downsample(points + [4096.0, -512.0, 64.0], 0.25)
    assert np.abs(there - [4096.0, -512.0, 64.0] - here).max() < 1e-9


def test_a_huge_cell_holds_everything() -> None:
    points = np.random.default_rng(2).normal(size=(20, 3))
    owner, count = voxel_index(points, 1e6)
    assert count == 1 and not owner.any()
    assert cell_means(points, owner, count)[0] == pytest.approx(points.mean(axis=0))


def test_cells_are_numbered_alike_in_small_and_large_grids(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(5).uniform(-1, 1, (500, 3))
    for size in (0.1, 0.3):
        numbered = voxel_index(points, size)
        monkeypatch.setattr("utopic_cli.geometry.voxel.FEW", 0)  # by sorting
        by_sorting = voxel_index(points, size)
        monkeypatch.undo()
        np.testing.assert_array_equal(numbered[0], by_sorting[0])
        assert numbered[1] == by_sorting[1] == numbered[0].max() + 1
