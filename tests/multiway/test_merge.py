from __future__ import annotations

import numpy as np
import pytest

from tests.multiway.stubs import random_motion, write_scans
from utopic_cli.errors import InputError, OutputError
from utopic_cli.geometry.rigid import apply
from utopic_cli.io import lzf
from utopic_cli.io.ply_header import parse_header
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway.merge import fields_lost, write_merged
from utopic_cli.multiway.scans import find_scans


def read(path):
    data = path.read_bytes()
    header = parse_header(data)
    vertex = header.elements[0]
    table = np.frombuffer(data[header.size :], [(p.name, p.dtype) for p in vertex.properties])
    assert vertex.count == len(table)
    return table


def colours_in(table):
    return np.stack([table[name] for name in ("red", "green", "blue")], axis=1)


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
    assert (table["scalar_scan"] == np.repeat([0.0, 1.0], 200)).all()
    for number, rows in ((0, slice(0, 200)), (1, slice(200, 400))):
        points = apply(group[number], read_scan(files[number].path).cloud.points)
        assert (np.stack([table[name][rows] for name in "xyz"], axis=1) == points).all()
        assert (colours_in(table)[rows] == 10 * number).all()
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
    assert {tuple(p) for p in points[table["scalar_scan"] == 0]} <= {tuple(p) for p in everything}


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


POINTS = np.random.default_rng(0).standard_normal((60, 3)).round(4)
TEXTS = [" ".join(map(str, point)) for point in POINTS.tolist()]
XYZ = [f"float {name}" for name in "xyz"]
RGB = np.arange(180, dtype=np.uint8).reshape(60, 3)
PACKED = RGB.astype(int) @ [[65536], [256], [1]]


def ascii_ply(properties, rows):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    return "\n".join([*lines, *(f"property {p}" for p in properties), "end_header", *rows]) + "\n"


def pcd(fields, sizes, kinds, encoding, body):
    lines = ["VERSION .7", f"FIELDS {fields}", f"SIZE {sizes}", f"TYPE {kinds}", f"WIDTH {len(POINTS)}"]
    return "\n".join([*lines, "HEIGHT 1", f"DATA {encoding}\n"]).encode("ascii") + body


def merged(folder, **contents):
    """Merge files that lie as they should already, in the order given, named by their suffix."""
    folder.mkdir()
    paths = []
    for i, (kind, content) in enumerate(contents.items()):
        paths.append(folder / f"{i}.{kind.rstrip('_')}")
        paths[-1].write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    if len(paths) == 1:  # a batch has two at least
        paths.append(folder / "other.xyz")
        paths[-1].write_text("\n".join(TEXTS) + "\n")
    files = dict(enumerate(find_scans(paths).scans))
    write_merged(folder / "m.out", dict.fromkeys(files, np.eye(4)), files, seed=0)
    return read(folder / "m.out")


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [("uchar", 7, 7), ("ushort", 65535, 255), ("float", 0.5, 128), ("int", 200, 200)],
)
def test_colours_in_any_range(tmp_path, kind, value, expected):
    properties = [f"{kind} {name}" for name in ("red", "green", "blue")]
    table = merged(tmp_path / "s", ply=ascii_ply([*XYZ, *properties], [f"{p} {value} 0 0" for p in TEXTS]))
    assert (colours_in(table)[:60] == [expected, 0, 0]).all()
    assert (colours_in(table)[60:] == 190).all()  # the scan without any is grey


def rows_with(values):
    return [f"{p} {' '.join(map(str, v))}" for p, v in zip(TEXTS, values.tolist(), strict=True)]


def packed_pcd(encoding):
    table = np.zeros(60, [("xyz", "<f4", 3), ("i", "<f4"), ("rgb", "<u4")])
    table["xyz"], table["i"] = POINTS, np.arange(60)
    # Opaque colours are NaN as a float: the bits have to come through.
    table["rgb"] = (255 << 24) | RGB[:, 0].astype("u4") << 16 | RGB[:, 1].astype("u4") << 8 | RGB[:, 2]
    if encoding == "binary":
        return pcd("x y z intensity rgb", "4 4 4 4 4", "F F F F F", encoding, table.tobytes())
    columns = [*table["xyz"].T, table["i"], table["rgb"]]
    block = b"".join(np.ascontiguousarray(column).tobytes() for column in columns)
    stream = lzf.store(block)
    body = np.array([len(stream), len(block)], "<u4").tobytes() + stream
    return pcd("x y z intensity rgb", "4 4 4 4 4", "F F F F F", encoding, body)


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("pcd", packed_pcd("binary")),
        ("pcd", packed_pcd("binary_compressed")),
        ("pcd", pcd("x y z rgb", "4 4 4 4", "F F F U", "ascii", "\n".join(rows_with(PACKED)).encode())),
        ("obj", "\n".join(f"v {row}" for row in rows_with(RGB / 255))),
        ("xyz", "\n".join(rows_with(RGB))),
        ("pts", "60\n" + "\n".join(rows_with(np.column_stack([-np.arange(60), RGB])))),
        ("txt", "//X Y Z R G B Intensity\n" + "\n".join(rows_with(np.column_stack([RGB, np.arange(60)])))),
        ("csv", "x,y,z,red,green,blue\n" + "\n".join(row.replace(" ", ",") for row in rows_with(RGB))),
    ],
)  # fmt: skip
def test_colours_of_every_format(tmp_path, kind, content):
    assert (colours_in(merged(tmp_path / "s", **{kind: content}))[:60] == RGB).all()


