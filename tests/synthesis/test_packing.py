from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.synthesis.conftest import ball, cuboid
from tests.synthesis.test_shapes import write_packed
from utopic_cli.errors import InputError, OutputError
from utopic_cli.synthesis import packing
from utopic_cli.synthesis.mesh_form import packed_mesh
from utopic_cli.synthesis.packing import describe_data, describe_skipped, open_shapes
from utopic_cli.synthesis.reconstruction import mesh_from_points
from utopic_cli.synthesis.shape_cache import cache_folder
from utopic_cli.synthesis.shapes import load_shapes
from utopic_cli.synthesis.surface import DegenerateShape, face_areas, sample_surface

pytestmark = pytest.mark.usefixtures("cache")


def write_obj(path, mesh):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["v {} {} {}".format(*row) for row in mesh[0]]
    lines += ["f {} {} {}".format(*row) for row in mesh[1] + 1]
    path.write_text("\n".join(lines) + "\n")


def write_off(path, mesh, first="OFF\n"):
    lines = [f"{len(mesh[0])} {len(mesh[1])} 0"]
    lines += [" ".join(map(str, row)) for row in mesh[0]]
    lines += ["3 " + " ".join(map(str, row)) for row in mesh[1]]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(first + "\n".join(lines) + "\n")


def many(folder, count=12):
    """So many bricks, all different."""
    for i in range(count):
        write_obj(folder / f"{i:02d}.obj", cuboid((1, 2, 1 + i)))


# The form ----------------------------------------------------------------------------------


def test_a_folder_becomes_a_pack_of_the_known_form(tmp_path, cache):
    write_obj(tmp_path / "data" / "bricks" / "one.obj", cuboid((3, 4, 12)))
    write_off(tmp_path / "data" / "balls" / "round.off", ball(7.0, (5, 5, 5), rings=8))
    write_off(tmp_path / "data" / "balls" / "glued.off", ball(rings=9), first="OFF")
    library = open_shapes(str(tmp_path / "data"))
    assert library.names.tolist() == ["balls/glued.off", "balls/round.off", "bricks/one.obj"]
    assert library.sets.tolist() == ["balls", "balls", "bricks"]
    assert set(library.splits.tolist()) == {"train", "val"}
    assert library.skipped == () and describe_skipped(library) is None
    vertices, faces = library.mesh(2)
    assert len(vertices) == 8 and len(faces) == 12
    np.testing.assert_allclose(np.abs(vertices) * 6.5, np.tile([1.5, 2, 6], (8, 1)), atol=5e-3)
    (pack,) = cache.glob("*.npz")
    with np.load(pack) as arrays:
        assert arrays["vertices"].dtype == np.float16 and arrays["faces"].dtype == np.uint16
        assert arrays["vertex_start"].dtype == np.int64 and arrays["decimated"].tolist() == [False] * 3
        assert set(load_shapes.__globals__["ARRAYS"]) <= set(arrays)
    again = load_shapes(pack)
    assert again.sets.tolist() == library.sets.tolist()
    for number in range(3):
        np.testing.assert_array_equal(again.mesh(number)[0], library.mesh(number)[0])
        radius = np.linalg.norm(library.mesh(number)[0], axis=1).max()
        assert radius == pytest.approx(1.0, abs=1e-3)
    assert sorted(path.name for path in (tmp_path / "data").rglob("*.*")) == [
        "glued.off",
        "one.obj",
        "round.off",
    ]


def test_a_packed_folder_is_read_as_it_is(tmp_path, cache):
    write_packed(tmp_path / "set.npz")
    write_obj(tmp_path / "beside.obj", cuboid())
    assert open_shapes(str(tmp_path)).names.tolist() == ["ball", "brick", "cube"]
    assert not cache.exists()


def test_the_split_follows_the_name_and_no_split_is_empty(tmp_path):
    many(tmp_path / "data", 40)
    library = open_shapes(str(tmp_path / "data"))
    held_out = library.select("val").names.tolist()
    assert 1 <= len(held_out) <= 12
    many(tmp_path / "more" / "data", 60)  # more shapes don't move the others
    more = open_shapes(str(tmp_path / "more" / "data")).select("val").names.tolist()
    assert [name for name in more if int(name[:2]) < 40] == held_out
    for count in (2, 3):
        many(tmp_path / f"few{count}", count)
        few = open_shapes(str(tmp_path / f"few{count}"))
        assert len(few.select("val")) >= 1 and len(few.select("train")) >= 1


