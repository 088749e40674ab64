from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.multiway.stubs import write_scans
from utopic_cli.errors import InputError
from utopic_cli.multiway.plan import first_pairs
from utopic_cli.multiway.scans import LONGEST_NAME, distinct_names, find_scans


def test_a_folder_gives_its_scans_in_natural_order(tmp_path):
    write_scans(tmp_path, ["scan10.ply", "scan2.ply", "scan1.ply", ".hidden.ply"])
    (tmp_path / "notes.md").write_text("no scan")
    (tmp_path / "deeper").mkdir()
    write_scans(tmp_path / "deeper", ["scan3.ply"])
    found = find_scans([tmp_path])
    assert [scan.name for scan in found.scans] == ["scan1", "scan2", "scan10"]
    note, below = found.notes
    assert "scans lie in 1 (deeper)" in below
    assert note.endswith("2 files are no scans and left out: no scan format: 2 (notes.md, truth.json)")
    assert all(len(scan.sha256) == 64 for scan in found.scans)


def test_a_name_with_brackets_is_a_file_before_it_is_a_pattern(tmp_path):
    write_scans(tmp_path, ["a[1].ply", "a1.ply", "b c.ply"])
    found = find_scans([tmp_path / "a[1].ply", tmp_path / "b*.ply"])
    assert [scan.path.name for scan in found.scans] == ["a[1].ply", "b c.ply"]
    found = find_scans([tmp_path / "a[[]1].ply", tmp_path / "a1.ply"])  # an escaped pattern
    assert [scan.path.name for scan in found.scans] == ["a[1].ply", "a1.ply"]


def test_copies_and_files_given_twice_are_said(tmp_path):
    write_scans(tmp_path, ["a.ply", "b.ply"])
    (tmp_path / "c.ply").write_bytes((tmp_path / "a.ply").read_bytes())
    found = find_scans([tmp_path, tmp_path / "b.ply"])
    assert [scan.copy_of for scan in found.scans] == [None, None, "a"]
    assert any("c.ply: is a copy of a" in note for note in found.notes)
    assert any("b.ply: is given twice" in note for note in found.notes)


def test_too_few_files_or_no_such_input(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        find_scans([tmp_path / "nothing"])
    write_scans(tmp_path, ["a.ply"])
    with pytest.raises(InputError, match="at least two"):
        find_scans([tmp_path])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")
def test_a_pattern_that_matches_a_folder_only_adds_nothing_and_ends_nothing(tmp_path):
    write_scans(tmp_path, ["a.ply", "b.ply"])
    (tmp_path / "deeper").mkdir()
    found = find_scans([tmp_path, tmp_path / "deep*"])
    assert [scan.name for scan in found.scans] == ["a", "b"]
    with pytest.raises(InputError, match="no file matches it"):
        find_scans([tmp_path, tmp_path / "shallow*"])


def test_listed_pairs_of_a_file_that_cant_be_read_are_not_planned(tmp_path):
    write_scans(tmp_path, ["a.ply", "b.ply", "cut.ply"])
    (tmp_path / "cut.ply").write_bytes((tmp_path / "cut.ply").read_bytes()[:-50])
    (tmp_path / "pairs.csv").write_text("cut,a\nb,a\n")
    scans = find_scans([tmp_path / name for name in ("a.ply", "b.ply", "cut.ply")])
    usable = [i for i, scan in enumerate(scans.scans) if scan.problem is None]
    assert usable == [0, 1]
    assert first_pairs(str(tmp_path / "pairs.csv"), scans, usable) == ((1, 0),)


def test_a_pipe_never_blocks_and_is_a_problem_of_its_own(tmp_path):
    write_scans(tmp_path, ["a.ply", "b.ply"])
    for name in ("c.ply", "d.txt"):
        os.mkfifo(tmp_path / name)
    found = find_scans([tmp_path])
    assert [bool(scan.problem) for scan in found.scans] == [False, False, True, True]
    assert not any(scan.doubtful for scan in found.scans)


def test_names_are_distinct_and_plain():
    paths = [
        "x/a.ply",
        "y/a.ply",
        "y/A.pcd",
        "a.pcd",
        "a--b.ply",
        "sp ace[1].ply",
        "-.ply",
        "é.ply",
        "a\nb.ply",
    ]
    names = distinct_names(map(Path, paths))
    assert names == ["a", "a.ply", "A.pcd", "a-2", "a-b", "sp ace[1]", "scan", "é", "a_b"]
    many = distinct_names([Path(f"{i}/{'é' * 200}.ply") for i in range(5)])
    assert len(set(many)) == 5
    assert max(len(name.encode()) for name in many) <= LONGEST_NAME
    assert not any("--" in name or "/" in name for name in names + many)


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux only")
def test_bytes_that_are_no_utf8_become_plain_names(tmp_path):
    raw = os.fsencode(tmp_path) + b"/caf\xe9.ply"
    write_scans(tmp_path, ["a.ply", "b.ply"])
    os.rename(os.fsencode(tmp_path / "b.ply"), raw)
    assert [scan.name for scan in find_scans([tmp_path]).scans] == ["a", "caf%E9"]
