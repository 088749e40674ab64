"""PLY files of our own, and the colours in them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points
from utopic_cli.io.colour import COLOUR_MAPS, colour_map
from utopic_cli.io.ply_writer import merged_cloud_ply, property_name, scalar_cloud_ply
from utopic_cli.io.scan import read_scan

FIELDS = ("overlap", "uncertainty", "intensity", "original_red")
OURS = [*(f"scalar_{name}" for name in FIELDS), "quality"]


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """A coloured cloud at coordinates that need double precision, and what it should hold."""
    points = bumpy_points() + [4e5, 5e6, 0.1]
    overlap = np.linspace(0, 1, 80, dtype=np.float32)
    values = (overlap, 1 - overlap, 1e6 + np.arange(80) / 7.0, np.arange(80, dtype=np.uint8))
    scalars = dict(zip(FIELDS, values, strict=True))
    colours = colour_map(overlap)
    path = tmp_path / "cloud.ply"
    path.write_bytes(scalar_cloud_ply(points, colours, scalars, ["made here"], shown="overlap"))
    expected = {f"scalar_{name}": values for name, values in scalars.items()} | {"quality": overlap}
    return path, points, colours, expected


def test_our_own_reader_reads_it(written) -> None:
    path, points, _, _ = written
    np.testing.assert_array_equal(read_scan(path).cloud.points, points)
    assert b"\ncomment made here\n" in path.read_bytes()


def test_open3d_reads_every_field(written) -> None:
    import open3d

    path, points, colours, expected = written
    cloud = open3d.t.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(cloud.point.positions.numpy(), points)
    np.testing.assert_array_equal(cloud.point.colors.numpy(), colours)
    for name, values in expected.items():
        np.testing.assert_array_equal(cloud.point[name].numpy()[:, 0], values)


def test_trimesh_reads_every_field(written) -> None:
    import trimesh

    path, points, colours, expected = written
    cloud = trimesh.load(path)
    np.testing.assert_array_equal(cloud.vertices, points)
    np.testing.assert_array_equal(cloud.colors[:, :3], colours)
    fields = cloud.metadata["_ply_raw"]["vertex"]["data"]
    for name, values in expected.items():
        np.testing.assert_array_equal(fields[name].ravel(), values)


def test_meshio_reads_every_field(written) -> None:
    import meshio

    path, points, colours, expected = written
    cloud = meshio.read(path)
    np.testing.assert_array_equal(cloud.points, points)
    for channel, name in enumerate(("red", "green", "blue")):
        # meshio takes uchar for signed bytes.
        np.testing.assert_array_equal(cloud.point_data[name].view(np.uint8), colours[:, channel])
    for name, values in expected.items():
        np.testing.assert_array_equal(cloud.point_data[name].view(values.dtype), values)


def test_names_are_those_that_viewers_look_for(written) -> None:
    """CloudCompare loads and shows the first scalar_*; MeshLab paints by a property called intensity."""
    header = written[0].read_bytes().split(b"end_header")[0].decode("ascii").splitlines()
    names = [line.split()[-1] for line in header if line.startswith("property")]
    assert names == ["x", "y", "z", "red", "green", "blue", *OURS]


@pytest.mark.parametrize(
    ("field", "name"), [("bunny", "scalar_bunn_y"), ("Nx", "scalar_N_x"), ("2", "scalar_2")]
)
def test_no_scalar_is_taken_for_a_normal(field: str, name: str) -> None:
    assert property_name(field) == name


def test_merged_cloud_says_which_scan() -> None:
    import trimesh

    points = bumpy_points()
    data = merged_cloud_ply(points[:30], points[30:])
    vertices = trimesh.load(io.BytesIO(data), file_type="ply").metadata["_ply_raw"]["vertex"]["data"]
    assert vertices["scalar_scan"].ravel().tolist() == [0.0] * 30 + [1.0] * 50
    np.testing.assert_array_equal(vertices["z"].ravel(), points[:, 2])


@pytest.mark.parametrize(
    ("scalars", "comments"),
    [
        ({"a b": np.zeros(80)}, []),
        ({"a": np.zeros(79)}, []),
        ({"a": np.zeros(80, np.int64)}, []),
        ({}, ["two\nelement lines"]),
    ],
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


def luminance(colours: np.ndarray) -> np.ndarray:
    """Of (N, 3) sRGB bytes, 0 to 1."""
    share = colours / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_more_is_lighter_all_the_way_in_the_map_for_every_eye() -> None:
    light = luminance(colour_map(np.linspace(0, 1, 101), "purple-yellow").astype(float))
    assert (np.diff(light) > 0).all()
    assert light[0] < 0.03 and light[-1] > 0.8


# What people without red, green or blue cones see (Machado et al. 2009), on linear RGB.
BLIND = {
    "red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}


@pytest.mark.parametrize("missing", BLIND)
@pytest.mark.parametrize("name", COLOUR_MAPS)
def test_the_colour_blind_tell_values_apart_that_differ_by_a_fifth(name: str, missing: str) -> None:
    colours = colour_map(np.linspace(0, 1, 21), name) / 255.0
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(BLIND[missing]).T, 0, 1)
    xyz = seen @ np.array([[0.4124, 0.2126, 0.0193], [0.3576, 0.7152, 0.1192], [0.1805, 0.0722, 0.9505]])
    f = np.cbrt(xyz / [0.9505, 1.0, 1.089])  # CIE L*a*b*, but for the foot of the curve
    lab = np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    places = np.arange(21)
    assert apart[np.abs(places[:, None] - places[None]) >= 4].min() > 10  # 2.3 is just noticeable
