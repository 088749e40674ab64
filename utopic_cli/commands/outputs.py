"""The files one alignment leaves: where each goes, whether it may go there, what is in it.

Everything is decided and checked before any work, made in memory, and only then written; the
report comes last, so that a set with a report is a whole set.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from utopic_cli.errors import OutputError, UsageError

if TYPE_CHECKING:
    import numpy as np

    from utopic_cli.config import ColourMapName
    from utopic_cli.io.scan import Scan
    from utopic_cli.result import RegistrationResult

MERGED_COMMENTS = ("utopic merged scans in the target's frame: scan 0 = source, 1 = target",)
CLOUD_KINDS = ("source_overlap", "target_overlap", "source_uncertainty", "target_uncertainty")


@dataclass(frozen=True)
class OutputPlan:
    """The files asked for.

    Attributes:
        files: (kind, path) in the order of writing; a kind is ``transformation``, ``aligned``,
            ``merged``, one of ``CLOUD_KINDS``, ``html`` or ``report``, and may come twice.
        folders: folders of whole sets, made if only they themselves are missing.
    """

    files: tuple[tuple[str, Path], ...]
    folders: tuple[Path, ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The paths of all files, in the order of writing."""
        return tuple(path for _, path in self.files)


def plan_outputs(
    source: Path,
    *,
    output: Path | None = None,
    out_dir: Path | None = None,
    aligned: Path | None = None,
    merged: Path | None = None,
    clouds: Path | None = None,
    report: Path | None = None,
    page: Path | None = None,
) -> OutputPlan:
    """Turn the output options into a list of files.

    Raises:
        UsageError: a suffix names a format that the output can't have.
    """
    from utopic_cli.io.transformation import SUFFIXES, form_of

    if output is not None and form_of(output) is None:
        if output.is_dir():
            raise UsageError(f"{output}: is a folder; did you mean --out-dir?")
        known = ", ".join(SUFFIXES)
        moved = "; for the moved scan use --aligned" if output.suffix.lower() == source.suffix.lower() else ""
        raise UsageError(
            f"{output}: the transformation's form is told by its suffix; use one of {known}{moved}"
        )
    if aligned is not None and aligned.suffix.lower() != source.suffix.lower():
        raise UsageError(
            f"{aligned}: --aligned keeps the source's format; let the name end in '{source.suffix}'"
        )
    if merged is not None and merged.suffix.lower() != ".ply":
        raise UsageError(f"{merged}: --merged is written as PLY; let the name end in .ply")
    if page is not None and page.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{page}: --html writes a page; let the name end in .html")
    if report is not None and report.suffix.lower() != ".json":
        raise UsageError(f"{report}: --report is written as JSON; let the name end in .json")
    files = [("transformation", output), ("aligned", aligned), ("merged", merged)]
    if out_dir is not None:
        files.append(("transformation", out_dir / "transformation.txt"))
        files.append(("aligned", out_dir / f"aligned{source.suffix}"))
    sets = [folder for folder in (clouds, out_dir) if folder is not None]
    files += [(kind, folder / f"{kind}.ply") for folder in sets for kind in CLOUD_KINDS]
    files += [("html", page), ("html", out_dir / "report.html" if out_dir else None)]
    files += [("report", report), ("report", out_dir / "report.json" if out_dir else None)]
    return OutputPlan(
        files=tuple((kind, path) for kind, path in files if path is not None),
        folders=tuple(dict.fromkeys(sets)),
    )


def check_outputs(plan: OutputPlan, inputs: Iterable[Path], overwrite: bool) -> None:
    """Refuse, before any work, what could not be written afterwards or would destroy something.

    Args:
        plan: the files asked for.
        inputs: files that are read in the same run; they are never written to, whatever is said.
        overwrite: whether existing files may be replaced.

    Raises:
        OutputError: an output is also an input or named twice, exists and may not be replaced, or
            its folder is missing or not writable.
    """
    from utopic_cli.io.output import check_folder, check_writable

    read = {_identity(path): path for path in inputs}
    seen: set[Any] = set()
    for path in plan.paths:
        identity = _identity(path)
        if identity in read:
            raise OutputError(f"{path}: is an input of this run; inputs are never overwritten")
        if identity in seen:
            raise OutputError(f"{path}: named for two outputs; give each its own file")
        seen.add(identity)
    for folder in plan.folders:
        check_folder(folder)
    missing = [folder for folder in plan.folders if not folder.exists()]
    check_writable([path for path in plan.paths if path.parent not in missing], overwrite)


