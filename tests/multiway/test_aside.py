"""What lies beside the scans: told apart at a glance, said in a line, taken only by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.multiway.stubs import write_scans
from utopic_cli.errors import InputError
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.io.transformation import format_transformation
from utopic_cli.multiway.scans import find_scans


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    write_scans(tmp_path, ["a.ply", "b.ply"])
    (tmp_path / "truth.json").unlink()
    return tmp_path


def test_what_is_no_scan_is_left_out_and_said_in_a_line(scans: Path) -> None:
    (scans / "README.txt").write_text("Scans of a thing,\nmade on 3 May at 10 am.\n")
    (scans / "notes.csv").write_text("scan,date,by\na,2024-05-03,Ann\nb,2024-05-04,Bob\n")
    for name in ("1.jpg", "2.jpg", "3.jpg", "4.jpg"):
        (scans / name).write_bytes(b"\xff\xd8\xff")
    (scans / "T.xyz").write_bytes(format_transformation(np.eye(4), "matrix"))
    (scans / "poses.txt").write_bytes(60 * format_transformation(np.eye(4), "kitti"))
    found = find_scans([scans])
    assert [scan.name for scan in found.scans] == ["a", "b"]
    assert found.notes == (
        f"{scans}: 8 files are no scans and left out: no scan format: 4 (1.jpg, 2.jpg, 3.jpg, ...); "
        "text without points: 2; poses, not points: 2",
    )


def test_scans_in_subfolders_are_said_not_to_be_taken(scans: Path) -> None:
    for name in ("day-1", "day-2", "photos", ".hidden"):
        (scans / name).mkdir()
    for name in ("day-1", "day-2", ".hidden"):
        (scans / name / "c.ply").write_bytes((scans / "a.ply").read_bytes())
    (scans / "photos" / "1.jpg").write_bytes(b"\xff\xd8\xff")
    (scans / "photos" / "notes.txt").write_text("Of the 3rd of May.\n")
    found = find_scans([scans])
    assert len(found.scans) == 2
    assert found.notes == (
        f"{scans}: sub-folders are not looked into; scans lie in 2 (day-1, day-2): name these as well",
    )


def test_one_file_that_is_no_scan_is_told_as_such(tmp_path: Path) -> None:
    for name, text in (("notes.txt", "Scans of a thing.\n"), ("notes.md", "# Scans\n")):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=r": is no scan \(.*\); a batch takes a folder or several scans"):
            find_scans([tmp_path / name])


def test_points_in_text_are_taken_or_told_as_scans(scans: Path) -> None:
    """Numbers that can't be read are rather a scan gone wrong: the reason is said, and not only that."""
    rows = np.random.default_rng(0).uniform(-1, 1, (60, 3)).tolist()
    (scans / "good.txt").write_text("x y z\n" + "\n".join(" ".join(map(str, row)) for row in rows))
    (scans / "comma.txt").write_text("1,5 2,5 3,5\n" * 60)
    (scans / "empty.csv").write_text("")
    found = find_scans([scans])
    problems = {scan.name: scan.problem for scan in found.scans}
    assert not found.notes and problems["good"] is None
    assert "a decimal comma" in str(problems["comma"]) and "is empty" in str(problems["empty"])


def test_a_name_like_ours_is_a_scan_all_the_same(scans: Path) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    for name in ("merged.ply", "aligned.ply", "source_overlap.ply"):
        (scans / name).write_bytes(
            scalar_cloud_ply(points + 1e-3 * len(name), np.zeros((60, 3), np.uint8), {})
        )
    found = find_scans([scans])
    assert len(found.scans) == 5 and not found.aside


def test_a_folder_without_scans_says_what_is_in_it(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"holds no scan files; .* \| .*no scan format: 1 \(a\.jpg\)"):
        find_scans([tmp_path])


def test_what_can_not_be_read_is_known_before_any_cloud_is(scans: Path) -> None:
    whole = (scans / "a.ply").read_bytes()
    (scans / "cut.ply").write_bytes(whole[:-7])
    (scans / "cut2.ply").write_bytes(whole[:-7])
    (scans / "empty.ply").write_bytes(b"")
    (scans / "other.pcd").write_bytes(whole)
    found = find_scans([scans])
    problems = {scan.name: scan.problem for scan in found.scans}
    assert problems.pop("a") is None and problems.pop("b") is None
    assert "promises 200 vertex" in str(problems["cut"]) and "promises 200 vertex" in str(problems["cut2"])
    assert str(problems["empty"]).startswith(f"{scans / 'empty.ply'}: the file is empty")
    assert problems["other"] is None and found.scans[-1].copy_of == "a"  # the same bytes: one scan
