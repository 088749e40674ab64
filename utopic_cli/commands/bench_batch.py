"""``utopic bench batch``: how a batch grows with its scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from utopic_cli.commands.bench_options import HtmlOut, JsonOut, Outputs, Points, Workers, table_console
from utopic_cli.commands.console import (
    DEFAULTS,
    MEASURING,
    WRITING,
    Console,
    Debug,
    Device,
    Overwrite,
    Quiet,
    Seed,
    Weights,
)
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from utopic_cli.multiway.trial import TrialRow


def batch_bench(
    scans: Annotated[
        str,
        typer.Option(
            metavar="N,..",
            help="Numbers of scans, ten of each object; a batch for each.",
            rich_help_panel=MEASURING,
        ),
    ] = "10,30",
    drawn: Annotated[
        str,
        typer.Option(
            metavar="N,..",
            help="Further numbers of scans whose pairs are not registered: their answers are drawn from "
            "those of --scans. Measured are then pairs tried, memory, and the time of all else.",
            rich_help_panel=MEASURING,
        ),
    ] = "",
    keep: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Keep scans and results there; a later run goes on with them.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    weights: Weights = DEFAULTS.weights,
    points: Points = DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Simulated scans of several objects, mixed, their names in no order: what a batch makes of them.

    Prints pairs tried, time, memory, whether the groups are right, and how many wrong pairs survive.

    Example: [bold]utopic bench batch --scans 20,50 --drawn 100,300 --keep trial[/bold]
    """
    counts = _counts("--scans", scans)
    further = _counts("--drawn", drawn) if drawn else []
    outputs = Outputs(json_out, html_out, overwrite)
    outputs.check()
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.multiway.trial import measured_with, run_trials, to_json

        options = AlignOptions(weights=weights, points=points, device=device, threads=1, seed=seed)
        settings = measured_with(options, workers, seed)
        rows = run_trials(
            counts, options, drawn=further, workers=workers, seed=seed, folder=keep, progress=step
        )
    outputs.write_texts(lambda: to_json(rows, settings), lambda: _page(rows, settings), console)
    table_console().print(_table(rows, settings))


def _counts(option: str, text: str) -> list[int]:
    counts = [int(word) if word.strip().isdecimal() else 0 for word in text.split(",")]
    if min(counts) < 2:
        raise UsageError(f"{option} {text}: give numbers of scans, 2 at least, like 10,30")
    return counts


def _title(settings: dict[str, Any]) -> str:
    from utopic_cli.benchmark.reports import with_weights

    title = f"batch: simulated scans of several objects, mixed, seed {settings['seed']}"
    return with_weights(title, [(settings["weights_name"], settings["weights_sha256"])])


def _page(rows: list[TrialRow], settings: dict[str, Any]) -> str:
    """Draw pairs and time over the number of scans, with the table."""
    from utopic_cli.benchmark.result_page import result_page

    ordered = sorted(rows, key=lambda row: row.scans)
    figures = [
        _plot(
            ordered,
            "Pairs",
            "Tried, and all there are.",
            {"tried": lambda row: row.pairs, "all": lambda row: row.all_pairs},
        ),
        _plot(
            ordered,
            "Seconds",
            "What one worker takes for scans and pairs, and this process for all else.",
            {"scans and pairs": lambda row: row.work_s, "all else": lambda row: row.own_s},
        ),
    ]
    return result_page(_title(settings), (), figures, [_table(rows, settings)], settings)


def _plot(
    rows: list[TrialRow], name: str, caption: str, values: dict[str, Callable[[TrialRow], float]]
) -> str:
    from utopic_cli.benchmark.chart import round_up
    from utopic_cli.benchmark.plots import value_plot

    series = {one: [(row.scans, value(row)) for row in rows] for one, value in values.items()}
    most = round_up(max(row.scans for row in rows))
    return value_plot(name, caption, ("scans", name.lower()), series, most, ("{:g}", "{:g}"))


def _table(rows: list[TrialRow], settings: dict[str, Any]) -> Table:
    from utopic_cli.benchmark.reports import make_table

    table = make_table(
        _title(settings),
        "Times are wall time of one process. Memory: this process + the largest worker. "
        "~: estimated; answers of pairs are drawn from those of other rows, so groups say little there.",
        (),
        (
            "scans", "objects", "pairs", "of all", "a scan", "a pair", "scans and pairs", "all else",
            "memory", "groups", "placed", "wrong pairs", "worst rotation", "worst place",
        ),
    )  # fmt: skip
    for row in rows:
        about = "~" if row.drawn else ""
        memory = f"{row.own_mb:.0f} + {row.worker_mb:.0f} MB" if row.own_mb and row.worker_mb else ""
        table.add_row(
            str(row.scans),
            str(row.objects),
            str(row.pairs),
            f"{row.pairs / row.all_pairs:.0%}",
            f"{row.scan_s:.1f} s",
            f"{about}{row.pair_s:.1f} s",
            f"{about}{row.work_s:.0f} s",
            f"{row.own_s:.0f} s",
            memory,
            "exact" if row.exact else f"{row.wrong_joins} scans wrongly" if row.wrong_joins else "in parts",
            str(row.placed),
            str(row.wrong_pairs),
            f"{row.worst_deg:.2f}°",
            f"{row.worst_percent:.2f} %",
        )
    return table
