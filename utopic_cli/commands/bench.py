"""``utopic bench``: the measurements behind the claims, one protocol a command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer.models import CommandInfo

from utopic_cli.commands.bench_options import (
    Baselines,
    HtmlOut,
    JsonOut,
    Outputs,
    countdown,
    names,
    table_console,
)
from utopic_cli.commands.console import (
    DEFAULTS,
    MEASURING,
    Console,
    Debug,
    Device,
    Overwrite,
    Quiet,
    Seed,
    Threads,
    Weights,
)
from utopic_cli.config import AlignOptions

bench = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")

PANELS = {
    "What to expect": ("scans", "range-scans", "rooms", "confidence", "batch", "speed"),
    "The paper's pairs": ("modelnet", "modelonet", "scanobjectnn", "detail", "overlap-sweep"),
    "Robustness": ("noise", "density", "outliers", "rotation"),
    "The paper's variants, trained": ("ablation", "attention", "uncertainty"),
}
"""Groups of the commands in the help, and their order."""


@bench.callback()
def protocols() -> None:
    """Measure success and precision by a seeded protocol, other methods beside it in the same run.

    Example: [bold]utopic bench range-scans --pairs 30 --html page.html[/bold]
    """


@bench.command()
def scans(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="Scans with their known answers in gt.json (example: docs/benchmarks.md)."
        ),
    ],
    pairs: Annotated[
        int | None,
        typer.Option(
            min=1, help="Only so many pairs, chosen evenly over the overlaps.", rich_help_panel=MEASURING
        ),
    ] = None,
    poses: Annotated[
        int,
        typer.Option(min=1, help="Random start poses of the source per pair.", rich_help_panel=MEASURING),
    ] = 3,
    min_overlap: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Leave out pairs whose smaller side overlaps less.",
            rich_help_panel=MEASURING,
        ),
    ] = 0.1,
    baselines: Baselines = "",
    through_cli: Annotated[
        bool,
        typer.Option(
            "--through-cli",
            help="Run 'utopic align' on files, a process for each.",
            rich_help_panel=MEASURING,
        ),
    ] = False,
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    weights: Weights = DEFAULTS.weights,
    device: Device = "auto",
    threads: Threads = DEFAULTS.threads,
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Align the pairs of a folder of real scans from random start poses.

    Success: under 5 degrees and under 5 % of the extent from the known answer.

    Example: [bold]utopic bench scans scans/ --baselines open3d-ransac --html scans.html[/bold]
    """
    outputs = Outputs(json_out, html_out, overwrite)
    outputs.check()
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.scans import render, run

        report = run(
            folder,
            pairs=pairs,
            poses=poses,
            seed=seed,
            baselines=names(baselines),
            min_overlap=min_overlap,
            through_cli=through_cli,
            options=AlignOptions(weights=weights, device=device, threads=threads, seed=seed),
            progress=countdown(step),
        )
    outputs.write(report, console)
    render(report, table_console())


def group(bench: typer.Typer) -> None:
    """Sort the commands mounted so far into ``PANELS``."""
    panel = {name: title for title, members in PANELS.items() for name in members}
    order = list(panel)

    def name_of(command: CommandInfo) -> str:
        return str(command.name or getattr(command.callback, "__name__", ""))

    bench.registered_commands.sort(key=lambda command: order.index(name_of(command)))
    for command in bench.registered_commands:
        command.rich_help_panel = panel[name_of(command)]