def _identity(path: Path) -> Any:
    """Tell files apart whatever they are called: links to one file are the same file."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return os.path.realpath(path)
    return status.st_dev, status.st_ino


def write_answer(
    plan: OutputPlan,
    source: Scan,
    target: Scan,
    result: RegistrationResult,
    *,
    colormap: ColourMapName,
    overwrite: bool,
    timings_s: dict[str, float] | None = None,
) -> dict[str, Any]:
    """Make and write every file in the plan.

    Args:
        plan: the files asked for.
        source: the scan that moves.
        target: the scan that stays.
        result: the answer, its arrays those of the scans' points.
        colormap: the colours of overlap and uncertainty.
        overwrite: whether existing files may be replaced.
        timings_s: seconds of steps outside the pipeline.

    Returns:
        The report. Its warnings say as well what the coloured clouds could not keep.

    Raises:
        InputError: a scan's file can't be read again, or has changed.
        OutputError: a file can't be written.
    """
    from utopic_cli.report import build_report, report_bytes

    source, of_source = _with_kept(plan, "source", source)
    target, of_target = _with_kept(plan, "target", target)
    report = build_report(source, target, result, timings_s)
    kept = {"source": of_source, "target": of_target}
    write_outputs(
        plan, _contents(plan, source, target, result, report_bytes(report), kept, colormap), overwrite
    )
    return report


def _with_kept(plan: OutputPlan, side: str, scan: Scan) -> tuple[Scan, dict[str, np.ndarray]]:
    """Return what a scan's coloured clouds keep of its file; a warning of the scan says what they can't."""
    from utopic_cli.commands.kept_fields import kept_fields

    if not any(kind.startswith(f"{side}_") for kind, _ in plan.files):
        return scan, {}
    kept, lost = kept_fields(scan)
    return (replace(scan, warnings=(*scan.warnings, lost)) if lost else scan), kept


def _contents(
    plan: OutputPlan,
    source: Scan,
    target: Scan,
    result: RegistrationResult,
    report: bytes,
    kept: Mapping[str, Mapping[str, np.ndarray]],
    colormap: ColourMapName,
) -> dict[Path, bytes]:
    """Make the content of every file in the plan, by path, in the order of writing."""
    from utopic_cli.io.ply_writer import merged_cloud_ply
    from utopic_cli.io.transformation import form_of, format_transformation

    contents: dict[Path, bytes] = {}
    for kind, path in plan.files:
        if kind == "transformation":
            contents[path] = format_transformation(result.T_target_source, form_of(path) or "matrix")
        elif kind == "aligned":
            contents[path] = source.moved(result.T_target_source)
        elif kind == "merged":
            moved = source.cloud.transformed(result.T_target_source)
            contents[path] = merged_cloud_ply(moved.points, target.cloud.points, MERGED_COMMENTS)
        elif kind == "html":
            contents[path] = page_of(source, target, result, colormap)
        elif kind == "report":
            contents[path] = report
        else:
            side = kind.split("_")[0]
            contents[path] = coloured_cloud(kind, source, target, result, kept[side], colormap)
    return contents


def page_of(source: Scan, target: Scan, result: RegistrationResult, colormap: ColourMapName) -> bytes:
    """Return the self-contained HTML page of one alignment."""
    from utopic_cli import page
    from utopic_cli.report import all_warnings

    return page.render(
        result,
        source.cloud,
        target.cloud,
        source_name=source.path.name,
        target_name=target.path.name,
        warnings=all_warnings(source, target),
        colormap=colormap,
    ).encode("utf-8")


def coloured_cloud(
    kind: str,
    source: Scan,
    target: Scan,
    result: RegistrationResult,
    kept: Mapping[str, np.ndarray],
    colormap: ColourMapName,
) -> bytes:
    """Return a scan's points with overlap and uncertainty as scalar fields, coloured by one of them.

    Args:
        kind: ``source_overlap`` and so on: which scan, and which field gives the colour.
        source: the scan that moves; its points are written where the file has them, not moved.
        target: the scan that stays.
        result: the answer.
        kept: further fields of the scan, name to (N,) values.
        colormap: the colours.
    """
    from utopic_cli.io.colour import COLOUR_MAPS, colour_map
    from utopic_cli.io.ply_writer import scalar_cloud_ply

    side, shown = kind.split("_")
    scan = source if side == "source" else target
    fields = {name: getattr(result, f"{side}_{name}") for name in ("overlap", "uncertainty")}
    meaning = "likely to overlap" if shown == "overlap" else "uncertain"
    comments = (
        f"utopic {side} {shown}: {COLOUR_MAPS[colormap].more} = more {meaning}",
        "points in the scan's own frame and units; original_*: as in the scan's file",
    )
    colours = colour_map(fields[shown], colormap)
    return scalar_cloud_ply(scan.cloud.points, colours, {**fields, **kept}, comments, shown)


def write_outputs(plan: OutputPlan, contents: dict[Path, bytes], overwrite: bool) -> ExitStack:
    """Write all files or none, the report last.

    Returns:
        What takes the new files and folders away again when it is closed, for callers whose
        files are worth nothing should a later step fail. Others let it go.

    Raises:
        OutputError: a folder can't be made or a file can't be written.
    """
    from utopic_cli.io.output import write_together

    with ExitStack() as undo:
        for folder in plan.folders:
            if not folder.exists():
                _make_folder(folder)
                undo.callback(_remove_if_empty, folder)
        for path in write_together(contents, overwrite=overwrite):
            undo.callback(path.unlink, missing_ok=True)
        return undo.pop_all()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: can't be made: {error.strerror}; choose another place") from error


def _remove_if_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()
