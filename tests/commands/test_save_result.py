"""``save`` writes what ``utopic align --out-dir`` writes, file by file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import utopic_cli
from tests.io.samples import bumpy_points
from utopic_cli import InputError, OutputError, UsageError, align, save
from utopic_cli.io.scan import read_scan


@pytest.fixture
def aligned(fake, scans):
    """A result for two files, one point of which is not finite."""
    text = scans[0].read_text()
    start = text.index("end_header\n") + 11
    line = text[start : text.index("\n", start)]
    scans[0].write_text(text.replace(line, "nan nan nan 7", 1))
    return align(*scans, seed=3)


def report_of(folder: Path) -> dict:
    report = json.loads((folder / "report.json").read_text())
    return {key: value for key, value in report.items() if key != "timings_s"}


def test_the_set_is_that_of_the_command(cli, aligned, scans, tmp_path: Path) -> None:
    assert cli("align", *scans, "--out-dir", tmp_path / "command", "--seed", 3).exit_code == 0
    written = save(aligned, *scans, tmp_path / "program")
    names = [path.name for path in written]
    assert names[-1] == "report.json"
    assert sorted(names) == sorted(path.name for path in (tmp_path / "command").iterdir())
    for name in set(names) - {"report.json"}:
        assert (tmp_path / "program" / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    assert report_of(tmp_path / "program") == report_of(tmp_path / "command")
    assert len(report_of(tmp_path / "program")["warnings"]) == 1


def test_nothing_is_replaced_unasked_and_no_input_ever(aligned, scans, tmp_path: Path) -> None:
    out = tmp_path / "out"
    save(aligned, *scans, out)
    (out / "report.json").write_text("mine")
    with pytest.raises(OutputError, match=r"exists already; pass overwrite=True to replace it"):
        save(aligned, *scans, out)
    assert (out / "report.json").read_text() == "mine"
    save(aligned, *scans, str(out), overwrite=True)
    assert report_of(out)
    with pytest.raises(OutputError, match="does not exist"):
        save(aligned, *scans, tmp_path / "no" / "folder")
    inside = scans[1].rename(out / "source_overlap.ply")
    with pytest.raises(OutputError, match="is an input of this run"):
        save(aligned, scans[0], inside, out, overwrite=True)


def test_arrays_are_written_as_plain_ply(fake, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    source, target = bumpy_points(60), bumpy_points(70, seed=2)
    source[5] = np.nan
    result = align(source, target)
    save(result, source, target, "out", colormap="purple-yellow")
    moved = read_scan("out/aligned.ply")
    assert moved.records == 60 and len(moved.cloud) == 59
    T = result.T_target_source
    np.testing.assert_allclose(moved.cloud.points, np.delete(source, 5, 0) @ T[:3, :3].T + T[:3, 3])
    report = report_of(Path("out"))
    assert report["source"]["path"] == "source.ply" and report["source"]["points"] == 59
    assert report["warnings"] == ["source.ply: 1 of 60 points are NaN or infinite and were left out"]
    properties = Path("out/source_overlap.ply").read_bytes().split(b"end_header")[0]
    assert b"scalar_overlap" in properties and b"scalar_original" not in properties
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_scans_that_are_not_the_results_are_refused(aligned, scans, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"b\.ply: has 80 points, the result's source 60; .* source first"):
        save(aligned, *reversed(scans), tmp_path / "out")
    with pytest.raises(UsageError, match="no such colour map; choose blue-red"):
        save(aligned, *scans, tmp_path / "out", colormap="rainbow")
    with pytest.raises(InputError, match="no such file"):
        save(aligned, tmp_path / "c.ply", scans[1], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_other_scans_of_as_many_points_are_refused(aligned, scans, tmp_path: Path) -> None:
    clouds = [read_scan(path) for path in scans]
    other = clouds[1].cloud.points.copy()
    other[7, 2] += 1e-12
    with pytest.raises(UsageError, match=r"target\.ply: its points are not those of the result's target"):
        save(aligned, scans[0], other, tmp_path / "out")
    holes = np.full((60, 3), np.nan)
    holes[clouds[0].kept] = clouds[0].cloud.points
    with pytest.raises(UsageError, match=r"source\.ply: its points are not those"):
        save(aligned, np.roll(holes, 1, axis=0), scans[1], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    save(aligned, holes, clouds[1].cloud.points, tmp_path / "out")


def test_files_of_the_arrays_aligned_are_theirs(fake, scans, tmp_path: Path) -> None:
    arrays = [read_scan(path).cloud.points for path in scans]
    assert save(align(*arrays), *scans, tmp_path / "out")
    doubled = align(arrays[0] * 2, arrays[1])
    with pytest.raises(UsageError, match=r"a\.ply: its points are not those of the result's source"):
        save(doubled, *scans, tmp_path / "doubled")


def test_the_package_hands_it_out() -> None:
    assert "save" in dir(utopic_cli) and utopic_cli.save is save
