"""``utopic batch``: a folder of scans in, one frame out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from utopic_cli.commands.console import (
    DEFAULTS,
    RUNNING,
    SOLVING,
    WRITING,
    Console,
    Debug,
    Device,
    MaxRotation,
    MostPoints,
    Overwrite,
    Quiet,
    Seed,
    Verbose,
    Weights,
)
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError
from utopic_cli.io.files import printable

if TYPE_CHECKING:
    from utopic_cli.multiway.outcome import BatchOutcome
    from utopic_cli.multiway.plan import BatchPlan, BatchRequest


MOST_FAILURES_SAID = 5


def batch(
    inputs: Annotated[
        list[Path], typer.Argument(metavar="INPUT...", help="A folder of scans, a pattern, or files.")
    ],
    out_dir: Annotated[
        Path, typer.Option(metavar="DIR", help="Where everything goes.", rich_help_panel=WRITING)
    ],
    pairs: Annotated[
        str,
        typer.Option(
            metavar="auto|all|sequential|to-first|FILE.csv",
            help="Which pairs to try; auto: the most promising ones, all of them up to 12 scans.",
            rich_help_panel=SOLVING,
        ),
    ] = "auto",
    merge: Annotated[
        bool,
        typer.Option(
            "--merge",
            help="Write merged.ply: all scans of the largest group, colours and the scalar fields of most "
            "scans kept, the field 'scan' says which; merged-2.ply and so on for further groups.",
            rich_help_panel=WRITING,
        ),
    ] = False,
    merge_voxel: Annotated[
        float | None,
        typer.Option(
            metavar="SIZE",
            help="Thin merged clouds to one point a cell of this size, in the files' unit.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    html: Annotated[bool, typer.Option("--html", help="Write report.html.", rich_help_panel=WRITING)] = False,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on with the batch in --out-dir: only what is missing or has changed is done.",
        ),
    ] = False,
    overwrite: Overwrite = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, write nothing.")
    ] = False,
    points: MostPoints = DEFAULTS.points,
    max_rotation: MaxRotation = DEFAULTS.max_rotation,
    weights: Weights = DEFAULTS.weights,
    workers: Annotated[
        int,
        typer.Option(
            min=0,
            help="Processes; 0: one for each CPU, 4 at most. The result does not depend on it.",
            rich_help_panel=RUNNING,
        ),
    ] = 0,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A Dask scheduler, like tcp://host:8786, whose workers do the work instead; they must "
            "see the same files. Needs utopic-cli\\[cluster].",
            rich_help_panel=RUNNING,
        ),
    ] = None,
    timeout: Annotated[
        float,
        typer.Option(
            min=1.0,
            metavar="S",
            help="Seconds a pair may take before it is ended.",
            rich_help_panel=RUNNING,
        ),
    ] = 600.0,
    device: Device = "auto",
    threads: Annotated[
        int, typer.Option(min=1, help="CPU threads of each process.", rich_help_panel=RUNNING)
    ] = 1,
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Align many scans into one frame.

    [bold]p_world = T_world_scan @ p_scan[/bold]

    Scans that don't connect are left out and named; several groups are kept apart.
    Writes poses.json, poses.txt, poses.csv, summary.csv and pairs/*.json.
    Exit codes: 0 all scans in one group; 6 some are left out, or there are several groups; 7 nothing
    aligned.

    Example: [bold]utopic batch scans/ --out-dir model --merge --html[/bold]
    """
    console = Console(quiet=quiet, verbose=verbose)
    if merge_voxel is not None and not (merge and 0.0 < merge_voxel < float("inf")):
        raise UsageError("--merge-voxel needs --merge and a size above 0")
    if cluster is not None and workers:
        raise UsageError("--workers is about this machine and --cluster about others; choose one")
    with console.progress() as progress:
        progress("loading libraries")
        from utopic_cli.multiway.batch import run_batch
        from utopic_cli.multiway.plan import BatchRequest, plan_batch

        request = BatchRequest(
            inputs=tuple(inputs),
            out_dir=out_dir,
            pairs=pairs,
            options=AlignOptions(
                weights=weights,
                points=points,
                max_rotation=max_rotation,
                device=device,
                threads=threads,
                seed=seed,
            ),
            workers=workers or min(4, _cpus()),
            cluster=cluster,
            timeout_s=timeout,
            resume=resume,
            overwrite=overwrite,
            merge=merge,
            voxel=merge_voxel,
            page=html,
        )
        said: list[str] = []

        def warn(plan: BatchPlan) -> None:  # hours before the summary says it of the scans
            said.extend(plan.scans.notes)
            console.warnings((*said, *(scan.problem for scan in plan.scans.scans if scan.problem)))

        outcome = None if dry_run else run_batch(request, progress=progress, planned=warn)
        plan = plan_batch(request) if outcome is None else None
    if plan is not None:
        _say_plan(plan, request)
    if outcome is not None:
        console.warnings(tuple(note for note in outcome.notes if note not in said))
        _say_outcome(outcome, request, console)
        if outcome.exit_code:
            raise typer.Exit(outcome.exit_code)


