"""``utopic apply`` and ``utopic transformation``: the order of products, what is kept, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from tests.io.samples import bumpy_points, ply, unit_normals
from utopic_cli.commands.transformation import Form
from utopic_cli.io.scan import read_scan
from utopic_cli.io.transformation import FORM_OF_SUFFIX, FORMS, format_transformation, read_transformation

QUARTER = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
IN_FOLDER = Path("folder", "in.ply")
SHIFT = np.array([[1.0, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with two transformations, which do not commute, and a scan of five points."""
    (tmp_path / "quarter.txt").write_bytes(format_transformation(QUARTER, "matrix"))
    (tmp_path / "shift.json").write_bytes(format_transformation(SHIFT, "json"))
    points, normals = bumpy_points(5), unit_normals(5)
    columns = {name: ("f8", points[:, i]) for i, name in enumerate("xyz")}
    columns |= {f"n{name}": ("f4", normals[:, i]) for i, name in enumerate("xyz")}
    columns |= {"red": ("u1", np.arange(5)), "odd": ("i2", -np.arange(5))}
    faces = ("face", ["property list uchar int vertex_indices"], [[("u1", "i4", [0, 1, 2])]])
    data = ply(columns, after=faces, extra_lines=("comment kept",))
    (tmp_path / "in.ply").write_bytes(data)
    return tmp_path


def read(path: Path) -> np.ndarray:
    return read_scan(path, to_align=False).cloud.points


def test_the_one_next_to_the_scan_acts_first(cli, files: Path) -> None:
    result = cli(
        "apply", files / "quarter.txt", files / "shift.json", files / "in.ply", "-o", files / "out.ply"
    )
    assert result.exit_code == 0, result.stderr
    assert result.stdout == "" and "turned by 90.000 degrees" in result.stderr
    points = read(files / "in.ply")
    expected = (points + [10, 0, 0]) @ QUARTER[:3, :3].T + [1, 2, 3]
    np.testing.assert_allclose(read(files / "out.ply"), expected, atol=1e-14)


def test_everything_but_coordinates_and_normals_is_kept(cli, files: Path) -> None:
    assert cli("apply", files / "quarter.txt", files / "in.ply", "-o", files / "out.ply").exit_code == 0
    before, after = (files / "in.ply").read_bytes(), (files / "out.ply").read_bytes()
    assert len(before) == len(after)
    start = before.index(b"end_header\n") + 11
    assert before[:start] == after[:start] and b"comment kept" in before
    record = 3 * 8 + 3 * 4 + 1 + 2
    rows = [
        np.frombuffer(data[start : start + 5 * record], "u1").reshape(5, record) for data in (before, after)
    ]
    np.testing.assert_array_equal(rows[0][:, 36:], rows[1][:, 36:])
    assert before[start + 5 * record :] == after[start + 5 * record :]
    normals = [row[:, 24:36].copy().view("<f4") for row in rows]
    np.testing.assert_allclose(normals[1], normals[0] @ QUARTER[:3, :3].T, atol=1e-7)


def test_there_and_back(cli, files: Path) -> None:
    both = files / "quarter.txt", files / "shift.json"
    assert cli("apply", *both, files / "in.ply", "-o", files / "out.ply").exit_code == 0
    assert cli("apply", *both, files / "out.ply", "-o", files / "back.ply", "--invert").exit_code == 0
    np.testing.assert_allclose(read(files / "back.ply"), read(files / "in.ply"), atol=1e-14)


