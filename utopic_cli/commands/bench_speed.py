"""``utopic bench speed``: time and memory by number of points."""

from __future__ import annotations

from typing import Annotated

import typer

from utopic_cli.commands.bench_options import (
    Baselines,
    Common,
    Data,
    countdown,
    names,
    open_data,
    table_console,
    with_common_options,
)
from utopic_cli.commands.console import DEFAULTS, MEASURING, Console, Weights
from utopic_cli.errors import UsageError


@with_common_options
def speed(
    asked: Common,
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
    batches: Annotated[
        str,
        typer.Option(
            metavar="N,..",
            help="Pairs that the network sees at once, one case each.",
            rich_help_panel=MEASURING,
        ),
    ] = "1,4",
    weights: Weights = DEFAULTS.weights,
    baselines: Baselines = "",
) -> None:
    """Time and peak memory of the network and of a whole alignment, on one CPU thread and on CUDA.

    With --device auto both are measured where there is CUDA. Do nothing else on the machine meanwhile.

    Example: [bold]utopic bench speed --points 717,1024 --json speed.json[/bold]
    """
    asked.outputs.check()
    sizes, together = _numbers("--points", points), _numbers("--batches", batches)
    console = Console(quiet=asked.quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.reports import render
        from utopic_cli.benchmark.speed import run

        shapes = open_data(data, step)
        step("making pairs")
        report = run(
            shapes,
            data,
            pairs,
            asked.seed,
            weights,
            sizes,
            together,
            names(baselines),
            asked.device,
            countdown(step),
        )
    asked.outputs.write(report, console)
    render(report, table_console())


def _numbers(option: str, text: str) -> list[int]:
    try:
        return [int(number) for number in names(text)]
    except ValueError as error:
        raise UsageError(f"{option} {text}: give whole numbers with commas between them") from error
