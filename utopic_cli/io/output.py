"""Results onto disk: whole or not at all, and nothing existing is lost."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from utopic_cli.errors import OutputError

_REASONS = {
    errno.ENOENT: "its folder does not exist; create the folder first",
    errno.ENOTDIR: "its folder is not a folder; choose another place",
    errno.EACCES: "its folder is not writable; choose another place",
    errno.EPERM: "its folder is not writable; choose another place",
    errno.EROFS: "its folder is read-only; choose another place",
    errno.ENOSPC: "the disk is full; free some space",
    getattr(errno, "EDQUOT", -1): "your disk quota is used up; free some space",
    errno.EFBIG: "it is larger than the file system allows; choose another place",
    errno.ENAMETOOLONG: "its name is too long; choose a shorter one",
    errno.EEXIST: "exists already; pass --overwrite to replace it",
}


def check_writable(paths: Iterable[str | os.PathLike[str]], overwrite: bool) -> None:
    """Make sure, before any work, that files can be written; leaves nothing behind.

    Args:
        paths: files to be written later.
        overwrite: whether existing files may be replaced.

    Raises:
        OutputError: two paths are the same file, one exists (without ``overwrite``) or is
            no regular file, or its folder is missing or not writable.
    """
    seen: set[Path] = set()
    folders: set[Path] = set()
    for path in map(Path, paths):
        target = _check_target(path, overwrite)
        if target in seen:
            raise OutputError(f"{path}: two outputs would be written to this file; name another")
        seen.add(target)
        if target.parent in folders:
            continue
        folders.add(target.parent)
        try:  # only trying tells: permissions say nothing of read-only or network file systems
            probe = _temporary(target)
            os.close(_create(probe))
            probe.unlink()
        except OSError as error:
            raise _explained(path, error) from None


def check_folder(folder: Path) -> None:
    """Make sure, before any work, that a folder is there or can be made; leaves nothing behind.

    Args:
        folder: only it may be missing, not the folder it lies in.

    Raises:
        OutputError: it is a file or can't be made.
    """
    try:
        if not stat.S_ISDIR(folder.stat().st_mode):
            raise OutputError(f"{folder}: is a file; name a folder")
        return
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        raise _cant_be_made(folder, error) from None
    if folder.is_symlink():
        raise OutputError(f"{folder}: is a link to nothing; make the folder it names, or name another")
    if not folder.parent.is_dir():
        raise OutputError(f"{folder}: the folder {folder.parent} does not exist; make it first")
    try:  # under another name: the folder itself may be what another run is about to make
        probe = _temporary(folder)
        probe.mkdir()
        probe.rmdir()
    except OSError as error:
        raise _cant_be_made(folder, error) from None


def _cant_be_made(folder: Path, error: OSError | ValueError) -> OutputError:
    return OutputError(f"{folder}: can't be made ({_system_says(error)}); choose another place")


def write_atomically(path: str | os.PathLike[str], data: bytes, *, overwrite: bool) -> None:
    """Write a file whole or not at all, even if interrupted or out of space.

    A temporary file in the same folder is written, flushed to the disk and renamed.

    Raises:
        OutputError: the file exists (without ``overwrite``) or can't be written.
    """
    write_together({Path(path): data}, overwrite=overwrite)


def write_together(contents: Mapping[Path, bytes], *, overwrite: bool) -> tuple[Path, ...]:
    """Write several files, all or none: no file takes its place before every one is on the disk.

    Args:
        contents: bytes by path; the files take their places in this order.
        overwrite: whether existing files may be replaced.

    Returns:
        The files that did not exist before, links followed.

    Raises:
        OutputError: a file exists (without ``overwrite``) or can't be written; then none of
            those that did not exist before is left.
    """
    temporaries: dict[Path, Path] = {}
    new: list[Path] = []
    path = Path()
    try:
        for path, data in contents.items():
            temporaries[path] = _temporary(_check_target(path, overwrite))
            with open(_create(temporaries[path]), "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
        for path, temporary in temporaries.items():
            target = _check_target(path, overwrite)
            existed = target.exists()
            if existed:
                os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))
            if overwrite:
                os.replace(temporary, target)
            else:
                _rename_to_new(temporary, target)
            if not existed:
                new.append(target)
    except BaseException as error:
        for target in new:
            target.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _explained(path, error) from None
        raise
    finally:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)
    return tuple(new)


@contextmanager
def open_atomically(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[BinaryIO]:
    """Write a file too large to be made in memory, whole or not at all.

    Yields:
        A stream to write; the file takes its place when the block ends without an error.

    Raises:
        OutputError: the file exists (without ``overwrite``) or can't be written.
    """
    path = Path(path)
    temporary = _temporary(_check_target(path, overwrite))
    try:
        with open(_create(temporary), "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        target = _check_target(path, overwrite)
        if overwrite:
            os.replace(temporary, target)
        else:
            _rename_to_new(temporary, target)
    except OSError as error:
        raise _explained(path, error) from None
    finally:
        temporary.unlink(missing_ok=True)


def _check_target(path: Path, overwrite: bool) -> Path:
    """Return where the file really goes (links followed), or say why it can't."""
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    except (OSError, ValueError) as error:
        raise _explained(path, error) from None
    if stat.S_ISDIR(mode):
        raise OutputError(f"{path}: is a directory; name a file")
    if not stat.S_ISREG(mode):
        raise OutputError(f"{path}: is not a regular file (a pipe or device); name a file")
    if not overwrite:
        raise OutputError(f"{path}: exists already; pass --overwrite to replace it")
    return target


def _temporary(target: Path) -> Path:
    # Short, so that a name near the system's limit still fits.
    return target.with_name(f".utopic-{secrets.token_hex(8)}.tmp")


def _create(path: Path) -> int:
    # Not tempfile: its files are private (0600), where a result should follow the umask.
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)


def _rename_to_new(temporary: Path, target: Path) -> None:
    """Give a file its name only if the name is still free."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links: the best there is
        if target.exists():
            raise FileExistsError(errno.EEXIST, "exists") from None
        os.rename(temporary, target)


def _explained(path: Path, error: OSError | ValueError) -> OutputError:
    number = error.errno if isinstance(error, OSError) else None
    reason = _REASONS.get(number or 0)
    # Some file systems say ENOENT of a folder that exists but takes no files.
    if reason is None or (number == errno.ENOENT and os.path.isdir(os.path.dirname(os.path.realpath(path)))):
        reason = f"can't be written ({_system_says(error)}); choose another place"
    return OutputError(f"{path}: {reason}")


def _system_says(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
