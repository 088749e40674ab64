"""Which files a batch is about, and under which names: distinct, plain, fit for file names."""

from __future__ import annotations

import glob
import hashlib
import os
import re
import stat
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from utopic_cli.errors import InputError
from utopic_cli.io.files import printable
from utopic_cli.io.scan import SUFFIXES

LONGEST_NAME = 80
"""Two names and ``--.json`` fit in any file system's file name."""

DOUBTFUL_SUFFIXES = (".txt", ".csv")
"""In a folder, files of these kinds may well be no scans: one that isn't is passed over."""

_BLOCK = 1 << 22


@dataclass(frozen=True)
class ScanFile:
    """One input file.

    Attributes:
        name: distinct among the batch's scans, printable, without ``--`` or separators.
        path: the file.
        sha256: of its bytes; empty if it could not be read.
        problem: why it could not be read, or None.
        copy_of: name of an earlier scan with the same bytes, or None.
        doubtful: found in a folder with a suffix that other files than scans have too.
    """

    name: str
    path: Path
    sha256: str
    problem: str | None = None
    copy_of: str | None = None
    doubtful: bool = False


@dataclass(frozen=True)
class ScanList:
    """The inputs of a batch, in natural order of their paths as given (``scan2`` before ``scan10``).

    Attributes:
        scans: every file once.
        notes: what a user should know: files given twice, copies, names that had to change.
    """

    scans: tuple[ScanFile, ...]
    notes: tuple[str, ...]


def find_scans(inputs: Sequence[Path]) -> ScanList:
    """Collect and hash the scan files of folders, patterns and paths.

    Args:
        inputs: a folder stands for the scan files in it (not in its subfolders); a path that does
            not exist is tried as a pattern; anything else is a file.

    Raises:
        InputError: an input does not exist, or there are fewer than two files.
    """
    found: list[tuple[Path, bool]] = []
    for given in inputs:
        found += _expanded(given)
    notes: list[str] = []
    once: dict[str, tuple[Path, bool]] = {}
    for path, doubtful in found:
        place = os.path.realpath(path)
        if place in once:
            notes.append(f"{path}: is given twice; it is used once")
        else:
            once[place] = (path, doubtful)
    if len(once) < 2:
        where = ", ".join(map(str, inputs))
        if once and not any(given.is_dir() for given in inputs):
            raise InputError(f"{where}: only one scan given; a batch needs at least two")
        count = "only one scan file" if once else "no scan files"
        raise InputError(f"{where}: holds {count}; a batch needs at least two ({' '.join(SUFFIXES)})")
    files = list(once.values())
    names = distinct_names([path for path, _ in files])
    scans: list[ScanFile] = []
    holders: dict[str, str] = {}
    for (path, doubtful), name in zip(files, names, strict=True):
        digest, problem = _hashed(path)
        copy_of = holders.get(digest) if digest else None
        if copy_of is not None:
            notes.append(f"{path}: is a copy of {copy_of}; it gets the same place")
        elif digest:
            holders[digest] = name
        if name != path.stem:
            notes.append(f"{path}: is called {name} here")
        scans.append(ScanFile(name, path, digest, problem, copy_of, doubtful))
    return ScanList(tuple(scans), tuple(notes))


def distinct_names(paths: Iterable[Path]) -> list[str]:
    """Return a distinct, plain name for each path: its stem where that will do.

    Names are distinct without regard to case, because some file systems have none. Of files with
    equal stems the first keeps the stem, the others add their suffix, or else a number.
    """
    names: list[str] = []
    taken: set[str] = set()
    for path in paths:
        stem = _plain(path.stem)
        choices = [stem, _plain(path.name)]
        choices += [f"{_cut(stem, LONGEST_NAME - 8)}-{number}" for number in range(2, len(taken) + 3)]
        name = next(choice for choice in choices if choice.casefold() not in taken)
        taken.add(name.casefold())
        names.append(name)
    return names


def natural_order(path: Path) -> tuple[object, ...]:
    """Return a sorting key by which ``scan2`` comes before ``scan10``."""
    parts = re.split(r"([0-9]+)", str(path))
    return (*((int(part), part) if i % 2 else (0, part) for i, part in enumerate(parts)),)


def _expanded(given: Path) -> list[tuple[Path, bool]]:
    if given.is_dir():
        try:
            inside = sorted((path for path in given.iterdir() if _is_scan(path)), key=natural_order)
        except OSError as error:
            raise InputError(f"{given}: can't be listed ({error.strerror}); check its permissions") from None
        return [(path, path.suffix.lower() in DOUBTFUL_SUFFIXES) for path in inside]
    if os.path.lexists(given):
        return [(given, False)]
    matching = [Path(path) for path in glob.glob(str(given), recursive=True)]
    if not matching:
        raise InputError(f"{given}: no such file or folder, and no file matches it; check the path")
    return [(path, False) for path in sorted(filter(_is_scan, matching), key=natural_order)]


def _is_scan(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and not path.is_dir()


def _plain(text: str) -> str:
    """Return a name that every file system and text file can hold."""
    text = "".join(c if c.isprintable() and c not in '<>:"/\\|?*' else "_" for c in printable(text))
    return re.sub("-{2,}", "-", _cut(text, LONGEST_NAME)).strip("-. ") or "scan"  # "--" joins two names


def _cut(text: str, most: int) -> str:
    """Return as much of a text's beginning as fits in so many bytes."""
    return text.encode()[:most].decode(errors="ignore")


def _hashed(path: Path) -> tuple[str, str | None]:
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            return "", f"{path}: is not a regular file (a pipe or device); save it to a file first"
        digest = hashlib.sha256()
        with open(path, "rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    except OSError as error:
        return "", f"{path}: can't be read ({error.strerror}); check the path and its permissions"
    return digest.hexdigest(), None
