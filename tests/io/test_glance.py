"""What the beginning of a file tells: never more than its reader finds in the whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import bumpy_points, mutated, ply, xyz_columns
from tests.io.test_las import las
from tests.io.test_mesh import box
from tests.io.test_scan import WRITERS, xyz_pcd
from utopic_cli.errors import InputError
from utopic_cli.io.glance import problem_at_start
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import read_scan

POINTS = bumpy_points()
LAS = las(0, "1.2", points=POINTS, normals=False)
FACES = ("face", ["property list uchar int vertex_indices"], [[("u1", "i4", [0, 1, 2])]])


def seen(data: bytes, kind: str, start: int = 1 << 16) -> str | None:
    return problem_at_start(data[:start], len(data), kind)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("start", [400, 1 << 16])
def test_what_is_told_of_damaged_files_is_true(tmp_path: Path, name: str, start: int) -> None:
    rng = np.random.default_rng(8)
    path = tmp_path / name
    kind = path.suffix.lower()[1:]
    sound = WRITERS[name](POINTS)
    assert seen(sound, kind, start) is None
    found = 0
    for _ in range(60):
        path.write_bytes(data := mutated(sound, rng))
        if seen(data, kind, start) is not None:
            found += 1
            with pytest.raises(InputError):
                read_scan(path)
    assert found or kind in ("obj", "csv") or start == 400


@pytest.mark.parametrize("kind", ["stl", "off", "glb"])
def test_what_is_told_of_damaged_meshes_is_true(kind: str) -> None:
    from utopic_cli.io.mesh import read_mesh

    rng = np.random.default_rng(9)
    sound = box(kind)
    assert seen(sound, kind) is None and seen(sound, kind, 300) is None
    for _ in range(40):
        data = mutated(sound, rng)
        if seen(data, kind, 300) is not None:
            with pytest.raises(FormatError):
                read_mesh(data, kind, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("kind", "data", "reason"),
    [
        ("ply", b"", "the file is empty"),
        ("ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "no end_header"),
        ("ply", b"# .PCD v0.7\n", "is a PCD file by its content; rename it to end in .pcd"),
        ("ply", ply(xyz_columns(POINTS))[:-1], "promises 80 vertex records but there are at most 79"),
        ("ply", ply(xyz_columns(POINTS), after=FACES)[:-14], "promises 80 vertex"),
        ("ply", ply(xyz_columns(POINTS), "ascii")[:400], "promises 80 vertex records"),
        ("ply", ply({"x": ("f4", POINTS[:, 0])}), "no x, y and z"),
        ("pcd", xyz_pcd(POINTS)[:-1], "promises 80 points but there are 79"),
        ("pcd", xyz_pcd(POINTS, "binary_compressed")[:300], "compressed data but there are"),
        ("pcd", b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n", "no DATA line"),
        ("las", b"LASF", "cut short within its LAS header"),
        ("las", LAS[:-1], "promises 80 points but there are at most 79"),
        ("e57", b"ASTM-E57" + bytes(100), "is E57 version 0"),
        ("xyz", b"\0" * 100, "binary data, not text"),
        ("xyz", b"1,5 2,5 3,5\n" * 60, "a decimal comma"),
        ("stl", box("stl")[:-1], "triangles"),
        ("obj", b"no vertices\n", "no OBJ vertices"),
    ],
)
def test_damage_that_is_seen_at_once(kind: str, data: bytes, reason: str) -> None:
    problem = seen(data, kind)
    assert problem is not None and reason in problem and problem.isprintable()


def test_a_beginning_that_is_too_short_to_tell_says_nothing() -> None:
    long = b"comment long\n" * 100
    data = ply(xyz_columns(POINTS), extra_lines=tuple(long.decode().split("\n")[:-1]))
    assert seen(data, "ply", 300) is None
    assert seen(b"#\n" * 500 + b"1 2 3\n" * 60, "xyz", 300) is None
    assert seen(b"500\n" + b"1 2 3.5\n" * 500, "pts", 300) is None  # the promise is kept behind it
    assert seen(LAS, "las", 150) is None
