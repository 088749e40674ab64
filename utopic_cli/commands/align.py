"""``utopic align``: two scan files in, one transformation and what else was asked for out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from utopic_cli.commands.console import (
    DEFAULTS,
    SOLVING,
    WRITING,
    Colormap,
    Console,
    Debug,
    Device,
    MaxRotation,
    MostPoints,
    Overwrite,
    Quiet,
    Seed,
    Threads,
    Verbose,
    Weights,
    stopwatch,
    to_stdout,
)
from utopic_cli.commands.outputs import OutputPlan, check_outputs, plan_outputs, write_answer
from utopic_cli.commands.transformation import files_behind
from utopic_cli.config import DEFAULT_COLOUR_MAP, AlignOptions, ColourMapName

if TYPE_CHECKING:
    from utopic_cli.io.scan import Scan
    from utopic_cli.result import RegistrationResult


NOT_TRUSTED = 3


def align(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="The scan that moves.")],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="The scan that stays.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="PATH",
            help="The transformation: .txt (4x4, row-major), .npy, .json, .pdal.json, .log (Open3D), .kitti, "
            ".tum or .yaml (ROS). Without this and --out-dir it goes to stdout.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The whole set: transformation.txt, the aligned scan, four coloured PLYs, report.html, "
            "report.json.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    aligned: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="SOURCE moved onto TARGET, in its own format with every attribute kept.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    merged: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Both scans in the target's frame as one PLY; the field 'scan' says which is which.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    clouds: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The four coloured PLYs: redder = more likely overlapping, more uncertain.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="PATH", help="The JSON report.", rich_help_panel=WRITING)
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="A page to look at in a browser, offline: 3D view, verdict, numbers.",
            rich_help_panel=WRITING,
        ),
    ] = None,
    json_report: Annotated[
        bool,
        typer.Option("--json", help="The JSON report alone on stdout.", rich_help_panel=WRITING),
    ] = False,
    colormap: Colormap = DEFAULT_COLOUR_MAP,
    overwrite: Overwrite = False,
    init: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="A transformation to try first, in any form of 'utopic transformation'.",
            rich_help_panel=SOLVING,
        ),
    ] = None,
    points: MostPoints = DEFAULTS.points,
    refine: Annotated[
        bool,
        typer.Option(help="Refine at full resolution after the network's estimate.", rich_help_panel=SOLVING),
    ] = DEFAULTS.refine,
    solver: Annotated[
        Literal["auto", "svd", "consensus"],
        typer.Option(
            help="svd: the paper's, overlap-weighted Procrustes; auto chooses by verification.",
            rich_help_panel=SOLVING,
        ),
    ] = "auto",
    max_rotation: MaxRotation = DEFAULTS.max_rotation,
    weights: Weights = DEFAULTS.weights,
    device: Device = "auto",
    threads: Threads = DEFAULTS.threads,
    seed: Seed = DEFAULTS.seed,
    exit_zero: Annotated[
        bool,
        typer.Option("--exit-zero", help="Exit with 0 even if the answer is not to be trusted."),
    ] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Find the transformation that moves SOURCE onto TARGET.

    [bold]p_target = T_target_source @ p_source[/bold]

    Reads PLY, PCD, OBJ, XYZ/TXT/PTS, LAS/LAZ, E57, STL, OFF and GLB.
    No unit, voxel size or radius is needed.
    Nothing existing is replaced without --overwrite.

    Example: [bold]utopic align a.ply b.ply --out-dir result[/bold]
    """
    request = AlignRequest(
        source=source,
        target=target,
        plan=plan_outputs(
            source,
            output=output,
            out_dir=out_dir,
            aligned=aligned,
            merged=merged,
            clouds=clouds,
            report=report,
            page=html,
        ),
        options=AlignOptions(
            weights=weights,
            points=points,
            refine=refine,
            solver=solver,
            max_rotation=max_rotation,
            device=device,
            threads=threads,
            seed=seed,
        ),
        init=init,
        overwrite=overwrite,
        colormap=colormap,
    )
    outcome = run(request, Console(quiet=quiet, verbose=verbose))
    if json_report:
        from utopic_cli.report import report_bytes

        to_stdout(report_bytes(outcome.report))
    elif output is None and out_dir is None:
        from utopic_cli.io.transformation import format_transformation

        to_stdout(format_transformation(outcome.result.T_target_source, "matrix"))
    if not outcome.result.trusted and not exit_zero:
        raise typer.Exit(NOT_TRUSTED)


