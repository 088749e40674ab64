"""``utopic bench batch``: how a batch grows with its scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from utopic_cli.commands.bench_options import JsonOut, Outputs, Points, Workers, table_console
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
    outputs = Outputs(json_out, None, overwrite)
    outputs.check()
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.multiway.trial import run_trials, to_json

        options = AlignOptions(weights=weights, points=points, device=device, threads=1, seed=seed)
        rows = run_trials(
            counts, options, drawn=further, workers=workers, seed=seed, folder=keep, progress=step
        )
    outputs.write_texts(lambda: to_json(rows, options, workers, seed), str, console)  # no page
    _print_table(rows)


def _counts(option: str, text: str) -> list[int]:
    counts = [int(word) if word.strip().isdecimal() else 0 for word in text.split(",")]
    if min(counts) < 2:
        raise UsageError(f"{option} {text}: give numbers of scans, 2 at least, like 10,30")
    return counts


def _print_table(rows: list[TrialRow]) -> None:
    from utopic_cli.benchmark.reports import make_table

    table = make_table(
        "Simulated scans of several objects, mixed",
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
    table_console().print(table)
