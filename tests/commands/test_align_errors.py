from __future__ import annotations

import errno
import io
import os
import sys

import numpy as np
import pytest

from utopic_cli.commands import outputs
from utopic_cli.commands.console import to_stdout
from utopic_cli.errors import InputError, OutputError
from utopic_cli.result import FitMeasures

HEADER = (
    "ply\nformat ascii 1.0\nelement vertex {}\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n"
)
BIG_HEADER = HEADER.format(4_000_000_000).replace("ascii", "binary_little_endian")


def ply(points):
    return HEADER.format(len(points)) + "".join(f"{x} {y} {z}\n" for x, y, z in points)


def grid(count):
    return [(i % 7, i // 7, i % 5) for i in range(count)]


BAD_FILES = {
    "empty": b"",
    "garbage": bytes(range(256)) * 8,
    "not a scan": b"dear sir or madam\n",
    "truncated": ply(grid(80)).encode()[:-200],
    "promises 4 billion": BIG_HEADER.encode() + b"\0" * 99,
    "too few points": ply(grid(49)).encode(),
    "too few distinct points": ply(grid(40) * 3).encode(),
    "all equal": ply([(1, 2, 3)] * 90).encode(),
    "on a line": ply([(i, 2 * i, -i) for i in range(90)]).encode(),
    "all NaN": ply([("nan", "nan", "nan")] * 90).encode(),
}


def snapshot(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def assert_one_line(result, *words):
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("utopic: ")
    for word in words:
        assert word in lines[0]


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("kind", BAD_FILES)
def test_a_scan_that_cant_be_used_exits_4_in_one_line_and_leaves_everything_as_it_was(
    cli, fake, scans, tmp_path, kind, side
):
    bad = tmp_path / "bad.ply"
    bad.write_bytes(BAD_FILES[kind])
    (tmp_path / "T.txt").write_text("precious")
    before = snapshot(tmp_path)
    pair = [bad, scans[1]] if side == 0 else [scans[0], bad]
    result = cli("align", *pair, "-o", tmp_path / "T.txt", "--out-dir", tmp_path / "out", "--overwrite")
    assert result.exit_code == 4, result.output
    assert_one_line(result, str(bad))
    assert result.stdout == ""
    assert not fake.calls
    assert snapshot(tmp_path) == before
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["missing", "folder", "fifo", "unknown suffix", "below a file"])
def test_what_is_not_a_scan_file_exits_4(cli, fake, scans, tmp_path, kind):
    path = tmp_path / "bad.ply"
    if kind == "folder":
        path.mkdir()
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "unknown suffix":
        path = tmp_path / "bad.docx"
        path.write_bytes(scans[0].read_bytes()[3:])
    elif kind == "below a file":
        path = scans[0] / "bad.ply"
    result = cli("align", path, scans[1])
    assert result.exit_code == 4, result.output
    assert_one_line(result, str(path))


@pytest.mark.parametrize("content", ["", "1 2 3", "not numbers", "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n"])
def test_an_initial_transformation_that_is_none_exits_4(cli, fake, scans, tmp_path, content):
    (tmp_path / "init.txt").write_text(content)
    result = cli("align", *scans, "--init", tmp_path / "init.txt")
    assert result.exit_code == 4
    assert_one_line(result, "init.txt")


OUTPUT_OPTIONS = {
    "-o": "T.txt", "--aligned": "moved.ply", "--merged": "m.ply", "--report": "r.json",
    "--clouds": "clouds", "--out-dir": "out",
}  # fmt: skip


@pytest.fixture
def no_reading(monkeypatch):
    """Fail if a scan is read: outputs are checked before any work."""

    def refuse(path, **_):
        raise AssertionError(f"{path} was read before the outputs were checked")

    monkeypatch.setattr("utopic_cli.io.scan.read_scan", refuse)


@pytest.mark.parametrize("option", OUTPUT_OPTIONS)
@pytest.mark.parametrize("place", ["missing folder", "below a file"])
def test_an_output_that_cant_be_written_exits_5_before_any_work(
    cli, fake, scans, tmp_path, no_reading, option, place
):
    folder = tmp_path / "missing" / "deeper" if place == "missing folder" else scans[0]
    result = cli("align", *scans, option, folder / OUTPUT_OPTIONS[option])
    assert result.exit_code == 5, result.output
    assert_one_line(result, str(folder))


@pytest.mark.parametrize("option", ["--clouds", "--out-dir"])
def test_a_folder_that_is_a_link_to_nothing_exits_5_before_any_work(
    cli, fake, scans, tmp_path, no_reading, option
):
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    result = cli("align", *scans, option, tmp_path / "link")
    assert result.exit_code == 5, result.output
    assert_one_line(result, "link to nothing")


@pytest.mark.parametrize("option", OUTPUT_OPTIONS)
def test_existing_files_are_refused_and_with_overwrite_replaced(cli, fake, scans, tmp_path, option):
    path = tmp_path / OUTPUT_OPTIONS[option]
    first = cli("align", *scans, option, path)
    assert first.exit_code == 0, first.output
    before = snapshot(tmp_path)
    again = cli("align", *scans, option, path)
    assert again.exit_code == 5, again.output
    assert_one_line(again, "--overwrite")
    assert len(fake.calls) == 1
    assert snapshot(tmp_path) == before
    assert cli("align", *scans, option, path, "--overwrite").exit_code == 0


@pytest.mark.parametrize("link", ["same name", "hard link", "symbolic link"])
def test_an_input_is_never_overwritten(cli, fake, scans, tmp_path, no_reading, link):
    output = scans[0] if link == "same name" else tmp_path / "link.ply"
    if link == "hard link":
        os.link(scans[0], output)
    elif link == "symbolic link":
        output.symlink_to(scans[0])
    before = scans[0].read_bytes()
    result = cli("align", *scans, "--aligned", output, "--overwrite")
    assert result.exit_code == 5
    assert_one_line(result, str(output), "input")
    assert scans[0].read_bytes() == before


@pytest.mark.parametrize("entry", ["", "#1"])
def test_nor_is_the_file_that_the_initial_transformation_is_an_entry_of(
    cli, fake, scans, tmp_path, no_reading, entry
):
    rows = tmp_path / "poses.tum"
    rows.write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    result = cli("align", *scans, "--init", f"{rows}{entry}", "-o", rows, "--overwrite")
    assert result.exit_code == 5
    assert_one_line(result, str(rows), "input")


def test_one_file_for_two_outputs_is_refused(cli, fake, scans, tmp_path, no_reading):
    result = cli("align", *scans, "--aligned", tmp_path / "x.ply", "--merged", tmp_path / "." / "x.ply")
    assert result.exit_code == 5
    assert_one_line(result, "two outputs")


@pytest.mark.parametrize(
    "arguments",
    [
        ["-o", "T.xml"],
        ["-o", "T"],
        ["--aligned", "moved.pcd"],
        ["--merged", "merged.obj"],
        ["--points", "1"],
        ["--points", "many"],
        ["--solver", "magic"],
        ["--device", "abacus"],
        ["--threads", "-1"],
        ["--no-such-option"],
        ["third.ply"],
    ],
)
def test_bad_options_exit_2(cli, fake, scans, tmp_path, no_reading, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    before = snapshot(tmp_path)
    assert cli("align", *scans, *arguments).exit_code == 2
    assert snapshot(tmp_path) == before


@pytest.fixture
def full_disk(monkeypatch):
    """Let the disk run full at the sixth file flushed to it."""
    flushed = []

    def fsync(_):
        flushed.append(True)
        if len(flushed) == 6:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)


def test_when_one_file_cant_be_written_the_new_ones_go_again(cli, fake, scans, tmp_path, full_disk):
    before = snapshot(tmp_path)
    result = cli("align", *scans, "--out-dir", tmp_path / "out", "-o", tmp_path / "T.txt")
    assert result.exit_code == 5
    assert_one_line(result, "source_uncertainty.ply", "disk is full")
    assert snapshot(tmp_path) == before
    assert not (tmp_path / "out").exists()


def test_an_old_set_stays_whole_when_the_new_one_cant_be_written(cli, fake, scans, tmp_path, full_disk):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("transformation.txt", "aligned.ply", "source_overlap.ply", "report.json"):
        (out / name).write_text("precious")
    before = snapshot(out)
    assert cli("align", *scans, "--out-dir", out, "--overwrite").exit_code == 5
    assert snapshot(out) == before


def test_an_interrupt_between_two_files_leaves_nothing(cli, fake, scans, tmp_path, monkeypatch):
    linked, link = [], os.link

    def interrupted(*places):
        linked.append(places)
        if len(linked) == 3:
            raise KeyboardInterrupt
        link(*places)

    monkeypatch.setattr(os, "link", interrupted)
    before = snapshot(tmp_path)
    assert cli("align", *scans, "--clouds", tmp_path / "out", "-o", tmp_path / "T.txt").exit_code == 130
    assert len(linked) == 3
    assert snapshot(tmp_path) == before


def test_a_bug_of_ours_is_one_line_and_exit_1_and_debug_shows_where(cli, fake, scans):
    fake.raises = ValueError("first line\nsecond line")
    result = cli("align", *scans)
    assert result.exit_code == 1
    assert_one_line(result, "ValueError: first line second line", "bug", "--debug")
    with_traceback = cli("align", *scans, "--debug")
    assert with_traceback.exit_code == 1
    assert "Traceback" in with_traceback.stderr
    assert "conftest.py" in with_traceback.stderr


def test_an_interrupt_exits_130_and_leaves_nothing(cli, fake, scans, tmp_path):
    fake.raises = KeyboardInterrupt()
    result = cli("align", *scans, "--out-dir", tmp_path / "out")
    assert result.exit_code == 130
    assert_one_line(result, "interrupted")
    assert not (tmp_path / "out").exists()


class NobodyReads(io.StringIO):
    def write(self, text):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


@pytest.mark.parametrize("stdout", [None, NobodyReads()])
def test_a_matrix_that_nobody_reads_is_an_output_that_cant_be_written(monkeypatch, stdout):
    monkeypatch.setattr(sys, "stdout", stdout)
    with pytest.raises(OutputError, match=r"stdout: .*-o"):
        to_stdout(b"1 0 0 0\n")


def test_identity_sees_through_names(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    same = outputs._identity(tmp_path / "real" / "a.txt")
    assert outputs._identity(tmp_path / "link" / "a.txt") == same
    new = outputs._identity(tmp_path / "real" / "new.txt")
    assert outputs._identity(tmp_path / "link" / "new.txt") == new != same


def test_points_with_nan_are_dropped_and_said(cli, fake, tmp_path):
    rng = np.random.default_rng(1)
    points = [tuple(row) for row in rng.standard_normal((70, 3)).round(3).tolist()]
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_text(ply([*points, ("nan", "nan", "nan")]))
    result = cli("align", tmp_path / "a.ply", tmp_path / "b.ply")
    assert result.exit_code == 0, result.stderr
    assert len(fake.calls[0]["source"]) == 70
    assert "warning" in result.stderr


@pytest.mark.parametrize(
    ("option", "name", "code", "said"),
    [
        ("--html", "p.pdf", 2, "let the name end in .html"),
        ("--report", "r.html", 2, "let the name end in .json"),
        ("-o", "moved.ply", 2, "for the moved scan use --aligned"),
        ("-o", ".", 2, "is a folder; did you mean --out-dir?"),
        ("--out-dir", "b.ply", 5, "is a file; name a folder"),
        ("--clouds", "b.ply/c", 5, "can't be made"),
        ("--colormap", "foo", 2, "'--colormap': 'foo' is not one of"),
    ],
)
def test_a_wrong_name_is_told_before_any_work(cli, fake, scans, monkeypatch, option, name, code, said):
    monkeypatch.chdir(scans[0].parent)
    result = cli("align", *scans, option, name)
    assert result.exit_code == code
    assert_one_line(result, said)
    assert not fake.calls


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="no file system that takes no files")
def test_a_folder_that_takes_no_files_is_not_called_missing(cli, fake, scans):
    for option, name in (("-o", "/proc/x.txt"), ("--clouds", "/proc/x")):
        result = cli("align", *scans, option, name)
        assert result.exit_code == 5 and "does not exist" not in result.stderr
        assert not fake.calls


def test_a_missing_file_of_no_known_kind_is_called_missing(cli, fake, scans):
    result = cli("align", scans[0].with_suffix(".foo"), scans[1])
    assert result.exit_code == 4
    assert_one_line(result, "no such file")


def test_above_an_error_in_a_pipe_stands_no_step(cli, fake, scans, monkeypatch):
    monkeypatch.setattr("utopic_cli.commands.console.SECONDS_BETWEEN_LINES", 0.0)
    fake.raises = InputError("a.ply: nothing follows from it")
    result = cli("align", *scans)
    assert result.exit_code == 4
    assert_one_line(result, "nothing follows from it")


def test_lengths_that_are_but_rounding_are_said_to_be_0(cli, fake, scans):
    near = np.eye(4)
    near[:3, 3] = 1e-17
    fake.changes = {
        "T_target_source": near,
        "fit": FitMeasures({"source": 1.0, "target": 1.0}, 1.0, 3e-17, {}, 0.1),
    }
    said = cli("align", *scans).stderr
    assert "residual 0 file units" in said and "moves by 0 file units" in said


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes")
def test_a_name_that_is_no_utf8_is_printed_by_its_bytes(cli, fake, scans, tmp_path):
    odd = scans[0].rename(tmp_path / "caf\udce9.ply")
    result = cli("align", odd, scans[1], "--html", tmp_path / "p.html")
    assert result.exit_code == 0 and "caf%E9.ply -> " in result.stderr
    assert "caf%E9.ply: no such file" in cli("align", tmp_path / "no" / odd.name, odd).stderr


def test_the_usage_line_names_arguments_plainly(cli):
    assert "[OPTIONS] SOURCE TARGET" in cli("align", "--help").stdout
    assert "[OPTIONS] INPUT... " in cli("batch", "--help").stdout