def test_scans_without_colours_are_told_apart(tmp_path):
    colours = colours_in(merged(tmp_path / "s", xyz="\n".join(TEXTS), xyz_="\n".join(TEXTS[::-1])))
    assert len(np.unique(colours[:60], axis=0)) == len(np.unique(colours[60:], axis=0)) == 1
    assert (colours[0] != colours[60]).any()


def test_fields_that_most_scans_have_are_kept(tmp_path):
    numbers = np.arange(60)
    names = ["float scalar_Intensity", "double gps time", "uchar label"]
    ply = ascii_ply(
        [*XYZ, *(name.replace(" time", "_time") for name in names)],
        rows_with(np.column_stack([numbers, 1e9 + numbers / 7, numbers % 3])),
    )
    text = "x y z intensity gps_time\n" + "\n".join(rows_with(np.column_stack([-numbers, numbers])))
    table = merged(tmp_path / "s", ply=ply, pcd=packed_pcd("binary"), xyz=text)
    # As viewers look for them; MeshLab would paint the points by a property called intensity.
    own = ("x", "y", "z", "red", "green", "blue", "scalar_scan")
    assert table.dtype.names == (*own, "scalar_intensity", "scalar_gps_time")
    assert (table["scalar_intensity"] == [*numbers, *numbers, *-numbers]).all()  # in all of them
    assert (table["scalar_gps_time"][:60] == 1e9 + numbers / 7).all()  # as exact as it was
    assert np.isnan(table["scalar_gps_time"][60:120]).all()
    assert (table["scalar_gps_time"][120:] == numbers).all()
    assert (colours_in(table)[60:120] == RGB).all()


def test_a_field_that_is_not_all_numbers_is_left_blank_and_our_own_names_stay_ours(tmp_path):
    rows = rows_with(np.column_stack([np.arange(60), np.ones((60, 2))]))
    header = "x,y,z,scan,of row,red\n"
    late = [row.replace(" ", ",") for row in rows * 10]
    late[-1] = late[-1].rsplit(",", 2)[0] + ",none,1"
    table = merged(tmp_path / "s", csv=header + "\n".join(late), csv_=header + "\n".join(late[:60]))
    assert table.dtype.names[6:] == ("scalar_scan", "scalar_scan_", "scalar_of_row")
    assert (table["scalar_scan"] == np.repeat([0, 1], [600, 60])).all()
    assert (table["scalar_scan_"][:60] == np.arange(60)).all()
    assert np.isnan(table["scalar_of_row"][:600]).all() and (table["scalar_of_row"][600:] == 1).all()


def test_values_stay_with_their_points_where_some_are_not_finite(tmp_path):
    rows = rows_with(np.column_stack([np.arange(60), np.zeros((60, 2)), np.arange(60)]))
    rows[0], rows[30] = "nan 0 0 0 0 0 0", "0 nan 0 30 0 0 30"
    properties = [*XYZ, *(f"uchar {name}" for name in ("red", "green", "blue")), "float intensity"]
    ply = ascii_ply(properties, rows)
    table = merged(tmp_path / "s", ply=ply, ply_=ply + "\n")
    expected = [i for i in range(60) if i not in (0, 30)] * 2
    assert table["red"].tolist() == expected == table["scalar_intensity"].tolist()


def test_colours_and_intensities_of_e57(tmp_path):
    pye57 = pytest.importorskip("pye57")
    told = {"intensity": np.arange(60) / 8, **dict(zip(("colorRed", "colorGreen", "colorBlue"), RGB.T * 1.0))}
    (tmp_path / "e57").mkdir()
    for name, told_here in (("a", told), ("b", told), ("c", {})):
        file = pye57.E57(str(tmp_path / "e57" / f"{name}.e57"), mode="w")
        for half in (slice(0, 30), slice(30, 60)):  # two scans in a file
            points = POINTS[half] + ord(name)
            columns = {f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")}
            file.write_scan_raw(columns | {name: values[half].copy() for name, values in told_here.items()})
        file.close()
    files = dict(enumerate(find_scans([tmp_path / "e57"]).scans))
    write_merged(tmp_path / "m.ply", dict.fromkeys(files, np.eye(4)), files, seed=0)
    table = read(tmp_path / "m.ply")
    assert (colours_in(table) == [*RGB, *RGB, *np.full((60, 3), 190)]).all()
    np.testing.assert_array_equal(table["scalar_intensity"][:120], np.tile(np.arange(60) / 8, 2))
    assert np.isnan(table["scalar_intensity"][120:]).all()


def test_names_that_become_one_property_are_told_apart(tmp_path):
    text = "x y z inx in_x\n" + "\n".join(rows_with(np.column_stack([np.arange(60), -np.arange(60)])))
    table = merged(tmp_path / "s", xyz=text, xyz_=text + "\n")
    assert table.dtype.names[7:] == ("scalar_in_x", "scalar_in_x_")
    assert (table["scalar_in_x"] + table["scalar_in_x_"] == 0).all()


def test_files_whose_fields_can_not_be_kept_are_named(tmp_path):
    files, _ = make(tmp_path)
    assert fields_lost(files.values()) == ()
    data = files[1].path.read_bytes().replace(b"uchar blue", b"list uchar uchar blue", 1)
    files[1].path.write_bytes(data)
    (said,) = fields_lost(files.values())
    assert said.startswith(f"{files[1].path}: ") and said.endswith(
        "merged cloud: its PLY vertices hold lists"
    )
