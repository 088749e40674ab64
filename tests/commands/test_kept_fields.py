"""What scans say of their points reaches the coloured clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points, ply, xyz_columns
from utopic_cli.commands.kept_fields import kept_fields
from utopic_cli.errors import InputError
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.io.scan import read_scan

COUNT = 80


def ply_scan(path: Path, columns: dict, encoding: str = "binary_little_endian") -> Path:
    points = bumpy_points(COUNT)
    places = {name: ("f4", points[:, axis]) for axis, name in enumerate("xyz")}
    path.write_bytes(ply({**places, **columns}, encoding))
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_colours_and_scalars_of_a_ply(tmp_path: Path, encoding: str) -> None:
    number = np.arange(COUNT)
    columns = {
        "red": ("u1", number),
        "green": ("u1", number + 1),
        "blue": ("u1", number + 2),
        "nx": ("f4", np.ones(COUNT)),
        "ny": ("f4", np.zeros(COUNT)),
        "nz": ("f4", np.zeros(COUNT)),
        "scalar_Intensity": ("f4", number / 2),
        "time": ("f8", 1.6e9 + number / 4),
        "overlap": ("f4", number / 8),
    }
    kept, _ = kept_fields(read_scan(ply_scan(tmp_path / "a.ply", columns, encoding)))
    assert list(kept) == [
        "original_red", "original_green", "original_blue", "intensity", "time", "original_overlap"
    ]  # fmt: skip
    assert kept["original_green"].dtype == np.uint8
    np.testing.assert_array_equal(kept["original_green"], number + 1)
    np.testing.assert_array_equal(kept["intensity"], number / 2)
    np.testing.assert_array_equal(kept["original_overlap"], number / 8)
    assert kept["time"].dtype == np.float64
    np.testing.assert_array_equal(kept["time"], 1.6e9 + number / 4)


def test_points_that_are_left_out_take_their_fields_along(tmp_path: Path) -> None:
    points = bumpy_points(COUNT)
    points[7] = np.nan
    rows = [f"{x} {y} {z} {i}" for i, (x, y, z) in enumerate(points)]
    (tmp_path / "a.xyz").write_text("\n".join(["# x y z intensity", *rows]))
    kept, _ = kept_fields(read_scan(tmp_path / "a.xyz"))
    np.testing.assert_array_equal(kept["intensity"], np.delete(np.arange(COUNT), 7))


def test_a_mesh_has_none(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "a.stl").write_bytes(trimesh.creation.icosphere(subdivisions=2).export(file_type="stl"))
    assert kept_fields(read_scan(tmp_path / "a.stl")) == ({}, None)


@pytest.mark.parametrize(("lists", "more"), [(True, True), (True, False), (False, False)])
def test_a_ply_whose_vertices_hold_lists_says_what_is_lost(tmp_path: Path, lists: bool, more: bool) -> None:
    columns = xyz_columns(bumpy_points(COUNT)) | ({"time": ("f8", np.arange(COUNT))} if more else {})
    (tmp_path / "a.ply").write_bytes(ply(columns, lists=[[1]] * COUNT if lists else None))
    kept, lost = kept_fields(read_scan(tmp_path / "a.ply"))
    assert kept == {} and (lost is None or "its PLY vertices hold lists" in lost)
    assert bool(lost) == lists  # bare points have nothing to lose


def test_a_file_that_changed_meanwhile_is_refused(tmp_path: Path) -> None:
    scan = read_scan(ply_scan(tmp_path / "a.ply", {"intensity": ("f4", np.zeros(COUNT))}))
    ply_scan(tmp_path / "a.ply", {"intensity": ("f4", np.ones(COUNT))})
    with pytest.raises(InputError, match="changed"):
        kept_fields(scan)


def test_intensity_colours_and_time_of_las(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    cloud = laspy.create(point_format=3, file_version="1.2")
    cloud.header.scales = [1e-6] * 3
    cloud.x, cloud.y, cloud.z = bumpy_points(COUNT).T
    number = np.arange(COUNT)
    cloud.intensity, cloud.gps_time = 7 * number, 1e8 + number / 3
    cloud.red, cloud.green, cloud.blue = 256 * number, 0 * number, np.full(COUNT, 65535)
    cloud.write(tmp_path / "a.las")
    kept, _ = kept_fields(read_scan(tmp_path / "a.las"))
    np.testing.assert_array_equal(kept["intensity"], 7 * number)
    np.testing.assert_array_equal(kept["gps_time"], 1e8 + number / 3)
    np.testing.assert_allclose(kept["original_red"], number, atol=1)
    np.testing.assert_array_equal(kept["original_blue"], 255)


def test_intensity_and_colours_of_e57(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    number = np.arange(float(COUNT))
    points = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), bumpy_points(COUNT).T.copy(), strict=True))
    told = {"intensity": number / 8, "colorRed": number, "colorGreen": number + 1, "colorBlue": number + 150}
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    file.write_scan_raw({**points, **told})
    file.close()
    kept, _ = kept_fields(read_scan(tmp_path / "a.e57"))
    np.testing.assert_array_equal(kept["intensity"], number / 8)
    np.testing.assert_array_equal(kept["original_red"], number)
    np.testing.assert_array_equal(kept["original_blue"], number + 150)


def test_a_constant_field_of_e57_and_one_that_cannot_be_read(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    from tests.io.test_e57 import constant
    from utopic_cli.io.e57_file import open_e57

    path = constant(tmp_path, bumpy_points(COUNT))
    np.testing.assert_array_equal(kept_fields(read_scan(path))[0]["intensity"], np.full(COUNT, 7.0))
    file = open_e57(path.read_bytes())
    place = file.xml.index(b"<intensity")
    path.write_bytes(file.with_xml(file.xml[:place] + file.xml[place:].replace(b"Integer", b"Strange", 1)))
    kept, lost = kept_fields(read_scan(path))
    assert kept == {} and "are not in the coloured clouds: " in str(lost)


def test_names_that_become_one_property_are_told_apart(tmp_path: Path) -> None:
    columns = {name: ("f4", np.full(COUNT, i)) for i, name in enumerate(("inx", "in_x", "original_in_x"))}
    kept, _ = kept_fields(read_scan(ply_scan(tmp_path / "a.ply", columns)))
    assert sorted(values[0] for values in kept.values()) == [0, 1, 2]
    scalar_cloud_ply(bumpy_points(COUNT), np.zeros((COUNT, 3), np.uint8), kept)
    with pytest.raises(ValueError, match="inx, in_x two become one"):
        twice = dict.fromkeys(("inx", "in_x"), np.zeros(COUNT))
        scalar_cloud_ply(bumpy_points(COUNT), np.zeros((COUNT, 3), np.uint8), twice)


def test_colours_packed_into_one_number_of_a_pcd(tmp_path: Path) -> None:
    red, green, blue = np.arange(COUNT), np.full(COUNT, 3), np.full(COUNT, 200)
    packed = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
    table = np.empty(COUNT, [(name, "<f4") for name in ("x", "y", "z", "rgb")])
    for axis, name in enumerate("xyz"):
        table[name] = bumpy_points(COUNT)[:, axis]
    table["rgb"] = packed
    header = f"VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {COUNT}\n"
    header += f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(header.encode() + table.tobytes())
    kept, _ = kept_fields(read_scan(tmp_path / "a.pcd"))
    assert list(kept) == ["original_red", "original_green", "original_blue"]
    np.testing.assert_array_equal(kept["original_red"], red)
    np.testing.assert_array_equal(kept["original_blue"], blue)
