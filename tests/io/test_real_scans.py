"""Real files beside the repository, where there are any."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import motion, moved
from utopic_cli.io.scan import read_scan

SCANS = Path(os.environ.get("UTOPIC_SHARED", Path(__file__).parents[3] / "shared")) / "scans"
pytestmark = pytest.mark.skipif(not SCANS.is_dir(), reason="no real scans here")

FILES = {
    "bunny/bun000.ply": (40256, 40256),
    "bunny/ear_back.ply": (32193, 32193),
    "lidar/source.ply": (69792, 69792),
    "indoor/source_cloud_bin_5.ply": (19084, 19084),
    "pcd/capture0001.pcd": (307200 - 57553, 307200),
    "pcd/object_template_0.pcd": (1397, 1397),
    "pcd/room_scan1.pcd": (112586, 112586),
}


@pytest.mark.parametrize("name", FILES)
def test_reads_whole_and_fast(name: str) -> None:
    start = time.perf_counter()
    scan = read_scan(SCANS / name)
    assert time.perf_counter() - start < 5  # generous: 0.3 s on an idle machine
    assert (len(scan.cloud), scan.records) == FILES[name]


@pytest.mark.parametrize("name", ["bunny/bun045.ply", "lidar/target.ply", "pcd/object_template_0.pcd"])
def test_agrees_with_open3d_before_and_after_moving(tmp_path: Path, name: str) -> None:
    import open3d

    scan, T = read_scan(SCANS / name), motion()
    if name != "pcd/object_template_0.pcd":  # open3d can't be trusted with padding fields
        points = np.asarray(open3d.io.read_point_cloud(str(SCANS / name)).points)
        np.testing.assert_allclose(scan.cloud.points, points, atol=1e-6 * np.abs(points).max())
    path = tmp_path / Path(name).name
    path.write_bytes(scan.moved(T))
    again = read_scan(path).cloud.points
    np.testing.assert_allclose(again, moved(scan.cloud.points, T), atol=1e-6 * np.abs(again).max())


def test_range_grid_is_kept() -> None:
    scan = read_scan(SCANS / "bunny/bun090.ply")
    data, again = (SCANS / "bunny/bun090.ply").read_bytes(), scan.moved(motion())
    assert data.split(b"\n")[-204800:] == again.split(b"\n")[-204800:]
    assert data.split(b"end_header")[0] == again.split(b"end_header")[0]


def test_organised_capture_keeps_its_grid(tmp_path: Path) -> None:
    scan = read_scan(SCANS / "pcd/capture0001.pcd")
    path = tmp_path / "moved.pcd"
    path.write_bytes(scan.moved(np.eye(4)))
    again = read_scan(path)
    np.testing.assert_array_equal(again.kept, scan.kept)
    np.testing.assert_array_equal(again.cloud.points, scan.cloud.points)
    assert b"WIDTH 640\nHEIGHT 480\nVIEWPOINT 0.0 0.0 0.0 0.0 1.0 0.0 0.0\n" in path.read_bytes()[:400]
