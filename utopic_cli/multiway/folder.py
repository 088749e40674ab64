"""The folder of a batch: what may be in it before, and what its results are called."""

from __future__ import annotations

from pathlib import Path

from utopic_cli.errors import OutputError
from utopic_cli.multiway.journal import KINDS


def merged_name(group: int) -> str:
    """Return the file name of a group's merged cloud; groups count from 1."""
    return "merged.ply" if group == 1 else f"merged-{group}.ply"


def make_folder(folder: Path) -> None:
    """Make a folder whose parent exists, unless it is there.

    Raises:
        OutputError: it can't be made.
    """
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: the folder can't be made ({error.strerror})") from None


def earlier(out: Path) -> list[Path]:
    """Return what an earlier batch left: its records, then its results."""
    return [path for kind in KINDS for path in (out / kind).glob("*.json")] + results(out)


def check_earlier(out: Path) -> None:
    """Refuse to mix with an earlier batch.

    Raises:
        OutputError: there is one.
    """
    if earlier(out):
        raise OutputError(
            f"{out}: holds an earlier batch; pass --resume to go on with it or --overwrite to begin anew"
        )


def sweep(out: Path) -> None:
    """Remove what a batch that was killed had begun to write; under the lock it is nobody else's."""
    for folder in (out, *(out / kind for kind in KINDS)):
        for path in folder.glob(".utopic-*.tmp"):
            path.unlink(missing_ok=True)


def results(out: Path) -> list[Path]:
    """Return the results that are in a folder."""
    names = ("poses.json", "poses.txt", "poses.csv", "summary.csv", "report.html", "merged.ply")
    return [path for path in (*(out / name for name in names), *out.glob("merged-*.ply")) if path.is_file()]
