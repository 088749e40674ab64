"""``utopic bench confidence``: is the verdict worth its name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from utopic_cli.commands.bench_options import (
    Common,
    Data,
    Points,
    Workers,
    countdown,
    open_data,
    table_console,
    with_common_options,
)
from utopic_cli.commands.console import DEFAULTS, MEASURING, Console, Weights
from utopic_cli.config import AlignOptions

PAIRS = 300


@with_common_options
def confidence(
    asked: Common,
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
    weights: Weights = DEFAULTS.weights,
    points: Points = DEFAULTS.points,
    workers: Workers = 1,
) -> None:
    """Labelled pairs, about half of which can be aligned: does the confidence tell which.

    The shapes are those that neither training nor the calibration has seen. Prints AUROC, Brier
    score, expected calibration error, and what the verdict lets through.

    Example: [bold]utopic bench confidence --pairs 100 --html verdict.html[/bold]
    """
    asked.outputs.check()
    console = Console(quiet=asked.quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.trust import render, run, run_folder
        from utopic_cli.benchmark.trust_page import page

        options = AlignOptions(weights=weights, points=points, device=asked.device, seed=asked.seed)
        if folder is not None:
            report = run_folder(folder, pairs, asked.seed, options, workers, countdown(step))
        else:
            shapes = open_data(data, step)
            step("starting")
            report = run(shapes, data, pairs or PAIRS, asked.seed, options, workers, countdown(step))
    asked.outputs.write_texts(report.to_json, lambda: page(report), console)
    render(report, table_console())
