"""Results onto disk: atomically, with clear refusals, leaving nothing behind."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from utopic_cli.errors import OutputError
from utopic_cli.io.output import check_writable, write_atomically


def test_writes_and_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "T.txt"
    check_writable([path], overwrite=False)
    assert list(tmp_path.iterdir()) == []
    write_atomically(path, b"one", overwrite=False)
    for attempt in (
        lambda: check_writable([path], overwrite=False),
        lambda: write_atomically(path, b"two", overwrite=False),
    ):
        with pytest.raises(OutputError, match="exists already; pass --overwrite"):
            attempt()
    assert path.read_bytes() == b"one"
    check_writable([path], overwrite=True)
    write_atomically(path, b"two", overwrite=True)
    assert path.read_bytes() == b"two"
    assert [p.name for p in tmp_path.iterdir()] == ["T.txt"]


def test_permissions_follow_the_umask_and_the_old_file(tmp_path: Path) -> None:
    old = os.umask(0o027)
    try:
        write_atomically(tmp_path / "a", b"", overwrite=False)
    finally:
        os.umask(old)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640
    (tmp_path / "a").chmod(0o604)
    write_atomically(tmp_path / "a", b"x", overwrite=True)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o604


def test_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_atomically(tmp_path / "link", b"x", overwrite=False)
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_bytes() == b"x"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("missing/T.txt", "folder does not exist"),
        ("file/T.txt", "not a folder"),
        ("folder", "is a directory"),
        ("pipe", "not a regular file"),
        ("x" * 300, "too long"),
        ("a\0b", "can't be written"),
    ],
)
@pytest.mark.parametrize("overwrite", [False, True])
def test_impossible_places(tmp_path: Path, name: str, reason: str, overwrite: bool) -> None:
    (tmp_path / "file").write_bytes(b"kept")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    before = sorted(tmp_path.rglob("*"))
    if len(name) < 300:  # an overlong name shows only when it is given
        with pytest.raises(OutputError, match=reason):
            check_writable([tmp_path / name], overwrite)
    with pytest.raises(OutputError, match=reason):
        write_atomically(tmp_path / name, b"x", overwrite=overwrite)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "file").read_bytes() == b"kept"


def test_unwritable_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    try:
        if os.access(tmp_path, os.W_OK):
            pytest.skip("this user may write anywhere")
        with pytest.raises(OutputError, match="not writable"):
            check_writable([tmp_path / "T.txt"], overwrite=False)
    finally:
        tmp_path.chmod(0o755)


def test_two_outputs_in_one_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="two outputs"):
        check_writable([tmp_path / "a", tmp_path / "." / "a"], overwrite=True)


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_failure_at_any_step_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, failure: BaseException
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def fail(*_: object) -> None:
        raise failure

    monkeypatch.setattr(os, step, fail)
    expected = OutputError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected, match="disk is full" if expected is OutputError else None):
        write_atomically(path, b"new", overwrite=True)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
