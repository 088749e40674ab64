"""PLY files of our own, and the colours in them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points
from utopic_cli.io.colour import colour_map
from utopic_cli.io.ply_writer import merged_cloud_ply, scalar_cloud_ply
from utopic_cli.io.scan import read_scan


def test_scalar_cloud_reads_back_everywhere(tmp_path: Path) -> None:
    import open3d
    import trimesh

    points = bumpy_points() + [4e5, 5e6, 0.1]
    overlap = np.linspace(0, 1, 80, dtype=np.float32)
    colours = colour_map(overlap)
    data = scalar_cloud_ply(points, colours, {"overlap": overlap, "uncertainty": 1 - overlap}, ["made here"])
    path = tmp_path / "cloud.ply"
    path.write_bytes(data)
    np.testing.assert_array_equal(read_scan(path).cloud.points, points)
    cloud = open3d.t.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(cloud.point.positions.numpy(), points)
    np.testing.assert_array_equal(cloud.point.colors.numpy(), colours)
    np.testing.assert_array_equal(cloud.point.overlap.numpy()[:, 0], overlap)
    np.testing.assert_array_equal(cloud.point.uncertainty.numpy()[:, 0], 1 - overlap)
    other = trimesh.load(io.BytesIO(data), file_type="ply")
    np.testing.assert_array_equal(other.vertices, points)
    assert b"\ncomment made here\n" in data


def test_merged_cloud_says_which_scan() -> None:
    import trimesh

    points = bumpy_points()
    data = merged_cloud_ply(points[:30], points[30:])
    vertices = trimesh.load(io.BytesIO(data), file_type="ply").metadata["_ply_raw"]["vertex"]["data"]
    assert vertices["scan"].ravel().tolist() == [0.0] * 30 + [1.0] * 50
    np.testing.assert_array_equal(vertices["z"].ravel(), points[:, 2])


@pytest.mark.parametrize(
    ("scalars", "comments"),
    [({"a b": np.zeros(80)}, []), ({"a": np.zeros(79)}, []), ({}, ["two\nelement lines"])],
)
def test_what_does_not_fit_is_refused(scalars: dict, comments: list[str]) -> None:
    with pytest.raises(ValueError):
        scalar_cloud_ply(bumpy_points(), np.zeros((80, 3), np.uint8), scalars, comments)


def test_more_is_redder() -> None:
    colours = colour_map(np.array([-1.0, 0.0, 0.25, 0.5, 0.75, 1.0, 2.0, np.nan])).astype(int)
    assert colours.shape == (8, 3)
    np.testing.assert_array_equal(colours[0], colours[1])
    np.testing.assert_array_equal(colours[5], colours[6])
    np.testing.assert_array_equal(colours[7], [128, 128, 128])
    warmth = (lambda c: c[:, 0] - c[:, 2])(colour_map(np.linspace(0, 1, 101)).astype(int))
    assert warmth[0] < -80 and warmth[-1] > 150
    assert (np.diff(warmth) >= -1).all()  # but for rounding
