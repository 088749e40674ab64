"""``utopic bench confidence``: is the verdict worth its name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from utopic_cli.commands.bench_options import (
    Data,
    HtmlOut,
    JsonOut,
    Outputs,
    Points,
    Workers,
    countdown,
    open_data,
    table_console,
)
from utopic_cli.commands.console import MEASURING, Console, Debug, Device, Overwrite, Quiet, Seed, Weights
from utopic_cli.config import AlignOptions

_DEFAULTS = AlignOptions()
PAIRS = 300


def confidence(
    data: Data = "procedural",
    folder: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Real scans with their answers in gt.json, instead of shapes.",
            rich_help_panel=MEASURING,
        ),
    ] = None,
    pairs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of trials; more begin with the same ones.",
            show_default="300, of a folder each pair once",
            rich_help_panel=MEASURING,
        ),
    ] = None,
    weights: Weights = _DEFAULTS.weights,
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Labelled pairs, about half of which can be aligned: does the confidence tell which.

    The shapes are those that neither training nor the calibration has seen. Prints AUROC, Brier
    score, expected calibration error, and what the verdict lets through.

    Example: [bold]utopic bench confidence --pairs 100 --html verdict.html[/bold]
    """
    outputs = Outputs(json_out, html_out, overwrite)
    outputs.check()
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.trust import render, run, run_folder
        from utopic_cli.benchmark.trust_page import page

        options = AlignOptions(weights=weights, points=points, device=device, seed=seed)
        if folder is not None:
            report = run_folder(folder, pairs, seed, options, workers, countdown(step))
        else:
            shapes = open_data(data, step)
            step("starting")
            report = run(shapes, data, pairs or PAIRS, seed, options, workers, countdown(step))
    outputs.write_texts(report.to_json, lambda: page(report), console)
    render(report, table_console())
