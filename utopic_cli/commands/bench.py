"""``utopic bench``: the measurements behind the claims, one protocol a command."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from utopic_cli.commands.console import Console, Debug, Device, Overwrite, Quiet, Seed, Threads, Weights
from utopic_cli.config import AlignOptions

if TYPE_CHECKING:
    from utopic_cli.benchmark.protocols import AnyProtocol

_DEFAULTS = AlignOptions()
TABLE_WIDTH = 160

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
            help="Methods to measure beside: open3d-ransac, open3d-ransac-fine, open3d-fgr, kiss-matcher.",
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
            baselines=_names(baselines),
            min_overlap=min_overlap,
            through_cli=through_cli,
            options=AlignOptions(weights=weights, device=device, threads=threads, seed=seed),
            progress=countdown(step),
        )
    if json_out is not None:  # before anything that stdout could spoil
        write_atomically(json_out, report.to_json().encode("utf-8"), overwrite=overwrite)
        console.line(f"wrote {json_out}")
    from rich.console import Console as RichConsole

    render(report, RichConsole())


Data = Annotated[
    str,
    typer.Option(
        metavar="procedural|DIR|modelnet40:DIR",
        help="Shapes that pairs are made of; only those held out from training are used.",
    ),
]
Pairs = Annotated[int, typer.Option(min=1, help="Number of pairs; more begin with the same ones.")]
SeveralWeights = Annotated[
    list[str] | None,
    typer.Option(
        "--weights",
        metavar="NAME|PATH",
        help="Weights to measure; may be given several times.",
        show_default=_DEFAULTS.weights,
    ),
]
Matchers = Annotated[
    str,
    typer.Option("--baselines", metavar="NAME,..", help="Measure beside, with the same solver: fpfh."),
]
Points = Annotated[int, typer.Option(min=50, help="Most points per cloud that the methods see.")]
Workers = Annotated[
    int,
    typer.Option(min=1, help="Processes, one thread each; their number changes no result."),
]
JsonOut = Annotated[
    Path | None, typer.Option("--json", metavar="OUT", help="Every single result, with all settings.")
]
Sampling = Annotated[
    Literal["shared", "independent"],
    typer.Option(help="Both clouds are crops of one sample (the paper's figures), or of two samples."),
]
Rotations = Annotated[
    Literal["euler45", "uniform"] | None,
    typer.Option(
        help="Euler angles in 0 to 45 degrees and translation within 0.5, or uniform over SO(3).",
        show_default="the paper's euler45 for shared, uniform for independent",
    ),
]


@bench.command()
def modelnet(
    data: Data = "procedural",
    sampling: Sampling = "shared",
    rotations: Rotations = None,
    pairs: Pairs = 300,
    weights: SeveralWeights = None,
    baselines: Matchers = "",
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """The paper's ModelNet protocol: 1,024 points of a shape, both crops keep 70 %."""
    asked = _Asked(data, pairs, weights, baselines, points, workers, json_out, overwrite, device, seed, quiet)
    _measure(asked, lambda: _crops("modelnet", 0.7, sampling, rotations))


@bench.command()
def modelonet(
    data: Data = "procedural",
    sampling: Sampling = "shared",
    rotations: Rotations = None,
    pairs: Pairs = 300,
    weights: SeveralWeights = None,
    baselines: Matchers = "",
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """The paper's ModelLoNet protocol: 1,024 points of a shape, both crops keep 50 %."""
    asked = _Asked(data, pairs, weights, baselines, points, workers, json_out, overwrite, device, seed, quiet)
    _measure(asked, lambda: _crops("modelonet", 0.5, sampling, rotations))


@bench.command("range-scans")
def range_scans(
    data: Data = "procedural",
    pairs: Pairs = 300,
    weights: SeveralWeights = None,
    baselines: Matchers = "",
    points: Points = _DEFAULTS.points,
    workers: Workers = 1,
    json_out: JsonOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Virtual range scans of whole shapes from two sides, in random poses, by overlap band."""
    asked = _Asked(data, pairs, weights, baselines, points, workers, json_out, overwrite, device, seed, quiet)
    _measure(asked, _range_scans)


@dataclass(frozen=True)
class _Asked:
    """What the protocols on synthetic pairs are asked for alike."""

    data: str
    pairs: int
    weights: list[str] | None
    baselines: str
    points: int
    workers: int
    json_out: Path | None
    overwrite: bool
    device: str
    seed: int
    quiet: bool


def _measure(asked: _Asked, make_protocol: Callable[[], AnyProtocol]) -> None:
    from utopic_cli.io.output import check_writable, write_atomically

    if asked.json_out is not None:
        check_writable([asked.json_out], asked.overwrite)
    baselines = _names(asked.baselines)
    console = Console(quiet=asked.quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.matcher import check_baselines
        from utopic_cli.benchmark.synthetic import render, run
        from utopic_cli.synthesis.packing import open_shapes

        check_baselines(baselines)
        step("making shapes" if asked.data == "procedural" else f"reading shapes from {asked.data}")
        shapes = open_shapes(asked.data, progress=countdown(step))
        step("starting")
        report = run(
            make_protocol(),
            shapes,
            asked.data,
            pairs=asked.pairs,
            seed=asked.seed,
            weights=asked.weights if asked.weights is not None else [_DEFAULTS.weights],
            baselines=baselines,
            workers=asked.workers,
            points=asked.points,
            device=asked.device,
            progress=countdown(step),
        )
    if asked.json_out is not None:  # before anything that stdout could spoil
        write_atomically(asked.json_out, report.to_json().encode("utf-8"), overwrite=asked.overwrite)
        console.line(f"wrote {asked.json_out}")
    from rich.console import Console as RichConsole

    out = RichConsole()
    # A file or a pipe has no width: the tables get theirs.
    render(report, out if out.is_terminal else RichConsole(width=TABLE_WIDTH))


def _crops(name: str, keep: float, sampling: str, rotations: str | None) -> AnyProtocol:
    from utopic_cli.benchmark.protocols import CropProtocol

    return CropProtocol(name, keep, sampling, rotations or ("euler45" if sampling == "shared" else "uniform"))


def _range_scans() -> AnyProtocol:
    from utopic_cli.benchmark.protocols import RangeProtocol

    return RangeProtocol()


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def countdown(step: Callable[[str], None]) -> Callable[[int, int, str], None]:
    """Say how much is done and about how long the rest takes, at the pace so far."""
    begin = time.monotonic()

    def progress(done: int, total: int, what: str) -> None:
        left = ""
        if done:
            minutes, seconds = divmod(round((time.monotonic() - begin) / done * (total - done)), 60)
            left = f", about {minutes}:{seconds:02d} left"
        step(f"{done}/{total}{left}: {what}")

    return progress