def test_large_meshes_are_decimated_and_stay_in_shape():
    pytest.importorskip("open3d")
    packed = packed_mesh(*ball(3.0, rings=60))
    assert packed.decimated and 2000 < len(packed.faces) <= 3000
    points, _ = sample_surface(packed.vertices.astype(float), packed.faces, 5000, np.random.default_rng(0))
    assert np.abs(np.linalg.norm(points, axis=1) - 1.0).max() < 0.02


def test_without_open3d_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match="pip install open3d"):
        packed_mesh(*ball(rings=60))
    assert not packed_mesh(*ball(rings=20)).decimated


# What can't be used ------------------------------------------------------------------------


def test_bad_shapes_are_skipped_and_named(tmp_path):
    data = tmp_path / "data"
    many(data, 3)
    write_obj(data / "flat.obj", cuboid((1, 1, 0.001)))
    write_obj(data / "point.obj", (np.ones((4, 3)), np.array([[0, 1, 2], [1, 2, 3]])))
    write_obj(data / "nan.obj", (np.where(np.arange(8)[:, None] == 3, np.nan, cuboid()[0]), cuboid()[1]))
    write_obj(data / "wild.obj", (cuboid()[0], cuboid()[1] + 5))
    (data / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\nend_header\n1 2")
    (data / "empty.stl").write_bytes(b"")
    (data / "line.xyz").write_text("\n".join(f"{i} 0 0" for i in range(100)))
    os.mkfifo(data / "pipe.obj")
    library = open_shapes(str(data))
    assert library.names.tolist() == ["00.obj", "01.obj", "02.obj"]
    reasons = dict(library.skipped)
    assert set(reasons) == {
        "broken.ply", "empty.stl", "flat.obj", "line.xyz", "nan.obj", "pipe.obj", "point.obj", "wild.obj"
    }  # fmt: skip
    assert "flat" in reasons["flat.obj"] and "line" in reasons["line.xyz"]
    assert "empty" in reasons["empty.stl"] and "regular" in reasons["pipe.obj"]
    assert open_shapes(str(data)).skipped == library.skipped  # from the cache too
    assert library.select("train").skipped == library.skipped
    line = describe_skipped(library)
    assert line is not None and "\n" not in line
    assert line.startswith("skipped 8 shapes: broken.ply: ") and line.endswith("and 5 more")


def test_a_readme_is_no_broken_shape(tmp_path):
    many(tmp_path, 3)
    (tmp_path / "readme.txt").write_text("These are my scans.\nMade in 2021, on 3 days.\n")
    (tmp_path / "list.csv").write_text("name,size\na,1\n")
    library = open_shapes(str(tmp_path))
    assert {name for name, _ in library.skipped} == {"list.csv", "readme.txt"}
    assert describe_skipped(library) is None
    (tmp_path / "cut.txt").write_text("x y z\n-0.5, .25, 1e-3\n1 2\n")  # meant to be a cloud
    (tmp_path / "empty.txt").write_text("")
    line = describe_skipped(open_shapes(str(tmp_path)))
    assert line is not None and line.startswith("skipped 2 shapes: cut.txt: ") and "empty.txt" in line
    assert line.endswith("; text files left out: 2")


def test_folders_without_shapes_are_input_errors(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no shapes here.*\.ply.*procedural"):
        open_shapes(str(tmp_path / "empty"))
    with pytest.raises(InputError, match="no such folder"):
        open_shapes(str(tmp_path / "nowhere"))
    write_obj(tmp_path / "one.obj", cuboid())
    with pytest.raises(InputError, match="name the folder"):
        open_shapes(str(tmp_path / "one.obj"))
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "x.stl").write_bytes(b"garbage")
    with pytest.raises(InputError, match=r"none of its 1 shapes.*x\.stl: "):
        open_shapes(str(tmp_path / "bad"))


def test_a_cache_that_cannot_be_written_is_said_before_any_work(tmp_path, monkeypatch):
    many(tmp_path / "data", 2)
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "file"))
    monkeypatch.setattr(packing, "_mesh_of_file", lambda path: pytest.fail("worked before it asked"))
    with pytest.raises(OutputError, match="XDG_CACHE_HOME"):
        open_shapes(str(tmp_path / "data"))


# The cache ---------------------------------------------------------------------------------


def test_the_pack_is_reused_until_a_file_changes(tmp_path, cache):
    data = tmp_path / "data"
    many(data, 3)
    told: list[tuple[int, int, str]] = []
    open_shapes(str(data), progress=lambda *record: told.append(record))
    assert told == [(1, 3, "00.obj"), (2, 3, "01.obj"), (3, 3, "02.obj")]
    told.clear()
    open_shapes(str(data), progress=lambda *record: told.append(record))
    assert told == []
    write_obj(data / "01.obj", ball(rings=7))
    library = open_shapes(str(data), progress=lambda *record: told.append(record))
    assert len(told) == 3 and len(library.mesh(1)[1]) > 12
    (data / "02.obj").unlink()
    assert len(open_shapes(str(data))) == 2
    (pack,) = cache.iterdir()  # what the folder held before is gone, and nothing half-written is left
    pack.write_bytes(pack.read_bytes()[:100])  # a damaged pack is made again
    assert len(open_shapes(str(data))) == 2


