"""``utopic bench batch``: how a batch grows with its scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from utopic_cli.commands.bench import TABLE_WIDTH, JsonOut, Points, Workers
from utopic_cli.commands.console import Console, Debug, Device, Overwrite, Quiet, Seed, Weights
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError

if TYPE_CHECKING:
    from utopic_cli.multiway.trial import TrialRow

_DEFAULTS = AlignOptions()


def batch_bench(
    scans: Annotated[
        str,
        typer.Option(metavar="N,..", help="Numbers of scans, ten of each object; a batch for each."),
    ] = "10,30",
    weights: Weights = _DEFAULTS.weights,
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Simulated scans of several objects, mixed, their names in no order: what a batch makes of them.

    Prints pairs tried, time, memory, whether the groups are right, and how many wrong pairs survive.
    """
    from utopic_cli.io.output import check_writable, write_atomically

    counts = _counts(scans)
    check_writable([] if json_out is None else [json_out], overwrite)
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.multiway.trial import run_trials, to_json

        options = AlignOptions(weights=weights, points=points, device=device, threads=1, seed=seed)
        rows = run_trials(counts, options, workers=workers, seed=seed, progress=step)
    if json_out is not None:
        write_atomically(
            Path(json_out), to_json(rows, options, workers, seed).encode("ascii"), overwrite=overwrite
        )
        console.line(f"wrote {json_out}")
    _print_table(rows)


def _counts(text: str) -> list[int]:
    counts = [int(word) if word.strip().isdecimal() else 0 for word in text.split(",")]
    if min(counts) < 2:
        raise UsageError(f"--scans {text}: give numbers of scans, 2 at least, like 10,30")
    return counts


def _print_table(rows: list[TrialRow]) -> None:
    from rich.console import Console as RichConsole
    from rich.table import Table

    table = Table(
        "scans", "objects", "pairs", "of all", "time", "memory", "groups", "placed",
        "wrong pairs", "worst rotation", "worst place",
        title="Simulated scans of several objects, mixed",
    )  # fmt: skip
    for column in table.columns:
        column.justify = "right"
    for row in rows:
        table.add_row(
            str(row.scans),
            str(row.objects),
            str(row.pairs),
            f"{row.pairs / row.all_pairs:.0%}",
            f"{row.seconds:.0f} s",
            "" if row.largest_mb is None else f"{row.largest_mb:.0f} MB",
            "exact" if row.exact else f"{row.wrong_joins} scans wrongly" if row.wrong_joins else "in parts",
            str(row.placed),
            str(row.wrong_pairs),
            f"{row.worst_deg:.2f}°",
            f"{row.worst_percent:.2f} %",
        )
    out = RichConsole()
    # A file or a pipe has no width: the table gets its own.
    (out if out.is_terminal else RichConsole(width=TABLE_WIDTH)).print(table)