@dataclass(frozen=True)
class AlignRequest:
    """One alignment as asked for.

    Attributes:
        source: path of the scan that moves.
        target: path of the scan that stays.
        plan: the files to write.
        options: the pipeline's options.
        init: path of a transformation to try first.
        overwrite: whether existing files may be replaced.
        colormap: the colours of overlap and uncertainty.
    """

    source: Path
    target: Path
    plan: OutputPlan
    options: AlignOptions
    init: Path | None = None
    overwrite: bool = False
    colormap: ColourMapName = DEFAULT_COLOUR_MAP


@dataclass(frozen=True)
class AlignOutcome:
    """What one alignment gave: the scans as read, the answer, and its report."""

    source: Scan
    target: Scan
    result: RegistrationResult
    report: dict[str, Any]


def run(request: AlignRequest, console: Console) -> AlignOutcome:
    """Check the outputs, read both scans, register, write, and say what came out on stderr.

    Raises:
        OutputError: an output can't be written; found before any work wherever that can be known.
        InputError: a scan, the initial transformation or the weights can't be used.
    """
    weights = Path(request.options.weights)
    inputs = [request.source, request.target, weights, weights.parent / f"{weights.stem}.json"]
    check_outputs(
        request.plan, [*inputs, *files_behind([request.init] if request.init else [])], request.overwrite
    )
    with console.progress(lines=False) as progress:
        progress("loading libraries")
        from utopic_cli import pipeline
        from utopic_cli.io.scan import read_scan
        from utopic_cli.io.transformation import read_transformation

        timings_s: dict[str, float] = {}
        with stopwatch(timings_s, "read"):
            progress(f"reading {request.source.name}")
            source = read_scan(request.source, seed=request.options.seed)
            progress(f"reading {request.target.name}")
            target = read_scan(request.target, seed=request.options.seed)
            initial = read_transformation(request.init) if request.init else None
        result = pipeline.register(
            source.cloud, target.cloud, request.options, initial=initial, progress=progress
        )
        progress("writing")
        report = write_answer(
            request.plan,
            source,
            target,
            result,
            colormap=request.colormap,
            overwrite=request.overwrite,
            timings_s=timings_s,
        )
    outcome = AlignOutcome(source, target, result, report)
    _say_summary(outcome, request, console)
    return outcome


def _say_summary(outcome: AlignOutcome, request: AlignRequest, console: Console) -> None:
    """Say the verdict, what it rests on, the motion, and the files written."""
    from utopic_cli.result_display import headline, residual_in_words, rounded

    report, result = outcome.report, outcome.result
    console.warnings(tuple(report["warnings"]))
    console.headline(f"{outcome.source.path} -> {outcome.target.path}:", headline(result), result.trusted)
    for reason in result.reasons:
        because, said = (
            ("but", reason.removeprefix("but ")) if reason.startswith("but ") else ("because", reason)
        )
        console.fact(because, said)
    fit = result.fit
    source, target = fit.overlap_ratio["source"], fit.overlap_ratio["target"]
    console.fact("overlap", f"{source:.0%} of the source, {target:.0%} of the target")
    if math.isfinite(fit.inlier_rmse):
        console.fact("residual", residual_in_words(fit))
    motion = report["about_source_centroid"]
    shift = rounded(math.hypot(*motion["translation"]), report["target"]["extent"]["diagonal"])
    angle = f"{motion['angle_deg']:.3f} degrees about the source's centroid"
    console.fact("motion", f"{angle}, which moves by {shift:.6g} file units")
    if result.ambiguous_with and not result.trusted and request.options.max_rotation == DEFAULTS.max_rotation:
        console.fact("hint", "who knows about how far the source is turned can say so: --max-rotation DEG")
    if console.verbose:
        for step, seconds in report["timings_s"].items():
            console.fact("time", f"{step} {seconds:.2f} s")
        if result.weights_name:
            console.fact("weights", f"{result.weights_name} {result.weights_sha256[:12]}")
    console.files(request.plan.paths)
