from __future__ import annotations

import numpy as np
import pytest

from tests.multiway.stubs import random_motion, write_scans
from utopic_cli.errors import InputError, OutputError
from utopic_cli.geometry.rigid import apply
from utopic_cli.io.ply_header import parse_header
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway.colours import read_colours
from utopic_cli.multiway.merge import LAYOUT, write_merged
from utopic_cli.multiway.scans import find_scans


def read(path):
    data = path.read_bytes()
    header = parse_header(data)
    table = np.frombuffer(data[header.size :], LAYOUT)
    assert header.elements[0].count == len(table)
    return table


def make(tmp_path, names=("a.ply", "b [1].ply")):
    write_scans(tmp_path / "scans", names)
    files = dict(enumerate(find_scans([tmp_path / "scans"]).scans))
    rng = np.random.default_rng(3)
    return files, {number: random_motion(rng) for number in files}


def test_every_point_of_every_scan_is_there_with_its_colour(tmp_path):
    files, group = make(tmp_path)
    count = write_merged(tmp_path / "m.ply", group, files, seed=0)
    table = read(tmp_path / "m.ply")
    assert count == len(table) == 400
    assert (table["scan"] == np.repeat([0.0, 1.0], 200)).all()
    for number, rows in ((0, slice(0, 200)), (1, slice(200, 400))):
        points = apply(group[number], read_scan(files[number].path).cloud.points)
        assert (np.stack([table[name][rows] for name in "xyz"], axis=1) == points).all()
        assert (table["rgb"][rows] == 10 * number).all()
    assert len(read_scan(tmp_path / "m.ply").cloud) == 400


def test_cells_keep_one_point_each_across_scans(tmp_path):
    files, group = make(tmp_path)
    group = {0: group[0], 1: group[1]}
    count = write_merged(tmp_path / "m.ply", group, files, seed=0, voxel=0.7)
    table = read(tmp_path / "m.ply")
    assert 20 < count == len(table) < 300
    points = np.stack([table[name] for name in "xyz"], axis=1)
    everything = apply(group[0], read_scan(files[0].path).cloud.points)
    cells = np.floor((points - everything.mean(axis=0)) / 0.7)
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert {tuple(p) for p in points[table["scan"] == 0]} <= {tuple(p) for p in everything}


def test_cells_without_number_are_refused_and_nothing_is_left(tmp_path):
    files, group = make(tmp_path)
    with pytest.raises(InputError, match="too small for a model of this size"):
        write_merged(tmp_path / "m.ply", group, files, seed=0, voxel=1e-9)
    (tmp_path / "m.ply").write_text("there")
    with pytest.raises(OutputError, match="exists already"):
        write_merged(tmp_path / "m.ply", group, files, seed=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.ply", "scans"]
    files[1].path.write_bytes(files[0].path.read_bytes())
    with pytest.raises(InputError, match="has changed"):
        write_merged(tmp_path / "m.ply", group, files, seed=0, overwrite=True)
    assert (tmp_path / "m.ply").read_text() == "there"


def ascii_ply(properties, rows):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    return "\n".join([*lines, *(f"property {p}" for p in properties), "end_header", *rows]) + "\n"


def test_colours_of_text_shorts_floats_and_none(tmp_path):
    rng = np.random.default_rng(0)
    points = [" ".join(map(str, p)) for p in rng.standard_normal((60, 3)).round(4)]
    xyz = [f"float {name}" for name in "xyz"]
    for kind, value, expected in (("uchar", "7", 7), ("ushort", "65535", 255), ("float", "0.5", 128)):
        path = tmp_path / f"{kind}.ply"
        properties = [f"{kind} {name}" for name in ("red", "green", "blue")]
        path.write_text(ascii_ply([*xyz, *properties], [f"{p} {value} 0 0" for p in points]))
        colours = read_colours(read_scan(path))
        assert (colours == [expected, 0, 0]).all() and colours.dtype == np.uint8
    (tmp_path / "none.ply").write_text(ascii_ply(xyz, points))
    assert read_colours(read_scan(tmp_path / "none.ply")) is None
    (tmp_path / "points.xyz").write_text("\n".join(points))
    assert read_colours(read_scan(tmp_path / "points.xyz")) is None


def test_colours_stay_with_their_points_where_some_are_not_finite(tmp_path):
    rng = np.random.default_rng(0)
    rows = [f"{x:.3f} {y:.3f} {z:.3f} {i} 0 0" for i, (x, y, z) in enumerate(rng.standard_normal((60, 3)))]
    rows[0], rows[30] = "nan 0 0 0 0 0", "0 nan 0 30 0 0"
    names = [*(f"float {name}" for name in "xyz"), *(f"uchar {name}" for name in ("red", "green", "blue"))]
    (tmp_path / "a.ply").write_text(ascii_ply(names, rows))
    colours = read_colours(read_scan(tmp_path / "a.ply"))
    assert colours[:, 0].tolist() == [i for i in range(60) if i not in (0, 30)]
