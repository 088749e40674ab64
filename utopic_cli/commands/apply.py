"""``utopic apply``: moves a scan file by transformations that are known."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Annotated

import typer

from utopic_cli.commands.console import WRITING, Console, Debug, Overwrite, Quiet, Verbose
from utopic_cli.commands.outputs import OutputPlan, check_outputs, write_outputs
from utopic_cli.commands.transformation import Invert, files_behind, product_of
from utopic_cli.errors import InputError, UsageError


def apply(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="TRANSFORMATION... SCAN",
            help="One transformation or more, then the scan that moves.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="The moved scan, in the same format as SCAN.",
            show_default=False,
            rich_help_panel=WRITING,
        ),
    ],
    invert: Invert = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Move SCAN by one transformation, or by the product of several.

    With T1 and T2, every point p moves to [bold]T1 * T2 * p[/bold]: the one next to SCAN acts first.

    The file keeps its format and all in it; coordinates and normals change.
    Transformations come in any form that 'utopic transformation' reads.

    Example: [bold]utopic apply T1.txt T2.txt in.ply -o out.ply[/bold]
    """
    *transformations, path = files
    if not transformations:
        raise UsageError("give a transformation and a scan: utopic apply T.txt in.ply -o out.ply")
    _refuse_swapped(files, output)
    if output.is_dir():
        raise UsageError(f"{output}: is a folder; name a file in it: -o {output / path.name}")
    if output.suffix.lower() != path.suffix.lower():
        raise UsageError(f"{output}: the scan keeps its format; let the name end in '{path.suffix}'")
    plan = OutputPlan(files=(("aligned", output),))
    check_outputs(plan, [*files_behind(transformations), path], overwrite)
    console = Console(quiet=quiet, verbose=verbose)
    with console.progress() as progress:
        progress("loading libraries")
        from utopic_cli.io.scan import read_scan
        from utopic_cli.report import about_centroid

        _refuse_transformation(path)
        product, _ = product_of(transformations, invert)
        progress(f"reading {path.name}")
        scan = read_scan(path, to_align=False)
        progress(f"writing {output.name}")
        write_outputs(plan, {output: scan.moved(product)}, overwrite)
    console.warnings(tuple(f"{path}: {text}" for text in scan.warnings))
    moved = about_centroid(product, scan.cloud.points)
    shift = math.hypot(*moved["translation"])
    turn = f"turned by {moved['angle_deg']:.3f} degrees about its centroid"
    console.line(f"{path} -> {output}: {turn}, which moves by {shift:.6g} file units")


def _refuse_swapped(files: list[Path], output: Path) -> None:
    """Refuse a scan that comes before a transformation, as far as their names tell them apart."""
    from utopic_cli.io.scan import SUFFIXES
    from utopic_cli.io.transformation import form_of, split_entry

    first, *others = files
    last = others[-1]
    scan = first.suffix.lower() in SUFFIXES and form_of(first) is None
    if scan and form_of(split_entry(last)[0]) is not None and (last.suffix.lower() != ".txt" or _reads(last)):
        raise UsageError(
            f"{first} looks like a scan and {last} like a transformation, but the scan comes last:"
            f" utopic apply {shlex.join(map(str, (*others, first)))} -o {output}"
        )


def _refuse_transformation(path: Path) -> None:
    """Refuse a 4x4 in the place of the scan: its rows would pass for points."""
    if path.suffix.lower() == ".txt" and _reads(path):
        raise UsageError(
            f"{path}: is a transformation, but the last file is the scan that moves;"
            " 'utopic transformation' composes transformations"
        )


def _reads(path: Path) -> bool:
    """Tell whether a file reads as one transformation."""
    from utopic_cli.io.transformation import read_transformation

    try:
        read_transformation(path)
    except InputError:
        return False
    return True
