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
from utopic_cli.io.glance import problem_at_start, read_start
from utopic_cli.io.scan import SUFFIXES
from utopic_cli.multiway.aside import DOUBTFUL_SUFFIXES, Aside, said_of, scans_below, why_no_scan

LONGEST_NAME = 80
"""Two names and ``--.json`` fit in any file system's file name."""

_BLOCK = 1 << 22


@dataclass(frozen=True)
class ScanFile:
    """One input file.

    Attributes:
        name: distinct among the batch's scans, printable, without ``--`` or separators.
        path: the file.
        sha256: of its bytes; empty if it could not be read.
        problem: why it can't be read, as far as its beginning and size tell, or None.
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
        notes: what a user should know: files given twice, copies, names that had to change, files
            left out.
        aside: files of folders and patterns that are no scans.
    """

    scans: tuple[ScanFile, ...]
    notes: tuple[str, ...]
    aside: tuple[Aside, ...] = ()


def find_scans(inputs: Sequence[Path]) -> ScanList:
    """Collect and hash the scan files of folders, patterns and paths.

    Args:
        inputs: a folder stands for the scan files in it (not in its subfolders); a path that does
            not exist is tried as a pattern; anything else is a file. What is no scan by name or
            beginning is left out where nobody named it.

    Raises:
        InputError: an input does not exist, or there are fewer than two files.
    """
    found: list[tuple[Path, bool]] = []
    aside: list[Aside] = []
    notes: list[str] = []
    for given in inputs:
        taken, left = _expanded(given)
        found += taken
        aside += left
        if left:
            notes.append(said_of(given, left))
        below = scans_below(given) if given.is_dir() else None
        if below is not None:
            notes.append(below)
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
            (only,) = (path for path, _ in once.values())
            problem = _problem(only) if only.is_file() else None
            if problem is not None:
                reason = problem.removeprefix(f"{only}: ")
                raise InputError(f"{only}: is no scan ({reason}); a batch takes a folder or several scans")
            raise InputError(f"{where}: only one scan given; a batch needs at least two")
        count = "only one scan file" if once else "no scan files"
        needed = f"a batch needs at least two ({' '.join(SUFFIXES)})"
        raise InputError(" | ".join([f"{where}: holds {count}; {needed}", *notes]))
    files = list(once.values())
    names = distinct_names([path for path, _ in files])
    scans: list[ScanFile] = []
    holders: dict[str, str] = {}
    for (path, doubtful), name in zip(files, names, strict=True):
        digest, problem = _hashed(path)
        copy_of = holders.get(digest) if digest else None
        if copy_of is not None:
            notes.append(f"{path}: is a copy of {copy_of}; it gets the same place")
        elif problem is None:
            problem = _problem(path)
            if problem is None:
                holders[digest] = name
        if name != path.stem:
            notes.append(f"{path}: is called {name} here")
        # What can't even be opened may be a scan.
        scans.append(ScanFile(name, path, digest, problem, copy_of, doubtful and bool(digest)))
    return ScanList(tuple(scans), tuple(notes), tuple(aside))


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


def _expanded(given: Path) -> tuple[list[tuple[Path, bool]], list[Aside]]:
    """Return the files that an input stands for, whether each is doubtful, and what is left out."""
    folder = given.is_dir()
    if not folder and os.path.lexists(given):
        return [(given, False)], []
    try:
        inside = list(given.iterdir() if folder else map(Path, glob.glob(str(given), recursive=True)))
        files = sorted((path for path in inside if _is_seen(path)), key=natural_order)
    except OSError as error:
        raise InputError(f"{given}: can't be listed ({error.strerror}); check its permissions") from None
    if not (folder or inside):
        raise InputError(f"{given}: no such file or folder, and no file matches it; check the path")
    taken, aside = [], []
    for path in files:
        reason = why_no_scan(path)
        if reason is None:
            taken.append((path, folder and path.suffix.lower() in DOUBTFUL_SUFFIXES))
        else:
            aside.append(Aside(path, reason))
    return taken, aside


def _is_seen(path: Path) -> bool:
    return not path.name.startswith(".") and not path.is_dir()


def _problem(path: Path) -> str | None:
    """Tell what is wrong with a regular file, as far as that is seen at a glance."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        return f"{path}: is no known scan format; use one of {' '.join(SUFFIXES)}"
    try:
        problem = problem_at_start(*read_start(path), suffix[1:])
    except OSError as error:
        return _unread(path, error)
    return problem and f"{path}: {problem}"


def _unread(path: Path, error: OSError) -> str:
    return f"{path}: can't be read ({error.strerror}); check the path and its permissions"


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
        return "", _unread(path, error)
    return digest.hexdigest(), None
