from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmark.conftest import ScanFolder
from utopic_cli.benchmark.baselines import find_baselines
from utopic_cli.benchmark.kiss import KissMatcher, answer_of_child
from utopic_cli.benchmark.method import Trial
from utopic_cli.benchmark.metrics import pair_extent, pose_error
from utopic_cli.benchmark.scans import run_methods
from utopic_cli.errors import UsageError
from utopic_cli.geometry.rigid import is_rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.demo_object import demo_pair
from utopic_cli.synthesis.scan_pair import ScanPair

forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="crashes are contained by forking")


def trial(source: np.ndarray, target: np.ndarray) -> Trial:
    clouds = PointCloud(source), PointCloud(target)
    nowhere: Any = None
    return Trial(*clouds, pair_extent(*clouds), 0, np.eye(4), nowhere, nowhere)


@pytest.fixture(scope="module")
def views() -> ScanPair:
    return demo_pair(np.random.default_rng(0), points=30_000)


@forks
def test_registers_an_easy_pair_and_gets_the_same_refinement(views: ScanPair, tmp_path: Path) -> None:
    pytest.importorskip("kiss_matcher")
    for name, points in (("a", views.source.points[::2]), ("b", views.source.points[1::2])):
        (tmp_path / f"{name}.ply").write_bytes(scalar_cloud_ply(points, np.zeros(points.shape, np.uint8), {}))
    scans = ScanFolder(tmp_path, np.eye(4))
    scans.write({"pairs": [scans.pair()]})
    methods = find_baselines(["kiss-matcher"])
    refined, raw = (run_methods(methods, tmp_path, poses=1, refine=on).attempts[0] for on in (True, False))
    assert refined.message is None and refined.error is not None and raw.error is not None
    assert refined.success and refined.error.rre_deg < raw.error.rre_deg
    assert refined.cpu_seconds > 0


@forks
def test_answers_although_torch_has_used_several_threads_before(views: ScanPair) -> None:
    import torch

    pytest.importorskip("kiss_matcher")
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.rand(1000, 1000).exp().sum()  # OpenMP now has a second thread, which no fork takes along
    torch.set_num_threads(before)
    case = trial(views.source.points[::8], views.source.points[1::8])
    assert is_rigid(KissMatcher(patience_s=60.0).estimate(case), 1e-4)


@forks
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_unit_and_the_place_do_not_matter(views: ScanPair, scale: float) -> None:
    pytest.importorskip("kiss_matcher")
    far = np.array([4e5, 5e6, 300.0]) * scale  # too large for the float32 that it computes in
    moved = PointCloud(views.source.points[1::2]).transformed(views.gt_T_target_source)
    case = trial(views.source.points[::2] * scale + far, moved.points * scale)
    gt = views.gt_T_target_source.copy()
    gt[:3, 3] = scale * gt[:3, 3] - gt[:3, :3] @ far
    found = KissMatcher().estimate(case)
    assert is_rigid(found, 1e-6)
    assert pose_error(found, gt, case.source.points.mean(axis=0), case.extent).success


@forks
@pytest.mark.parametrize("count", [4, 100])
def test_voxels_that_it_cannot_bear_are_failures_not_crashes(count: int) -> None:
    pytest.importorskip("kiss_matcher")
    points = np.random.default_rng(1).random((count, 3))
    with pytest.raises(RuntimeError, match=r"it crashed|no valid solution"):
        KissMatcher(spacings_per_voxel=0.1).estimate(trial(points, points))


@forks
def test_what_happens_in_the_child_stays_there() -> None:
    expected = np.eye(3), np.ones(3)
    answer = answer_of_child(lambda: expected, 10)
    assert answer is not None and np.array_equal(answer[0], expected[0])
    assert answer_of_child(lambda: None, 10) is None

    def die() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def fail() -> None:
        raise ValueError("too small")

    with pytest.raises(RuntimeError, match=r"it crashed \(SIGKILL\)"):
        answer_of_child(die, 10)
    with pytest.raises(RuntimeError, match="ValueError: too small"):
        answer_of_child(fail, 10)
    begin = time.monotonic()
    with pytest.raises(RuntimeError, match=r"no answer within 0\.2 s"):
        answer_of_child(lambda: time.sleep(60), 0.2)
    assert time.monotonic() - begin < 10


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)
    monkeypatch.setattr("multiprocessing.get_all_start_methods", lambda: ["spawn", "fork"])
    with pytest.raises(UsageError, match="install it: pip install kiss-matcher"):
        find_baselines(["kiss-matcher"])


def test_where_nothing_can_fork_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("multiprocessing.get_all_start_methods", lambda: ["spawn"])
    with pytest.raises(UsageError, match="Linux and macOS only"):
        find_baselines(["kiss-matcher"])
