"""``utopic bench speed``: time and memory by number of points."""

from __future__ import annotations

from typing import Annotated

import typer

from utopic_cli.commands.bench_options import (
    Baselines,
    Data,
    HtmlOut,
    JsonOut,
    Outputs,
    countdown,
    names,
    open_data,
    table_console,
)
from utopic_cli.commands.console import MEASURING, Console, Debug, Device, Overwrite, Quiet, Seed, Weights
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError

_DEFAULTS = AlignOptions()


def speed(
    data: Data = "procedural",
    pairs: Annotated[
        int, typer.Option(min=1, help="Pairs that each case is measured on.", rich_help_panel=MEASURING)
    ] = 3,
    points: Annotated[
        str,
        typer.Option(
            metavar="N,..",
            help="Most points per cloud that the network sees, one case each.",
            rich_help_panel=MEASURING,
        ),
    ] = "512,717,1024,2048,5000",
    weights: Weights = _DEFAULTS.weights,
    baselines: Baselines = "",
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

    Example: [bold]utopic bench speed --points 717,1024 --json speed.json[/bold]
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

        shapes = open_data(data, step)
        step("making pairs")
        report = run(shapes, data, pairs, seed, weights, sizes, names(baselines), device, countdown(step))
    outputs.write(report, console)
    render(report, table_console())
