"""PLY: every encoding and type, lists and extra elements, and files written again whole."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import PLY_TYPES, bumpy_points, motion, moved, ply, unit_normals, xyz_columns
from utopic_cli.io.ply import read_ply
from utopic_cli.io.records import FormatError

ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
TRIANGLES = [[("u1", "i4", [i, i + 1, i + 2])] for i in range(20)]
MIXED_FACES = [[("u1", "i4", list(range(i, i + 3 + i % 3)))] for i in range(20)]
GRID = [[("u1", "i4", [i] if i % 2 else [])] for i in range(30)]
FACE_LINES = ["property list uchar int vertex_indices"]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("code", PLY_TYPES)
def test_reads_coordinates_of_every_type(encoding: str, code: str) -> None:
    points = bumpy_points()
    if code[0] != "f":
        points = np.rint((points + 1.5) * 40)
    records = read_ply(ply({**xyz_columns(points, code), "red": ("u1", np.arange(80))}, encoding))
    np.testing.assert_array_equal(records.points, points)
    assert records.points.dtype == np.float64
    assert records.normals is None


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("extra", ["uniform", "mixed", "before", "vertex_list", "scalars_around"])
def test_reads_and_moves_around_other_elements(encoding: str, extra: str) -> None:
    points, T = bumpy_points(), motion()
    columns = xyz_columns(points)
    options: dict = {}
    if extra == "uniform":
        options["after"] = ("face", FACE_LINES, TRIANGLES)
    elif extra == "mixed":
        options["after"] = ("face", FACE_LINES, MIXED_FACES)
    elif extra == "before":
        options["before"] = ("range_grid", FACE_LINES, GRID)
    elif extra == "vertex_list":
        options["lists"] = [list(range(i % 4)) for i in range(80)]
    else:
        columns = {"time": ("f8", np.linspace(0, 1, 80)), **columns, "label": ("i2", np.arange(80) - 7)}
    data = ply(columns, encoding, **options)
    records = read_ply(data)
    np.testing.assert_array_equal(records.points, points)
    again = records.moved(T)
    np.testing.assert_allclose(read_ply(again).points, moved(points, T), atol=1e-6)
    # Nothing but the coordinates may have changed: put the old ones in, get the old file.
    back = read_ply(again)
    assert _without_coordinates(again, back) == _without_coordinates(data, records)


def _without_coordinates(data: bytes, records) -> bytes:
    from utopic_cli.io.ply import _BinaryPly

    if isinstance(records.document, _BinaryPly):
        block = bytearray(data[records.document.header.size :])
        for column in records.document.columns:
            column.write(block, np.zeros(column.count), np.ones(column.count, bool))
        return data[: records.document.header.size] + bytes(block)
    document = records.document
    rows = [line.split() for line in data[document.header.size :].split(b"\n")]
    first = sum(e.count for e in document.header.elements[: document.header.elements.index(document.vertex)])
    for row in rows[first : first + document.vertex.count]:
        start = 1 if document.vertex.properties[0].name == "time" else 0
        numbers = [start, start + 1, start + 2]
        if document.vertex.has_lists:
            numbers = [0, 1, 3 + int(row[2])]
        for i in numbers:
            row[i] = b"*"
    return b"\n".join(b" ".join(row) for row in rows)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("names", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")])
def test_normals_turn_and_do_not_shift(encoding: str, names: tuple[str, ...]) -> None:
    points, normals, T = bumpy_points(), unit_normals(), motion()
    columns = xyz_columns(points) | {n: ("f4", normals[:, i]) for i, n in enumerate(names)}
    records = read_ply(ply(columns, encoding))
    np.testing.assert_array_equal(records.normals, normals)
    again = read_ply(records.moved(T))
    np.testing.assert_allclose(again.normals, normals @ T[:3, :3].T, atol=1e-6)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_records_without_a_point_stay(encoding: str) -> None:
    points = bumpy_points()
    points[[3, 40], 1] = np.nan
    again = read_ply(read_ply(ply(xyz_columns(points), encoding)).moved(motion())).points
    assert np.isnan(again[[3, 40], 1]).all()
    np.testing.assert_array_equal(again[[3, 40]][:, [0, 2]], points[[3, 40]][:, [0, 2]])
    assert np.isfinite(np.delete(again, [3, 40], axis=0)).all()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_moved_file_agrees_with_other_readers(tmp_path: Path, encoding: str) -> None:
    import open3d
    import trimesh

    points, T = bumpy_points(), motion()
    data = ply(xyz_columns(points), encoding, after=("face", FACE_LINES, TRIANGLES))
    path = tmp_path / "moved.ply"
    path.write_bytes(read_ply(data).moved(T))
    np.testing.assert_allclose(
        np.asarray(open3d.io.read_point_cloud(str(path)).points), moved(points, T), atol=1e-6
    )
    mesh = trimesh.load(io.BytesIO(path.read_bytes()), file_type="ply", process=False)
    np.testing.assert_allclose(mesh.vertices, moved(points, T), atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, [[i, i + 1, i + 2] for i in range(20)])


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("extra", ["none", "vertex_list"])
@pytest.mark.parametrize("code", ["f4", "i2"])
def test_widens_rather_than_lose_detail(encoding: str, extra: str, code: str) -> None:
    points, T = bumpy_points(), motion(translation=(4e5, 5e6, 100.0))
    if code == "i2":
        points = np.rint(points * 1000)
    lists = [list(range(i % 3)) for i in range(80)] if extra == "vertex_list" else None
    columns = {**xyz_columns(points, code), "label": ("i2", np.arange(80))}
    again = read_ply(ply(columns, encoding, lists=lists)).moved(T)
    np.testing.assert_allclose(read_ply(again).points, moved(points, T), rtol=0, atol=1e-8)
    assert b"comment x y z widened to double" in again
    assert b"property double x" in again and b"property short label" in again


def test_keeps_float32_where_it_serves() -> None:
    points = bumpy_points()
    assert b"property float x" in read_ply(ply(xyz_columns(points))).moved(motion())
    far = (points + [4e5, 5e6, 0]).astype(np.float32).astype(np.float64)  # coarse already
    assert b"property float x" in read_ply(ply(xyz_columns(far))).moved(motion(0.0))


def test_ascii_keeps_digits_beyond_float32() -> None:
    points = bumpy_points() + [412345.0, 5012345.0, 100.0]
    again = read_ply(read_ply(ply(xyz_columns(points, "f8"), "ascii")).moved(motion(0.3)))
    np.testing.assert_allclose(again.points, moved(points, motion(0.3)), rtol=0, atol=1e-8)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_and_odd_lines(end: str) -> None:
    odd = ("comment hello  there", "obj_info num_cols 5", "tool_version 3")
    data = ply(xyz_columns(bumpy_points()), "ascii", extra_lines=odd, end=end)
    records = read_ply(data)
    assert len(records.points) == 80
    assert len(records.warnings) == 1 and "tool_version 3" in records.warnings[0]
    again = records.moved(motion())
    assert all(line.encode() + end.encode() in again for line in odd)
    assert again.count(end.encode()) == data.count(end.encode())


def test_odd_spellings_of_nan() -> None:
    data = ply(xyz_columns(bumpy_points()), "ascii")
    head, body = data.split(b"end_header\n")
    rows = body.split(b"\n")
    rows[0], rows[1] = b"-nan(ind) 0 1", b"0 1.#QNAN 1"
    records = read_ply(head + b"end_header\n" + b"\n".join(rows))
    assert np.isnan(records.points[[0, 1], [0, 1]]).all()


def test_list_counts_are_checked_before_allocation() -> None:
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n"
    head += (
        b"property list uint int ring\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    )
    with pytest.raises(FormatError, match="promises 4000000000 vertex records but there are at most 3"):
        read_ply(head + b"\0" * 84)


def test_one_giant_list_is_refused() -> None:
    data = ply(xyz_columns(bumpy_points()), after=("face", ["property list uint int v"], []))
    data = data.replace(b"element face 0", b"element face 1") + b"\xff\xff\xff\xff" + b"\0" * 40
    with pytest.raises(FormatError, match="promises 1 face"):
        read_ply(data)
