"""read_scan: one line for every file that can't be used, and never another exception."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points, motion, moved, mutated, pcd, ply, unit_normals, xyz_columns
from utopic_cli.errors import InputError
from utopic_cli.io.scan import read_scan


def xyz_pcd(points: np.ndarray, encoding: str = "binary") -> bytes:
    return pcd([(name, "f4", points[:, i]) for i, name in enumerate("xyz")], encoding)


def xyz_text(points: np.ndarray) -> bytes:
    return "\n".join(" ".join(map(repr, p)) for p in points.tolist()).encode()


def xyz_obj(points: np.ndarray) -> bytes:
    return b"".join(b"v " + line + b"\n" for line in xyz_text(points).split(b"\n"))


WRITERS = {
    "ascii.ply": lambda points: ply(xyz_columns(points), "ascii"),
    "little.ply": lambda points: ply(xyz_columns(points)),
    "big.PLY": lambda points: ply(xyz_columns(points), "binary_big_endian"),
    "ascii.pcd": lambda points: xyz_pcd(points, "ascii"),
    "binary.pcd": lambda points: xyz_pcd(points, "binary"),
    "compressed.pcd": lambda points: xyz_pcd(points, "binary_compressed"),
    "mesh.obj": xyz_obj,
    "cloud.xyz": xyz_text,
    "cloud.PTS": lambda points: f"{len(points)}\n".encode() + xyz_text(points),
    "cloud.csv": lambda points: xyz_text(points).replace(b" ", b","),
}
LINE = np.outer(np.linspace(0.1, 1, 80), [1.0, 2.0, -3.0])


def refused(path: Path) -> str:
    """Return the one line with which a file is refused."""
    with pytest.raises(InputError) as caught:
        read_scan(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and message.isprintable()
    assert ";" in message or "," in message  # the reason, then what to do
    return message


@pytest.mark.parametrize("name", WRITERS)
def test_reads_drops_and_moves(tmp_path: Path, name: str) -> None:
    points, T = bumpy_points(), motion()
    points[[7, 30]] = np.nan
    path = tmp_path / name
    path.write_bytes(WRITERS[name](points))
    scan = read_scan(path)
    kept = np.delete(np.arange(80), [7, 30])
    np.testing.assert_array_equal(scan.kept, kept)
    np.testing.assert_array_equal(scan.cloud.points, points[kept])
    assert scan.cloud.points.flags["C_CONTIGUOUS"]
    assert scan.records == 80 and scan.format == name.split(".")[1].lower()
    assert scan.warnings == ("2 of 80 points are NaN or infinite and were left out",)
    assert scan.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    path.write_bytes(scan.moved(T))
    again = read_scan(path)
    np.testing.assert_array_equal(again.kept, kept)
    np.testing.assert_allclose(again.cloud.points, moved(points[kept], T), atol=1e-6)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.full((80, 3), np.nan), "none of its 80 points is finite"),
        (np.tile([[1.0, 2.0, 3.0]], (80, 1)), "all of its 80 points are equal"),
        (np.repeat(bumpy_points(40), 2, axis=0), "has 40 distinct finite points; at least 50"),
        (bumpy_points(49), "has 49 distinct finite points"),
        (LINE, "lie on a line"),
        (LINE * 1000 + [0, 0, 5000.0], "lie on a line"),
    ],
    ids=["nan", "equal", "duplicates", "few", "line", "line_far"],
)
@pytest.mark.parametrize("name", ["little.ply", "cloud.xyz", "compressed.pcd", "mesh.obj"])
def test_points_that_fix_no_transformation(
    tmp_path: Path, name: str, points: np.ndarray, reason: str
) -> None:
    path = tmp_path / name
    path.write_bytes(WRITERS[name](points))
    assert reason in refused(path)


def test_a_plane_and_fifty_points_are_accepted(tmp_path: Path) -> None:
    points = bumpy_points(50)
    points[:, 2] = 0
    path = tmp_path / "plane.ply"
    path.write_bytes(ply(xyz_columns(points)))
    assert len(read_scan(path).cloud) == 50


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_truncated(tmp_path: Path, name: str, share: float) -> None:
    data = WRITERS[name](bumpy_points())
    promises_nothing = name.split(".")[1] in ("obj", "xyz", "csv")
    cut = data[: int(len(data) * share)]
    if promises_nothing:  # a cut row shows; whole rows fewer can't
        cut = cut.rsplit(b"\n", 1)[0] + b"\nv 1" if b"\n" in cut else b"v 1"
    path = tmp_path / name
    path.write_bytes(cut)
    refused(path)


@pytest.mark.parametrize(
    ("name", "old", "new", "reason"),
    [
        (
            "little.ply",
            b"vertex 80",
            b"vertex 300000000",
            "promises 300000000 vertex records but there are at",
        ),
        (
            "ascii.ply",
            b"vertex 80",
            b"vertex 300000000",
            "promises 300000000 vertex records but there are at",
        ),
        ("binary.pcd", b"80", b"300000000", "promises 300000000 points but there are 80"),
        ("ascii.pcd", b"80", b"300000000", "promises 300000000 points but there are 80"),
        ("compressed.pcd", b"80", b"300000000", "promises 3600000000 bytes"),
        ("cloud.PTS", b"80\n", b"300000000\n", "promises 300000000 points but there are 80"),
    ],
)
def test_giant_promises_are_refused_at_once(
    tmp_path: Path, name: str, old: bytes, new: bytes, reason: str
) -> None:
    path = tmp_path / name
    path.write_bytes(WRITERS[name](bumpy_points()).replace(old, new))
    start = time.perf_counter()
    assert reason in refused(path)
    assert time.perf_counter() - start < 0.5


@pytest.mark.parametrize("suffix", ["ply", "pcd", "obj", "xyz", "txt", "pts", "csv", "stl", "off", "glb"])
@pytest.mark.parametrize("kind", ["empty", "garbage", "words", "escape", "directory", "missing", "fifo"])
def test_what_is_no_scan(tmp_path: Path, suffix: str, kind: str) -> None:
    path = tmp_path / f"bad.{suffix}"
    contents = {
        "empty": b"",
        "garbage": np.random.default_rng(5).bytes(4000),
        "words": b"the quick brown fox\njumps over the lazy dog\n" * 50,
        "escape": b"ply\nformat \x1b[2J\xc2\x85 1.0\nend_header\n\x1b[31m \x85 x\n",
    }
    if kind in contents:
        path.write_bytes(contents[kind])
    elif kind == "directory":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    message = refused(path)
    expected = {
        "empty": "is empty",
        "directory": "is a directory",
        "missing": "no such file",
        "fifo": "a pipe",
    }
    assert expected.get(kind, "") in message


def test_wrong_or_unknown_suffix(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(ply(xyz_columns(bumpy_points())))
    assert "rename it to end in .ply" in refused(tmp_path / "a.pcd")
    (tmp_path / "a.doc").write_bytes(b"x")
    assert "no known scan format" in refused(tmp_path / "a.doc")


def test_normals_are_unit_or_left_out(tmp_path: Path) -> None:
    normals = 3 * unit_normals()
    path = tmp_path / "a.ply"
    columns = xyz_columns(bumpy_points()) | {f"n{n}": ("f8", normals[:, i]) for i, n in enumerate("xyz")}
    path.write_bytes(ply(columns))
    cloud = read_scan(path).cloud
    assert cloud.normals is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
    normals[4] = 0
    path.write_bytes(ply(columns))
    scan = read_scan(path)
    assert scan.cloud.normals is None and "some are zero" in scan.warnings[0]


@pytest.mark.parametrize("name", WRITERS)
def test_mutated_files_are_read_or_refused(tmp_path: Path, name: str) -> None:
    """Any damage ends in a scan or an InputError, soon, and what was read can be moved."""
    rng = np.random.default_rng(sorted(WRITERS).index(name))
    points = bumpy_points(60)
    data = WRITERS[name](points)
    if name.lower().endswith("ply"):
        encoding = {"a": "ascii", "l": "binary_little_endian", "b": "binary_big_endian"}[name[0]]
        faces = ("face", ["property list uchar int v"], [[("u1", "i4", [0] * (i % 4))] for i in range(9)])
        data = ply(xyz_columns(points), encoding, after=faces, lists=[[1] * (i % 3) for i in range(60)])
    path = tmp_path / name
    start = time.perf_counter()
    for _ in range(40):
        path.write_bytes(mutated(data, rng))
        try:
            scan = read_scan(path)
        except InputError as error:
            assert str(error).startswith(f"{path}: ") and str(error).isprintable()
        else:
            assert np.isfinite(scan.cloud.points).all()
            assert isinstance(scan.moved(motion()), bytes)
    assert time.perf_counter() - start < 10
