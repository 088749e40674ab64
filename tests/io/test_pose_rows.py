"""Poses in the place of points: their rows would be read as coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points, motion, unit_normals
from utopic_cli.errors import InputError
from utopic_cli.io.pose_rows import START_BYTES, poses_in
from utopic_cli.io.scan import read_scan
from utopic_cli.io.transformation import format_transformation

MOTIONS = [motion(0.1 + 0.001 * i, (i, -i, 0.5)) for i in range(80)]
KITTI = b"".join(format_transformation(T, "kitti") for T in MOTIONS)
TUM = b"".join(
    b"%d" % i + format_transformation(T, "tum").removeprefix(b"0") for i, T in enumerate(MOTIONS)
)  # fmt: skip


def rows(*columns: np.ndarray) -> bytes:
    return "\n".join(" ".join(map(repr, row)) for row in np.column_stack(columns).tolist()).encode()


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (KITTI, "a table of poses"),
        (KITTI.replace(b" ", b","), "a table of poses"),
        (KITTI * (1 + START_BYTES // len(KITTI)), "a table of poses"),
        (b"# timestamp tx ty tz qx qy qz qw\n" + TUM, "a table of poses"),
        (TUM, "a table of poses"),
        (b"".join(format_transformation(T, "open3d") for T in MOTIONS), "a table of poses"),
        (b"name;tx;ty;tz;qw;qx;qy;qz\na;1;2;3;1;0;0;0\n", "a table of poses"),
        (format_transformation(MOTIONS[0], "matrix"), "a 4x4 matrix"),
        (format_transformation(np.diag([2.0, 2, 2, 1]), "matrix"), "a 4x4 matrix"),
        (b"[[1 0 0 0]\n[0 1 0 0]\n[0 0 1 0]\n[0 0 0 1]]", "a 4x4 matrix"),
    ],
)
def test_poses_are_no_points(tmp_path: Path, data: bytes, what: str) -> None:
    assert poses_in(data) == what
    for suffix in ("txt", "csv", "xyz"):
        (path := tmp_path / f"poses.{suffix}").write_bytes(data)
        for to_align in (True, False):
            with pytest.raises(InputError, match=f"is {what}, not points; name the scan here"):
                read_scan(path, to_align=to_align)


def test_points_are_no_poses() -> None:
    points, normals = bumpy_points(), unit_normals()
    rising = np.sort(points[:, 0])
    ones = np.ones(80)
    for data in (
        rows(points),
        rows(points, ones),
        rows(points, ones, normals),
        rows(rising, points[:, 1:], ones, normals, 0 * ones),  # curvature 0 everywhere
        rows(rising, points[:, 1:], ones, normals, 0.03 * ones),  # a small curvature
        b"x,y,z,qw,qx,qy,qz\n1,2,3,1,0,0,0\n",  # points with an orientation each
        rows(points, normals, ones, ones, ones, 0 * ones, 0 * ones, 0 * ones),
        rows(points, np.tile(np.arange(9.0), (80, 1))),
        rows(points[:4], ones[:4]),
        rows(points, *[ones] * 13),
        b"# x y z\n" + rows(points),
        b"",
        b"words only\n",
    ):
        assert poses_in(data) is None
