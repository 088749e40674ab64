"""ICP from where the scans lie: open3d-icp, small-gicp."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from utopic_cli.benchmark.baselines import BASELINES, find_baselines
from utopic_cli.benchmark.gicp import SmallGicp
from utopic_cli.benchmark.method import Trial, remarks
from utopic_cli.benchmark.metrics import PoseError, pair_extent, pose_error
from utopic_cli.errors import UsageError
from utopic_cli.geometry.rigid import apply, invert, rigid
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.demo_object import demo_pair

LIBRARIES = {"open3d-icp": "open3d", "small-gicp": "small_gicp"}


@pytest.fixture(scope="module")
def in_place() -> tuple[np.ndarray, np.ndarray]:
    """Two views that lie on each other."""
    views = demo_pair(np.random.default_rng(0), points=8000)
    return apply(views.gt_T_target_source, views.source.points), views.target.points


def measured(
    name: str, clouds: tuple[np.ndarray, np.ndarray], degrees: float, shift: float, scale: float = 1.0
) -> PoseError:
    """Turn the source about its centroid, shift it by a share of the extent, and align it."""
    pytest.importorskip(LIBRARIES[name])
    source, target = PointCloud(clouds[0] * scale), PointCloud(clouds[1] * scale)
    extent = pair_extent(source, target)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix()
    centroid = source.points.mean(axis=0)
    motion = rigid(turn, centroid - turn @ centroid + np.array([shift * extent, 0.0, 0.0]))
    trial = Trial(source.transformed(motion), target, extent, 0)
    answer = BASELINES[name].estimate(trial)
    return pose_error(answer, invert(motion), trial.source.points.mean(axis=0), extent)


@pytest.mark.parametrize("name", LIBRARIES)
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_near_the_answer_it_finds_it_in_any_unit(name: str, scale: float, in_place: Any) -> None:
    error = measured(name, in_place, 10.0, 0.03, scale)
    assert error.success and error.rre_deg < 1.0 and error.rte_share < 0.01


@pytest.mark.parametrize("name", LIBRARIES)
def test_it_does_not_look_for_scans_that_lie_elsewhere(name: str, in_place: Any) -> None:
    with pytest.raises(RuntimeError, match="no correspondence within reach"):
        measured(name, in_place, 0.0, 50.0)


def test_the_start_is_in_the_settings_and_in_the_remarks() -> None:
    pytest.importorskip("open3d")
    settings = {name: BASELINES[name].settings() for name in ("open3d-ransac", "open3d-icp")}
    assert settings["open3d-icp"]["start"] == "identity"
    (line,) = remarks(settings)
    assert line.startswith("open3d-icp: local; started from the identity")
    assert remarks({"open3d-ransac": settings["open3d-ransac"]}) == []


def test_without_small_gicp_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(UsageError, match="pip install small-gicp"):
        find_baselines(["small-gicp"])
    with pytest.raises(UsageError, match="small_gicp"):
        SmallGicp().settings()


def test_lengths_are_counted_in_the_extent_but_never_below_the_spacing() -> None:
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    dense, sparse = PointCloud(grid), PointCloud(grid[::7])
    extent = pair_extent(dense, dense)
    assert Trial(dense, dense, extent, 0).voxel(5.0, 1.0) == pytest.approx(extent / 5.0)
    assert Trial(dense, dense, extent, 0).voxel(1000.0, 2.0) == pytest.approx(2.0, rel=0.2)
    assert Trial(dense, sparse, extent, 0).voxel(1000.0, 2.0) > 2.5