def test_nothing_is_replaced_unasked(cli, files: Path) -> None:
    (files / "out.ply").write_bytes(b"mine")
    command = ("apply", files / "quarter.txt", files / "in.ply", "-o", files / "out.ply")
    refused = cli(*command)
    assert refused.exit_code == 5 and "--overwrite" in refused.stderr
    assert (files / "out.ply").read_bytes() == b"mine"
    assert cli(*command, "--overwrite").exit_code == 0
    onto_itself = cli("apply", files / "quarter.txt", files / "in.ply", "-o", files / "in.ply", "--overwrite")
    assert onto_itself.exit_code == 5 and "input" in onto_itself.stderr
    onto_a_transformation = cli(
        "transformation", files / "quarter.txt", "-o", files / "quarter.txt", "--overwrite"
    )
    assert onto_a_transformation.exit_code == 5 and "input" in onto_a_transformation.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["in.ply", "-o", "out.ply"], 2, "give a transformation and a scan"),
        (["quarter.txt", "in.ply", "-o", "out.pcd"], 2, ".ply"),
        (["quarter.txt", "in.ply", "-o", "folder"], 2, f"is a folder; name a file in it: -o {IN_FOLDER}"),
        (["shift.json", "quarter.txt", "-o", "out.txt"], 2, "'utopic transformation'"),
        (["missing.txt", "in.ply", "-o", "out.ply"], 4, "no such file"),
        (["quarter.txt", "missing.ply", "-o", "out.ply"], 4, "no such file"),
        (["in.ply", "in.ply", "-o", "out.ply"], 4, "no transformation file"),
        (["in.ply", "quarter.txt", "-o", "x.ply"], 2, "utopic apply quarter.txt in.ply -o x.ply"),
        (["in.ply", "shift.json", "-o", "x.ply"], 2, "in.ply looks like a scan and shift.json like a"),
        (["quarter.txt#2", "in.ply", "-o", "out.ply"], 4, "no entry '2'"),
        (["mirror.txt", "in.ply", "-o", "out.ply"], 4, "mirrors"),
        (["quarter.txt", "in.ply", "-o", "nowhere/out.ply"], 5, "folder"),
    ],
)
def test_refusals_are_one_line(
    cli, files: Path, monkeypatch, arguments: list[str], code: int, said: str
) -> None:
    monkeypatch.chdir(files)
    (files / "mirror.txt").write_bytes(format_transformation(np.diag([1.0, 1, -1, 1]), "matrix"))
    (files / "folder").mkdir()
    before = set(files.iterdir())
    result = cli("apply", *arguments)
    assert result.exit_code == code, result.stderr
    assert said in result.stderr and len(result.stderr.splitlines()) == 1
    assert set(files.iterdir()) == before


@pytest.mark.parametrize("suffix", FORM_OF_SUFFIX)
def test_products_are_written_in_every_form(cli, files: Path, suffix: str) -> None:
    out = files / f"product{suffix}"
    result = cli("transformation", files / "quarter.txt", files / "shift.json", "--invert", "-o", out)
    assert result.exit_code == 0, result.stderr
    np.testing.assert_allclose(read_transformation(out), np.linalg.inv(QUARTER @ SHIFT), atol=1e-14)


def test_without_an_output_it_goes_to_stdout(cli, files: Path) -> None:
    result = cli("transformation", files / "quarter.txt", files / "shift.json")
    assert result.exit_code == 0 and result.stderr == ""
    assert result.stdout == "0 -1 0 1\n1 0 0 12\n0 0 1 3\n0 0 0 1\n"
    pdal = cli("transformation", files / "quarter.txt", "--form", "pdal")
    stage = json.loads(pdal.stdout)["pipeline"][0]
    assert stage == {"type": "filters.transformation", "matrix": "0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1"}
    assert cli("transformation", files / "quarter.txt", "--form", "npy").exit_code == 2
    assert cli("transformation", files / "quarter.txt", "-o", files / "T.xyz").exit_code == 2


@pytest.mark.parametrize("more", [[], ["--form", "tum"], ["--overwrite"]])
def test_a_folder_in_the_place_of_a_file_is_told(cli, files: Path, more: list[str]) -> None:
    for folder in (files, files / "named.txt"):
        folder.mkdir(exist_ok=True)
        result = cli("transformation", files / "quarter.txt", "-o", folder, *more)
        assert result.exit_code == 2 and len(result.stderr.splitlines()) == 1
        assert f"{folder}: is a folder; name a file in it: -o {folder / 'T.txt'}" in result.stderr


def test_the_forms_offered_are_the_forms_there_are() -> None:
    assert set(get_args(Form)) == set(FORMS) == set(FORM_OF_SUFFIX.values())


def test_a_scan_finds_its_place_in_a_model(cli, files: Path) -> None:
    poses = {"scans": [{"scan": "other", "T_world_scan": SHIFT.tolist()}]}
    poses["scans"].append({"scan": "in", "T_world_scan": QUARTER.tolist()})
    (files / "poses.json").write_text(json.dumps(poses))
    unnamed = cli("apply", files / "poses.json", files / "in.ply", "-o", files / "out.ply")
    assert unnamed.exit_code == 4 and "poses.json#other" in unnamed.stderr
    assert (
        cli("apply", f"{files / 'poses.json'}#in", files / "in.ply", "-o", files / "out.ply").exit_code == 0
    )
    expected = read(files / "in.ply") @ QUARTER[:3, :3].T + [1, 2, 3]
    np.testing.assert_allclose(read(files / "out.ply"), expected, atol=1e-14)


