"""``utopic bench``: the measurements behind the claims, one protocol a command."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from utopic_cli.commands.console import Console, Debug, Device, Overwrite, Quiet, Seed, Threads, Weights
from utopic_cli.config import AlignOptions

_DEFAULTS = AlignOptions()

bench = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")


@bench.callback()
def protocols() -> None:
    """Measure success and precision by a seeded protocol, other methods beside it in the same run."""


@bench.command()
def scans(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Scans with their known answers in gt.json.")],
    pairs: Annotated[
        int | None, typer.Option(min=1, help="Only so many pairs, chosen evenly over the overlaps.")
    ] = None,
    poses: Annotated[int, typer.Option(min=1, help="Random start poses of the source per pair.")] = 3,
    min_overlap: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Leave out pairs whose smaller side overlaps less.")
    ] = 0.1,
    baselines: Annotated[
        str,
        typer.Option(
            metavar="NAME,..",
            help="Methods to measure beside: open3d-ransac, open3d-ransac-fine, open3d-fgr.",
        ),
    ] = "",
    through_cli: Annotated[
        bool, typer.Option("--through-cli", help="Run 'utopic align' on files, a process for each.")
    ] = False,
    json_out: Annotated[
        Path | None, typer.Option("--json", metavar="OUT", help="Every single result, with all settings.")
    ] = None,
    overwrite: Overwrite = False,
    weights: Weights = _DEFAULTS.weights,
    device: Device = "auto",
    threads: Threads = _DEFAULTS.threads,
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Align the pairs of a folder of real scans from random start poses.

    Success: under 5 degrees and under 5 % of the extent from the known answer.
    """
    from utopic_cli.io.output import check_writable, write_atomically

    if json_out is not None:
        check_writable([json_out], overwrite)
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.scans import render, run

        report = run(
            folder,
            pairs=pairs,
            poses=poses,
            seed=seed,
            baselines=[name.strip() for name in baselines.split(",") if name.strip()],
            min_overlap=min_overlap,
            through_cli=through_cli,
            options=AlignOptions(weights=weights, device=device, threads=threads, seed=seed),
            progress=_countdown(step),
        )
    if json_out is not None:  # before anything that stdout could spoil
        write_atomically(json_out, report.to_json().encode("utf-8"), overwrite=overwrite)
        console.line(f"wrote {json_out}")
    from rich.console import Console as RichConsole

    render(report, RichConsole())


def _countdown(step: Callable[[str], None]) -> Callable[[int, int, str], None]:
    """Say how much is done and about how long the rest takes, at the pace so far."""
    begin = time.monotonic()

    def progress(done: int, total: int, what: str) -> None:
        left = ""
        if done:
            minutes, seconds = divmod(round((time.monotonic() - begin) / done * (total - done)), 60)
            left = f", about {minutes}:{seconds:02d} left"
        step(f"{done}/{total}{left}: {what}")

    return progress