def test_the_cache_is_where_the_platform_has_it(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "platform", "linux")
    assert cache_folder() == tmp_path / "cache" / "utopic"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says the standard
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "utopic"
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert cache_folder() == tmp_path / "local" / "utopic"


def test_odd_names(tmp_path):
    data = tmp_path / "my data"
    data.mkdir()
    write_obj(data / "a b.obj", cuboid((1, 2, 3)))
    write_obj(data / "línea\n.obj", cuboid((1, 2, 4)))
    expected = ["a b.obj", "línea\\n.obj"]
    try:
        write_obj(Path(os.fsdecode(os.fsencode(data) + b"/\xff.obj")), cuboid((1, 2, 5)))
        expected.append("\\xff.obj")
    except OSError:  # a file system that wants UTF-8
        pass
    library = open_shapes(str(data))
    assert sorted(library.names.tolist()) == sorted(expected)
    assert set(library.sets.tolist()) == {"my data"}


def test_several_processes_pack_the_same(tmp_path, monkeypatch):
    many(tmp_path / "data", 10)
    alone = open_shapes(str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    monkeypatch.setattr(packing, "_POOL_FROM", 10)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    together = open_shapes(str(tmp_path / "data"))
    assert together.names.tolist() == alone.names.tolist()
    np.testing.assert_array_equal(together.vertices, alone.vertices)


# Clouds ------------------------------------------------------------------------------------


def test_a_cloud_becomes_the_surface_it_lies_on(tmp_path):
    points, _ = sample_surface(*ball(2.0, rings=40), 2000, np.random.default_rng(0))
    (tmp_path / "data").mkdir()
    np.savetxt(tmp_path / "data" / "ball.xyz", points)
    np.savetxt(tmp_path / "data" / "half.txt", points[points[:, 2] > 0])
    library = open_shapes(str(tmp_path / "data"))
    for number, area in ((0, 4 * np.pi), (1, 2 * np.pi / 1.25)):
        vertices, faces = library.mesh(number)
        assert face_areas(vertices, faces).sum() == pytest.approx(area, rel=0.08)


def test_reconstruction_leaves_gaps_open_and_sheets_single():
    rng = np.random.default_rng(0)
    sheet = np.concatenate([rng.random((1500, 2)), np.zeros((1500, 1))], axis=1)
    apart = np.concatenate([sheet, sheet + [3.0, 0.0, 0.5]])
    vertices, faces = mesh_from_points(apart)
    assert face_areas(vertices, faces).sum() == pytest.approx(2.0, rel=0.05)
    assert np.ptp(vertices[faces][..., 0], axis=1).max() < 0.5
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3)
    assert face_areas(*mesh_from_points(grid)).sum() == pytest.approx(361.0, rel=0.01)
    assert len(mesh_from_points(np.zeros((80, 3)))[1]) == 0
    with pytest.raises(DegenerateShape):
        packed_mesh(*mesh_from_points(np.linspace(0, 1, 80)[:, None] * [1.0, 2.0, 3.0]))


def test_a_mesh_without_surface_is_degenerate():
    with pytest.raises(DegenerateShape, match="no faces"):
        packed_mesh(np.zeros((5, 3)), np.empty((0, 3), np.int64))


def test_data_in_words():
    assert describe_data("procedural") == "built-in procedural shapes"
    assert describe_data("modelnet40:a/b") == "ModelNet40 in a/b"
    assert describe_data("scanobjectnn:c.h5") == "ScanObjectNN in c.h5"
    assert describe_data("shapes") == "shapes"


# Real data ---------------------------------------------------------------------------------

SHARED = Path(__file__).parents[2].parent / "shared" / "scans" / "bunny"


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the bunny's scans")
def test_real_scans_are_packed(tmp_path):
    pytest.importorskip("open3d")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "bun000.ply").symlink_to(SHARED / "bun000.ply")
    library = open_shapes(str(tmp_path / "data"))
    vertices, faces = library.mesh(0)
    assert 2500 < len(faces) <= 3000
    sides = np.linalg.norm(vertices[faces] - np.roll(vertices[faces], 1, axis=1), axis=2)
    assert np.quantile(sides, 0.99) < 0.2