def test_a_transformation_of_a_model_names_its_frames(cli, files: Path) -> None:
    scans = [{"scan": "the #1 scan", "T_world_scan": QUARTER.tolist()}]
    (files / "poses.json").write_text(json.dumps({"scans": scans}))
    asked = ("transformation", f"{files / 'poses.json'}#the #1 scan")
    ros = cli(*asked, "--form", "ros").stdout
    assert '# p_target = T_target_source @ p_source, target: world, source: "the \\u00231 scan"' in ros
    assert '\n  frame_id: world\nchild_frame_id: "the \\u00231 scan"\n' in ros
    (files / "T.yaml").write_text(ros)
    np.testing.assert_allclose(read_transformation(files / "T.yaml"), QUARTER, atol=1e-14)
    there, back = (json.loads(cli(*asked, "--form", "json", *more).stdout) for more in ([], ["--invert"]))
    assert (there["target"], there["source"]) == ("world", "the #1 scan")
    assert (back["target"], back["source"]) == ("the #1 scan", "world")
    after = json.loads(cli(asked[0], files / "shift.json", asked[1], "--form", "json").stdout)
    assert (after["target"], after["source"]) == ("target", "the #1 scan")
    plain = cli("transformation", files / "shift.json", "--form", "ros", "--invert").stdout
    assert "  frame_id: target\nchild_frame_id: source\n" in plain


def test_a_scan_without_a_place_in_a_model_is_told_why(cli, files: Path) -> None:
    poses = {"scans": [{"scan": "in", "T_world_scan": None}]}
    poses["left_out"] = [{"scan": "in", "reason": "no pair with it was tried"}]
    (files / "poses.json").write_text(json.dumps(poses))
    result = cli("apply", f"{files / 'poses.json'}#in", files / "in.ply", "-o", files / "out.ply")
    assert result.exit_code == 4
    assert "in was left out of the batch (no pair with it was tried), so it has no pose" in result.stderr


def test_rows_of_a_batch_point_to_its_named_poses(cli, files: Path) -> None:
    (files / "poses.txt").write_bytes(2 * format_transformation(QUARTER, "kitti"))
    asked = ("apply", files / "poses.txt", files / "in.ply", "-o", files / "out.ply")
    assert "poses.json" not in cli(*asked).stderr
    (files / "poses.json").write_text("{}")
    assert f"'poses.txt#1', or by its scan's name, as in '{files / 'poses.json'}#NAME'" in cli(*asked).stderr


def test_an_option_of_another_name_is_hinted_at(cli, files: Path) -> None:
    result = cli("transformation", files / "quarter.txt", "--to", "ros")
    assert result.exit_code == 2
    assert "No such option: --to; did you mean --form?" in result.stderr


def test_align_writes_the_same_forms(cli, fake, scans, tmp_path: Path) -> None:
    for suffix in FORM_OF_SUFFIX:
        out = tmp_path / f"T{suffix}"
        result = cli("align", *scans, "-o", out, "-q")
        assert result.exit_code == 0, result.stderr
        np.testing.assert_allclose(read_transformation(out), QUARTER, atol=1e-15)
    assert cli("align", *scans, "-o", tmp_path / "T.doc").exit_code == 2


def test_verbose_shows_what_the_library_logs(cli, files: Path) -> None:
    quiet = cli("apply", files / "quarter.txt", files / "in.ply", "-o", files / "one.ply")
    verbose = cli("apply", files / "quarter.txt", files / "in.ply", "-o", files / "two.ply", "-v")
    assert "5 points" in verbose.stderr and "5 points" not in quiet.stderr


def test_what_concerns_only_aligning_is_not_said(cli, files: Path) -> None:
    """A point that is NaN stays as it is, and a mesh is moved itself."""
    points = bumpy_points(60)
    points[3] = np.nan
    np.savetxt(files / "in.xyz", points)
    triangle = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    (files / "in.stl").write_text(f"solid a\n{triangle}endsolid a\n")
    for name in ("in.xyz", "in.stl"):
        result = cli("apply", files / "quarter.txt", files / name, "-o", files / f"out.{name[3:]}")
        assert result.exit_code == 0 and len(result.stderr.splitlines()) == 1, result.stderr
    assert np.isnan(np.loadtxt(files / "out.xyz")[3]).all()
