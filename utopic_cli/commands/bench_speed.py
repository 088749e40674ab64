"""``utopic bench speed``: time and memory by number of points."""

from __future__ import annotations

from typing import Annotated

import typer

from utopic_cli.commands.bench import TABLE_WIDTH, Data, HtmlOut, JsonOut, Outputs, countdown, names
from utopic_cli.commands.console import Console, Debug, Device, Overwrite, Quiet, Seed, Weights
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError

_DEFAULTS = AlignOptions()


def speed(
    data: Data = "procedural",
    pairs: Annotated[int, typer.Option(min=1, help="Pairs that each case is measured on.")] = 3,
    points: Annotated[
        str, typer.Option(metavar="N,..", help="Most points per cloud that the network sees, one case each.")
    ] = "512,717,1024,2048,5000",
    weights: Weights = _DEFAULTS.weights,
    baselines: Annotated[
        str,
        typer.Option(
            metavar="NAME,..",
            help="Measure on the same pairs: open3d-ransac, open3d-ransac-fine, open3d-fgr, kiss-matcher.",
        ),
    ] = "",
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Time and peak memory of the network and of a whole alignment, on one CPU thread and on CUDA.

    With --device auto both are measured where there is CUDA. Do nothing else on the machine meanwhile.
    """
    outputs = Outputs(json_out, html_out, overwrite)
    outputs.check()
    try:
        sizes = [int(size) for size in names(points)]
    except ValueError as error:
        raise UsageError(f"--points {points}: give whole numbers with commas between them") from error
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.speed import run
        from utopic_cli.benchmark.speed_report import render
        from utopic_cli.synthesis.packing import open_shapes

        step("making shapes" if data == "procedural" else f"reading shapes from {data}")
        shapes = open_shapes(data, progress=countdown(step))
        step("making pairs")
        report = run(shapes, data, pairs, seed, weights, sizes, names(baselines), device, countdown(step))
    outputs.write(report, console)
    from rich.console import Console as RichConsole

    out = RichConsole()
    # A file or a pipe has no width: the tables get theirs.
    render(report, out if out.is_terminal else RichConsole(width=TABLE_WIDTH))
