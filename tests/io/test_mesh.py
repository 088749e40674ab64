"""STL, OFF and GLB: sampled by area, repeatably, and written again as meshes."""

from __future__ import annotations

import io
import json
import struct

import numpy as np
import pytest

from tests.io.samples import motion, moved, mutated
from utopic_cli.io.mesh import SAMPLES, read_mesh
from utopic_cli.io.records import FormatError

KINDS = ("stl", "stl_ascii", "off", "glb")


def box(kind: str) -> bytes:
    import trimesh

    exported = trimesh.creation.box((1.0, 2.0, 4.0)).export(file_type=kind)
    return exported if isinstance(exported, bytes) else exported.encode()


def read(data: bytes, kind: str, seed: int = 0):
    return read_mesh(data, kind.removesuffix("_ascii"), np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_samples_lie_on_the_surface_by_area(kind: str) -> None:
    records = read(box(kind), kind)
    assert records.points.shape == (SAMPLES, 3)
    assert "drawn from its surface" in records.warnings[0]
    distance = np.abs(np.abs(records.points) / [0.5, 1.0, 2.0] - 1).min(axis=1)
    assert distance.max() < 1e-6
    # Two of the six sides, 2 x 4 each of 28 in all, face along x.
    on_x = (np.abs(np.abs(records.points[:, 0]) - 0.5) < 1e-6).mean()
    assert abs(on_x - 16 / 28) < 0.02
    np.testing.assert_allclose(np.abs(records.normals).max(axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_seeded(kind: str) -> None:
    data = box(kind)
    np.testing.assert_array_equal(read(data, kind, 3).points, read(data, kind, 3).points)
    assert (read(data, kind, 3).points != read(data, kind, 4).points).any()


@pytest.mark.parametrize("kind", KINDS)
def test_moved_mesh_is_the_mesh_moved(kind: str) -> None:
    import trimesh

    T = motion()
    again = read(box(kind), kind).moved(T)
    assert again.startswith(b"solid") == (kind == "stl_ascii")
    mesh = trimesh.load(io.BytesIO(again), file_type=kind, process=False)
    mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
    corners = moved(trimesh.creation.box((1.0, 2.0, 4.0)).vertices, T)
    nearest = np.linalg.norm(mesh.vertices[:, None] - corners[None], axis=2).min(axis=1)
    assert nearest.max() < 1e-5
    assert len(mesh.faces) == 12


@pytest.mark.parametrize("kind", KINDS)
def test_mutated_meshes_are_read_or_refused(kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    rng, data = np.random.default_rng(11), box(kind)
    for _ in range(20):
        try:
            read(mutated(data, rng), kind).moved(motion())
        except FormatError as error:
            assert str(error)
    assert capfd.readouterr() == ("", "")


def glb(description: dict) -> bytes:
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<II", 2, 20 + len(text)) + struct.pack("<I", len(text)) + b"JSON" + text


@pytest.mark.parametrize(
    ("kind", "data", "reason"),
    [
        ("stl", b"\0" * 80 + struct.pack("<I", 4_000_000_000) + b"\0" * 100, "promises 4000000000 triangles"),
        ("stl", b"short", "too short"),
        ("off", b"OFF\n4000000000 7 0\n0 0 0\n", "promises 4000000000 vertices"),
        ("off", b"hello", "does not start like an OFF"),
        ("off", b"OFF\n" + b" #" * 60 + b" x", "does not start like an OFF"),
        ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "vertices that do not exist|can't be read"),
        ("off", b"OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n", "without any area"),
        ("glb", b"glTF" + b"\0" * 3, "does not start like a GLB"),
        ("glb", b"glTF" + struct.pack("<IIII", 2, 9999, 10, 0), "promises 9999 bytes"),
        ("glb", glb({"accessors": [{"count": 10**12}]}), "data the file does not hold"),
        ("glb", glb({"accessors": [{"count": 10**12, "bufferView": 0}]}), "data the file does not hold"),
        ("glb", glb({"buffers": [{"uri": "../secret.bin"}]}), "refers to other files"),
    ],
)
def test_unsound_files_are_named(kind: str, data: bytes, reason: str) -> None:
    with pytest.raises(FormatError, match=reason):
        read(data, kind)
