from __future__ import annotations

import errno

import pytest

from utopic_cli.errors import OutputError
from utopic_cli.io.output import open_atomically


def test_a_stream_takes_its_place_when_it_is_whole(tmp_path):
    path = tmp_path / "a.bin"
    with open_atomically(path, overwrite=False) as stream:
        stream.write(b"0 rest")
        assert not path.exists()
        stream.seek(0)
        stream.write(b"1")
    assert path.read_bytes() == b"1 rest"


def test_what_is_there_stays_where_a_stream_breaks_off(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(OutputError, match="exists already"), open_atomically(path, overwrite=False):
        pass
    with (
        pytest.raises(OutputError, match="the disk is full"),
        open_atomically(path, overwrite=True) as stream,
    ):
        stream.write(b"new")
        raise OSError(errno.ENOSPC, "no space")
    with pytest.raises(KeyboardInterrupt), open_atomically(path, overwrite=True):
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]
