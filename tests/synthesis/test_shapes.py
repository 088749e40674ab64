from __future__ import annotations

import numpy as np
import pytest

from tests.synthesis.conftest import ball, cuboid
from utopic_cli.errors import InputError
from utopic_cli.synthesis.shapes import load_shapes, pack, procedural_shapes


def write_packed(path, **changes):
    meshes = [ball(rings=6), cuboid((1, 2, 3)), cuboid()]
    arrays = {
        "vertices": np.concatenate([v for v, _ in meshes]).astype(np.float16),
        "faces": np.concatenate([f for _, f in meshes]).astype(np.uint16),
        "vertex_start": np.cumsum([0] + [len(v) for v, _ in meshes]),
        "face_start": np.cumsum([0] + [len(f) for _, f in meshes]),
        "names": np.array(["ball", "brick", "cube"]),
        "split": np.array(["train", "val", "train"]),
        "decimated": np.zeros(3, bool),
    } | changes
    np.savez_compressed(path, **{name: array for name, array in arrays.items() if array is not None})


def test_packed_meshes_come_back_whole(tmp_path):
    (tmp_path / "meshes").mkdir()
    write_packed(tmp_path / "meshes" / "first.npz")
    write_packed(tmp_path / "meshes" / "second.npz", names=np.array(["x", "y", "z"]))
    library = load_shapes(tmp_path)
    assert len(library) == 6
    assert library.names.tolist() == ["ball", "brick", "cube", "x", "y", "z"]
    assert library.sets.tolist() == ["first"] * 3 + ["second"] * 3
    vertices, faces = library.mesh(4)
    assert vertices.dtype == np.float64 and faces.dtype == np.int64
    np.testing.assert_allclose(vertices, cuboid((1, 2, 3))[0])
    np.testing.assert_array_equal(faces, cuboid()[1])
    held_out = library.select("val")
    assert held_out.names.tolist() == ["brick", "y"]
    np.testing.assert_allclose(held_out.mesh(1)[0], vertices)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"faces": None}, "no array faces"),
        ({"vertex_start": np.array([0, 5])}, "don't fit"),
        ({"face_start": np.array([0, 130, 120, 144])}, "don't fit"),
        ({"faces": np.full((144, 3), 9999, np.uint16)}, "don't fit|doesn't have"),
        ({"vertices": np.full((88, 3), np.nan, np.float16)}, "finite"),
    ],
)
def test_broken_files_are_named(tmp_path, changes, message):
    write_packed(tmp_path / "bad.npz", **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_shapes(tmp_path)
    assert "bad.npz" in str(caught.value)


def test_garbage_and_nothing_are_input_errors(tmp_path):
    with pytest.raises(InputError, match=r"no \.npz"):
        load_shapes(tmp_path)
    (tmp_path / "x.npz").write_bytes(b"garbage")
    with pytest.raises(InputError, match="can't be read"):
        load_shapes(tmp_path / "x.npz")


def test_an_unknown_split_is_an_input_error(tmp_path):
    write_packed(tmp_path / "one.npz")
    with pytest.raises(InputError, match="train, val"):
        load_shapes(tmp_path).select("test")


def test_sets_are_drawn_by_the_square_root_of_their_size():
    one = cuboid()
    library = pack([one] * 18, [str(i) for i in range(18)], ["train"] * 18, ["big"] * 16 + ["small"] * 2)
    rng = np.random.default_rng(0)
    drawn = np.array([library.draw(rng) for _ in range(3000)])
    expected = np.sqrt(2) / (4 + np.sqrt(2))
    assert (drawn >= 16).mean() == pytest.approx(expected, abs=0.03)
    assert len(np.unique(drawn)) == 18


def test_procedural_library_has_both_splits():
    library = procedural_shapes(np.random.default_rng(1), 10, 24)
    assert len(library.select("train")) == 9
    assert len(library.select("val")) == 1
