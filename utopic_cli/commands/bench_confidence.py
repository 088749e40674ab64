"""``utopic bench confidence``: is the verdict worth its name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from utopic_cli.commands.bench import TABLE_WIDTH, Data, JsonOut, Points, Workers, countdown
from utopic_cli.commands.console import Console, Debug, Device, Overwrite, Quiet, Seed, Weights
from utopic_cli.config import AlignOptions

_DEFAULTS = AlignOptions()
PAIRS = 300


def confidence(
    data: Data = "procedural",
    folder: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Real scans with their answers in gt.json, instead of shapes."),
    ] = None,
    pairs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of trials; more begin with the same ones.",
            show_default="300, of a folder each pair once",
        ),
    ] = None,
    weights: Weights = _DEFAULTS.weights,
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    html_out: Annotated[
        Path | None,
        typer.Option("--html", metavar="OUT", help="A page with the reliability diagram and the tables."),
    ] = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Labelled pairs, about half of which can be aligned: does the confidence tell which.

    The shapes are those that neither training nor the calibration has seen. Prints AUROC, Brier
    score, expected calibration error, and what the verdict lets through.
    """
    from utopic_cli.io.output import check_writable, write_atomically

    check_writable([path for path in (json_out, html_out) if path is not None], overwrite)
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.trust import render, run, run_folder
        from utopic_cli.benchmark.trust_page import page
        from utopic_cli.synthesis.packing import open_shapes

        options = AlignOptions(weights=weights, points=points, device=device, seed=seed)
        if folder is not None:
            report = run_folder(folder, pairs, seed, options, workers, countdown(step))
        else:
            step("making shapes" if data == "procedural" else f"reading shapes from {data}")
            shapes = open_shapes(data, progress=countdown(step))
            step("starting")
            report = run(shapes, data, pairs or PAIRS, seed, options, workers, countdown(step))
    # Before anything that stdout could spoil.
    for path, write in ((json_out, report.to_json), (html_out, lambda: page(report))):
        if path is not None:
            write_atomically(path, write().encode("utf-8"), overwrite=overwrite)
            console.line(f"wrote {path}")
    from rich.console import Console as RichConsole

    out = RichConsole()
    # A file or a pipe has no width: the tables get theirs.
    render(report, out if out.is_terminal else RichConsole(width=TABLE_WIDTH))
