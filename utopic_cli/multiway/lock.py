"""One batch at a time in a folder."""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from utopic_cli.errors import OutputError

NAME = ".utopic-batch.lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other batches out of a folder while the block runs.

    The operating system holds the lock and drops it with the process, however that ends: a file
    left behind by a killed batch locks nothing. Its content (process and host) is for people.

    Raises:
        OutputError: another batch is at work there, or the folder can't be written.
    """
    path = folder / NAME
    try:
        stream = _acquired(path)
    except OSError as error:
        raise OutputError(f"{path}: can't be written ({error.strerror}); choose another folder") from None
    try:
        yield
    finally:
        # Before the lock is dropped, so that nobody can hold a lock on a file without a name.
        if sys.platform != "win32":
            with suppress(OSError):
                path.unlink()
        stream.close()


def _acquired(path: Path) -> IO[bytes]:
    while True:
        stream = open(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b")  # noqa: SIM115 (held open)
        try:
            _take(stream)
        except OSError:
            holder = _holder(path)
            stream.close()
            raise OutputError(
                f"{path.parent}: another batch is at work there ({holder}); wait, or choose another folder"
            ) from None
        try:
            same = os.path.samestat(os.fstat(stream.fileno()), os.stat(path))
        except FileNotFoundError:
            same = False
        if same:
            break
        stream.close()  # the one before us has just finished and taken its file away
    stream.truncate(0)
    stream.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode("ascii"))
    stream.flush()
    return stream


def _take(stream: IO[bytes]) -> None:
    if sys.platform == "win32":
        import msvcrt

        stream.seek(1 << 20)  # beyond the content, which others may read
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        stream.seek(0)
    else:
        import fcntl

        fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def _holder(path: Path) -> str:
    try:
        content = json.loads(path.read_bytes())
        return f"process {int(content['pid'])} on {str(content['host'])[:80]}"
    except (OSError, ValueError, KeyError, TypeError):
        return "it has just started"
