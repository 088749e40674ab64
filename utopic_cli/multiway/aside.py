"""What lies in a folder beside the scans and is none: said in a line, and not taken."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from utopic_cli.io.files import printable
from utopic_cli.io.glance import problem_at_start, read_start
from utopic_cli.io.pose_rows import poses_in
from utopic_cli.io.scan import SUFFIXES, TEXTS
from utopic_cli.io.text import mostly_numbers

DOUBTFUL_SUFFIXES = (".txt", ".csv")
"""In a folder, files of these kinds may well be no scans: one that isn't is passed over."""

NAMES_SAID = 3
_MADE_HERE = "made by utopic"
_MERGED = re.compile(r"merged(-\d+)?\.ply")
_COLOURED = re.compile(r"(source|target)_(overlap|uncertainty)\.ply")
_OUR_COMMENT = re.compile(rb"\ncomment utopic (merged scans|(source|target) (overlap|uncertainty)):?[ \r\n]")
_BESIDE_ALIGNED = ("transformation.txt", "report.json")


@dataclass(frozen=True)
class Aside:
    """A file that is no scan.

    Attributes:
        path: the file.
        reason: what it is, or lacks, in few words.
    """

    path: Path
    reason: str


def why_no_scan(path: Path) -> str | None:
    """Tell by name and beginning why a file that nobody named is no scan; None if it may be one.

    Args:
        path: a file in a folder of scans.
    """
    kind = path.suffix.lower()[1:]
    if path.suffix.lower() not in SUFFIXES:
        return "no scan format"
    if path.stem == "aligned" and any((path.parent / name).is_file() for name in _BESIDE_ALIGNED):
        return _MADE_HERE
    ours = _MERGED.fullmatch(path.name) or _COLOURED.fullmatch(path.name)
    if not path.is_file() or not (ours or kind in TEXTS):
        return None
    try:
        start, size = read_start(path)
    except OSError:  # that is said of the scan
        return None
    if ours:
        return _MADE_HERE if _OUR_COMMENT.search(start) else None
    if poses_in(start) is not None:
        return "poses, not points"
    prose = path.suffix.lower() in DOUBTFUL_SUFFIXES and size and not mostly_numbers(start)
    return "text without points" if prose and problem_at_start(start, size, kind) else None


def scans_below(folder: Path) -> str | None:
    """Say in a line which sub-folders hold scans, none of which are taken; None if none does.

    Args:
        folder: a folder of scans.
    """
    try:
        inside = sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
    except OSError:  # that is said of the folder itself
        return None
    names = [path.name for path in inside if _holds_scan(path)]
    if not names:
        return None
    shown = printable(", ".join([*names[:NAMES_SAID], *["..."] * (len(names) > NAMES_SAID)]))
    return (
        f"{folder}: sub-folders are not looked into; scans lie in {len(names)} ({shown}): name these as well"
    )


def _holds_scan(folder: Path) -> bool:
    try:
        return any(
            path.suffix.lower() in SUFFIXES
            and path.suffix.lower() not in DOUBTFUL_SUFFIXES
            and path.is_file()
            and why_no_scan(path) is None
            for path in folder.iterdir()
        )
    except OSError:
        return False


def said_of(place: Path, aside: Sequence[Aside]) -> str:
    """Return in a line what of a folder or pattern is not taken, and why."""
    by_reason: dict[str, list[str]] = {}
    for one in aside:
        by_reason.setdefault(one.reason, []).append(one.path.name)
    parts = []
    left = NAMES_SAID
    for reason, names in by_reason.items():
        shown = ", ".join([*names[:left], *["..."] * (len(names) > left)])
        parts.append(f"{reason}: {len(names)}" + (f" ({printable(shown)})" if left else ""))
        left = max(0, left - len(names))
    count = "1 file is no scan" if len(aside) == 1 else f"{len(aside)} files are no scans"
    return f"{place}: {count} and left out: {'; '.join(parts)}"
