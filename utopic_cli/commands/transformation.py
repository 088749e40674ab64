"""``utopic transformation``: composes, inverts and converts transformations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from utopic_cli.commands.console import WRITING, Console, Debug, Overwrite, Quiet, to_stdout
from utopic_cli.commands.outputs import OutputPlan, check_outputs, write_outputs
from utopic_cli.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from utopic_cli.io.transformation import Frames

Invert = Annotated[bool, typer.Option("--invert", help="Take the inverse of the whole product.")]
Form = Literal["matrix", "npy", "json", "pdal", "open3d", "kitti", "tum", "ros"]


def transformation(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="TRANSFORMATION...",
            help="Files of any form; FILE#ENTRY takes one of several (a scan's name, a row from 1).",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="Where to write; without it, to stdout.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    form: Annotated[
        Form | None,
        typer.Option(
            help="The form to write; without it, told by the output's name, or a 4x4 matrix.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    invert: Invert = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Compose, invert and convert transformations.

    T1 and T2 give [bold]T1 * T2[/bold]: the last one acts first.

    Reads and writes 4x4 text (.txt: CloudCompare, PDAL, NumPy), .npy, .json,
    PDAL pipelines (.pdal.json), Open3D logs (.log), KITTI rows (.kitti),
    TUM rows (.tum) and ROS messages (.yaml).
    Reads report.json, poses.json and Open3D's JSON too.

    Example: [bold]utopic transformation T1.txt T2.txt --invert -o T.json[/bold]
    """
    from utopic_cli.geometry.rigid import rotation_angle_deg
    from utopic_cli.io.transformation import SUFFIXES, form_of, format_transformation

    if output is not None and output.is_dir():
        raise UsageError(f"{output}: is a folder; name a file in it: -o {output / 'T.txt'}")
    wanted = form or (form_of(output) if output else "matrix")
    if wanted is None:
        raise UsageError(f"{output}: its name tells no form; use {', '.join(SUFFIXES)}, or --form")
    if wanted == "npy" and output is None:
        raise UsageError("npy is no text; name a file with -o")
    plan = OutputPlan(files=(("transformation", output),) if output else ())
    check_outputs(plan, files_behind(files), overwrite)
    product, frames = product_of(files, invert)
    content = format_transformation(product, wanted, frames)
    if output is None:
        to_stdout(content)
        return
    write_outputs(plan, {output: content}, overwrite)
    angle = rotation_angle_deg(product[:3, :3])
    shift = math.hypot(*product[:3, 3])
    turn = f"turns by {angle:.3f} degrees, then shifts by {shift:.6g}"
    Console(quiet=quiet).line(f"{output}: {turn}")


def files_behind(transformations: Sequence[Path]) -> list[Path]:
    """Return the files that are read for transformations, some of which may name an entry."""
    from utopic_cli.io.transformation import split_entry

    return [split_entry(path)[0] for path in transformations]


def product_of(transformations: Sequence[Path], invert: bool) -> tuple[np.ndarray, Frames]:
    """Return the (4, 4) product of transformation files in the order given, or its inverse, and its frames.

    Raises:
        InputError: a file can't be read, or is no rigid transformation.
    """
    from functools import reduce

    import numpy as np

    from utopic_cli.geometry import rigid
    from utopic_cli.io.transformation import UNNAMED, read_with_frames

    matrices, frames = zip(*map(read_with_frames, transformations), strict=True)
    product = reduce(np.matmul, matrices)
    target, source = frames[0][0], frames[-1][1]
    if not invert:
        return product, (target, source)
    # What has no names is called target and source whichever way it leads.
    return rigid.invert(product), UNNAMED if (target, source) == UNNAMED else (source, target)