def _cpus() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _say_plan(plan: BatchPlan, request: BatchRequest) -> None:
    """Say on stdout what would be done."""
    from utopic_cli.multiway.outcome import pair_name

    scans = plan.scans.scans
    recorded = {path.stem for path in plan.earlier if path.parent.name == "pairs"}
    if plan.earlier:
        _say_earlier(request, len(recorded))
    for scan in scans:
        if scan.problem:
            word = "no scan" if scan.doubtful else "left out"
            typer.echo(printable(f"{word}  {scan.problem}"))
            continue
        fate = f"copy of {scan.copy_of}" if scan.copy_of else "to align"
        typer.echo(printable(f"scan  {scan.name}  {scan.path}  {fate}"))
    for note in plan.scans.notes:
        typer.echo(printable(f"note  {note}"))
    if plan.first is None:
        typer.echo(
            f"pairs  chosen by what the network sees of each of {len(plan.usable)} scans; "
            f"at most {10 * len(plan.usable)}"
        )
        return
    for source, target in plan.first:
        name = pair_name(scans[source], scans[target])
        typer.echo(printable(f"pair  {name}{'  recorded' if name in recorded else ''}"))
    where = f"{request.workers} at a time" if request.cluster is None else f"on {request.cluster}"
    typer.echo(f"{len(plan.first)} pairs of {len(plan.usable)} scans, {where}")


def _say_earlier(request: BatchRequest, recorded: int) -> None:
    """Say what becomes of the batch that is in the folder already."""
    held = f"{request.out_dir}: holds an earlier batch, {recorded} of its pairs recorded"
    if request.resume:
        fate = "they are used again where neither scans nor options have changed"
    elif request.overwrite:
        fate = "it would be replaced"
    else:
        fate = "pass --resume to go on with it or --overwrite to begin anew"
    typer.echo(printable(f"{held}; {fate}"))


def _say_outcome(outcome: BatchOutcome, request: BatchRequest, console: Console) -> None:
    from utopic_cli.multiway.folder import results

    placed = sum(entry.group is not None for entry in outcome.scans)
    wanted = sum(entry.passed_over is None for entry in outcome.scans)
    groups = outcome.model.groups
    said = "one group" if len(groups) == 1 else f"{len(groups)} groups"
    console.line(f"{placed} of {wanted} scans placed" + (f", in {said}" if groups else ""))
    for number, group in enumerate(groups, 1):
        names = ", ".join(outcome.scans[scan].file.name for scan in group.T_world_scan)
        console.line(f"  {f'group {number}':<9}{len(group.T_world_scan)} scans: {names}")
    for entry in outcome.scans:
        if entry.left_out is not None:
            console.line(f"  {'left out':<9}{entry.file.name}: {entry.left_out}")
        elif entry.passed_over is not None:
            console.line(f"  {'no scan':<9}{entry.passed_over}")
    verdicts: dict[str, int] = {}
    for pair in outcome.model.pairs:
        verdicts[pair.verdict] = verdicts.get(pair.verdict, 0) + 1
    counts = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    again = f" ({outcome.resumed} were done before)" if outcome.resumed else ""
    console.line(f"  {'pairs':<9}{len(outcome.model.pairs)} tried{again}: {counts}")
    failed = 0
    for pair in outcome.model.pairs:
        reason = f": {pair.reason}" if pair.reason else ""
        name = outcome.pair_name(pair.source, pair.target)
        line = f"  {'pair':<9}{name} {pair.verdict}{reason}"
        failed += pair.verdict == "failed"
        if pair.verdict == "failed" and failed <= MOST_FAILURES_SAID:
            console.line(line)
        else:
            console.detail(line)
    if failed > MOST_FAILURES_SAID:
        console.line(f"  {'':<9}{failed - MOST_FAILURES_SAID} more pairs failed: see summary.csv")
    console.line(f"  {'time':<9}{outcome.seconds:.0f} s")
    console.files([*results(request.out_dir), request.out_dir / "pairs" / "*.json"])
