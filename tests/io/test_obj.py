"""OBJ: vertices read, normals turned, every other line kept."""

from __future__ import annotations

import io

import numpy as np
import pytest

from tests.io.samples import bumpy_points, motion, moved, unit_normals
from utopic_cli.io.obj import read_obj
from utopic_cli.io.records import FormatError


def obj(tails: tuple[str, ...] = ("",), corner: str = "{0}//{0}") -> bytes:
    lines = ["# a comment", "mtllib ../../secret.mtl", "o thing"]
    for i, p in enumerate(bumpy_points().tolist()):
        lines.append(f"v {p[0]!r} {p[1]!r} {p[2]!r}{tails[i % len(tails)]}")
    lines += ["vn " + " ".join(map(repr, n)) for n in unit_normals().tolist()]
    lines += ["vt 0.5 0.5", "usemtl red", "g part"]
    lines += ["f " + " ".join(corner.format(k) for k in (i, i + 1, i + 2)) for i in range(1, 40)]
    return ("\n".join(lines) + "\n").encode()


@pytest.mark.parametrize("tails", [("",), (" 1.0",), (" 0.1 0.2 0.3",), ("", " 1 0.5 0.5 0.5")])
def test_moves_vertices_and_normals_only(tails: tuple[str, ...]) -> None:
    T, data = motion(), obj(tails)
    records = read_obj(data)
    np.testing.assert_array_equal(records.points, bumpy_points())
    np.testing.assert_array_equal(records.normals, unit_normals())
    again = records.moved(T)
    back = read_obj(again)
    np.testing.assert_allclose(back.points, moved(bumpy_points(), T), rtol=0, atol=1e-14)
    np.testing.assert_allclose(back.normals, unit_normals() @ T[:3, :3].T, rtol=0, atol=1e-14)
    for old, new in zip(data.split(b"\n"), again.split(b"\n"), strict=True):
        if old.startswith((b"v ", b"vn ")):
            assert old.split()[4:] == new.split()[4:]
        else:
            assert old == new


def test_normals_of_corners_are_no_normals_of_points() -> None:
    data = obj(corner="{0}//1")
    records = read_obj(data)
    assert records.normals is None
    first = records.moved(motion()).split(b"\nvn ")[1].split(b"\n")[0]
    np.testing.assert_allclose(
        np.array(first.split(), float), motion()[:3, :3] @ unit_normals()[0], rtol=0, atol=1e-14
    )


def test_moved_file_agrees_with_trimesh() -> None:
    import trimesh

    data = obj(corner="{0}").replace(b"mtllib ../../secret.mtl\nusemtl red\n", b"")
    stream = io.BytesIO(read_obj(data).moved(motion()))
    mesh = trimesh.load(stream, file_type="obj", process=False, maintain_order=True)
    expected = moved(bumpy_points(), motion())
    np.testing.assert_allclose(mesh.triangles, expected[np.array([[i, i + 1, i + 2] for i in range(39)])])


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"hello\nworld\n", "no OBJ vertices"),
        (b"v 1 2 3\nv 1 2\n", r"its line 2, an OBJ vertex, has 2 values"),
        (b"v 1,5 2,5 3,5\n", "decimal comma"),
        (b"v 1 2 three\n", "'three', which is not a number"),
        (b"v 1 2 3\n\0\0", "binary"),
    ],
)
def test_unsound_files_are_named(data: bytes, reason: str) -> None:
    with pytest.raises(FormatError, match=reason):
        read_obj(data)
