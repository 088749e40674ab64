"""PCD: every encoding and size, padding, organised clouds, viewpoints, LZF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.io import lzf_reference
from tests.io.samples import bumpy_points, motion, moved, pcd, unit_normals
from utopic_cli.io import lzf
from utopic_cli.io.pcd import read_pcd
from utopic_cli.io.records import FormatError

ENCODINGS = ("ascii", "binary", "binary_compressed")


def xyz_fields(points: np.ndarray, code: str = "f4") -> list[tuple[str, str, np.ndarray]]:
    return [(name, code, points[:, axis]) for axis, name in enumerate("xyz")]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("code", ["f4", "f8", "i2", "i4", "u1", "i8"])
def test_reads_every_size(encoding: str, code: str) -> None:
    points = bumpy_points()
    if code[0] != "f":
        points = np.rint((points + 1.5) * 40)
    np.testing.assert_array_equal(read_pcd(pcd(xyz_fields(points, code), encoding)).points, points)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_moves_points_and_keeps_the_rest(encoding: str) -> None:
    points, normals, T = bumpy_points(), unit_normals(), motion()
    points[5] = np.nan
    rng = np.random.default_rng(3)
    fields = [
        ("rgb", "u4", rng.integers(0, 1 << 24, 80)),
        *xyz_fields(points),
        ("_", "u1", rng.integers(0, 255, (80, 4))),
        *[(f"normal_{n}", "f4", normals[:, i]) for i, n in enumerate("xyz")],
        ("histogram", "f4", rng.integers(0, 9, (80, 5))),
    ]
    data = pcd(fields, encoding, width=20)
    records = read_pcd(data)
    np.testing.assert_array_equal(records.points, points)
    np.testing.assert_array_equal(records.normals, normals)
    again = records.moved(T)
    back = read_pcd(again)
    np.testing.assert_allclose(np.delete(back.points, 5, 0), moved(np.delete(points, 5, 0), T), atol=1e-6)
    assert np.isnan(back.points[5]).all()
    np.testing.assert_allclose(back.normals, normals @ T[:3, :3].T, atol=1e-6)
    assert b"WIDTH 20\nHEIGHT 4\n" in again and f"DATA {encoding}\n".encode() in again
    # Moving back with the viewpoint's line aside gives the old attributes, byte for byte.
    other = [f for f in fields if f[0] in ("rgb", "_", "histogram")]
    for name, _, values in other:
        assert _field(again, name).tolist() == np.reshape(values, (80, -1)).tolist()


def _field(data: bytes, name: str) -> np.ndarray:
    """Read one field by the format's description, apart from the reader under test."""
    head, body = data.split(b"DATA ", 1)
    encoding, body = body.split(b"\n", 1)
    lines = {line.split()[0]: line.split()[1:] for line in head.decode().splitlines() if line[0] != "#"}
    names, counts = lines["FIELDS"], list(map(int, lines["COUNT"]))
    codes = [f"<{t.lower()}{s}" for t, s in zip(lines["TYPE"], lines["SIZE"])]
    place, points = names.index(name), int(lines["POINTS"][0])
    if encoding == b"ascii":
        table = np.array([list(map(float, row.split())) for row in body.splitlines()])
        return table[:, sum(counts[:place]) : sum(counts[: place + 1])]
    if encoding == b"binary":
        unique = [(f"f{i}", code, (count,)) for i, (code, count) in enumerate(zip(codes, counts))]
        return np.frombuffer(body, np.dtype(unique))[f"f{place}"]
    block = bytes(lzf.decompress(body[8:], int(np.frombuffer(body, "<u4", 2)[1])))
    sizes = [np.dtype(code).itemsize * count * points for code, count in zip(codes, counts)]
    start = sum(sizes[:place])
    return np.frombuffer(block[start : start + sizes[place]], codes[place]).reshape(points, -1)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_moved_file_agrees_with_open3d(tmp_path: Path, encoding: str) -> None:
    import open3d

    points, T = bumpy_points(), motion()
    path = tmp_path / "moved.pcd"
    path.write_bytes(read_pcd(pcd(xyz_fields(points), encoding)).moved(T))
    cloud = open3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(cloud.points), moved(points, T), atol=1e-6)


@pytest.mark.parametrize("compressed", [False, True])
def test_reads_what_open3d_writes(tmp_path: Path, compressed: bool) -> None:
    import open3d

    points = np.repeat(bumpy_points(), 3, axis=0)  # repeats, so that there is something to refer to
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    path = tmp_path / "cloud.pcd"
    open3d.io.write_point_cloud(str(path), cloud, compressed=compressed)
    np.testing.assert_allclose(read_pcd(path.read_bytes()).points, points, atol=1e-6)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_widens_rather_than_lose_detail(encoding: str) -> None:
    points, T = bumpy_points(), motion(translation=(4e5, 5e6, 100.0))
    again = read_pcd(pcd([*xyz_fields(points), ("t", "u2", np.arange(80))], encoding)).moved(T)
    np.testing.assert_allclose(read_pcd(again).points, moved(points, T), rtol=0, atol=1e-8)
    assert b"SIZE 8 8 8 2" in again
    assert _field(again, "t")[:, 0].tolist() == list(range(80))


def test_viewpoint_moves_with_the_points() -> None:
    from scipy.spatial.transform import Rotation

    T = motion()
    again = read_pcd(pcd(xyz_fields(bumpy_points()), viewpoint="1 2 3 0 1 0 0")).moved(T)
    line = next(line for line in again.split(b"\n") if line.startswith(b"VIEWPOINT"))
    x, y, z, qw, qx, qy, qz = map(float, line.split()[1:])
    np.testing.assert_allclose([x, y, z], T[:3, :3] @ [1, 2, 3] + T[:3, 3])
    expected = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), expected, atol=1e-12)


def test_old_headers_without_count_or_points() -> None:
    data = pcd(xyz_fields(bumpy_points()), "binary")
    data = data.replace(b"COUNT 1 1 1\n", b"").replace(b"POINTS 80\n", b"").replace(b"0.7", b".7")
    assert len(read_pcd(data).points) == 80


@pytest.mark.parametrize("size", [0, 1, 31, 32, 33, 64, 1000])
def test_lzf_round_trips(size: int) -> None:
    data = bytes(np.random.default_rng(size).integers(0, 3, size).astype(np.uint8))
    assert lzf.decompress(lzf.store(data), size) == data
    assert lzf.decompress(lzf_reference.compress(data), size) == data


def test_lzf_output_is_bounded() -> None:
    bomb = b"\x00a" + b"\xe0\xff\x00" * 10_000  # 264 times the last byte, again and again
    with pytest.raises(FormatError, match="promised 100 bytes"):
        lzf.decompress(bomb, 100)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"POINTS 80", b"POINTS 81", "POINTS 81 but WIDTH x HEIGHT 80"),
        (b"SIZE 4 4 4", b"SIZE 4 4", "3 FIELDS, 2 SIZE"),
        (b"SIZE 4 4 4", b"SIZE 4 4 3", "TYPE F with SIZE 3"),
        (b"FIELDS x y z", b"FIELDS x y y", "field twice"),
        (b"FIELDS x y z", b"FIELDS x y w", "no x, y and z"),
        (b"DATA binary", b"DATA zipped", "DATA zipped"),
        (b"COUNT 1 1 1", b"COUNT 1 1 -1", "COUNT that is no whole number"),
    ],
)
def test_unsound_headers_are_named(old: bytes, new: bytes, reason: str) -> None:
    with pytest.raises(FormatError, match=reason):
        read_pcd(pcd(xyz_fields(bumpy_points())).replace(old, new))
