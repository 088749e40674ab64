"""Input files as bytes: regular files only, opened so that a FIFO or device never blocks."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from utopic_cli.errors import InputError

EMPTY = "the file is empty; export or copy it again"
_OPEN_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def read_bytes(path: Path) -> bytes:
    """Return the whole content of a regular, non-empty file.

    Args:
        path: the file; symbolic links are followed.

    Raises:
        InputError: missing, a directory, not a regular file, unreadable or empty. One line:
            the file, the reason and what to do.
    """
    try:
        # Asked before opening: opening some devices has side effects.
        _require_regular(path, os.stat(path).st_mode)
        with open(os.open(path, _OPEN_FLAGS), "rb") as stream:
            # Asked again of the open file, which may have been swapped meanwhile.
            _require_regular(path, os.fstat(stream.fileno()).st_mode)
            data = stream.read()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check the path and its permissions") from None
    if not data:
        raise InputError(f"{path}: {EMPTY}")
    return data


def printable(text: str) -> str:
    """Return text that any terminal and file takes: bytes of a file's name that are no UTF-8 as %E9."""
    # They arrive as lone surrogates.
    return re.sub("[\ud800-\udfff]", lambda found: f"%{ord(found[0]) & 0xFF:02X}", text)


def _require_regular(path: Path, mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise InputError(f"{path}: is a directory; name a file in it")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: is not a regular file (a pipe or device); save it to a file first")
