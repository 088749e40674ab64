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
    from utopic_cli.benchmark.result_page import AnyReport

_DEFAULTS = AlignOptions()
TABLE_WIDTH = 160

JsonOut = Annotated[
    Path | None, typer.Option("--json", metavar="OUT", help="Every single result, with all settings.")
]
HtmlOut = Annotated[
    Path | None, typer.Option("--html", metavar="OUT", help="One page with the tables and plots.")
]

bench = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")


@dataclass(frozen=True)
class Outputs:
    """The files a protocol is asked for."""

    json_out: Path | None
    html_out: Path | None
    overwrite: bool

    def check(self) -> None:
        """Refuse, before any work, what can't be written."""
        from utopic_cli.io.output import check_writable

        check_writable([path for path in (self.json_out, self.html_out) if path is not None], self.overwrite)

    def write(self, report: AnyReport, console: Console) -> None:
        """Write them, before anything that stdout could spoil."""
        from utopic_cli.benchmark.result_page import page
        from utopic_cli.io.output import write_atomically

        for path, text in ((self.json_out, report.to_json), (self.html_out, lambda: page(report))):
            if path is not None:
                write_atomically(path, text().encode("utf-8"), overwrite=self.overwrite)
                console.line(f"wrote {path}")


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
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
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
    outputs = Outputs(json_out, html_out, overwrite)
    outputs.check()
    console = Console(quiet=quiet)
    with console.progress() as step:
        step("loading libraries")
        from utopic_cli.benchmark.scans import render, run

        report = run(
            folder,
            pairs=pairs,
            poses=poses,
            seed=seed,
            baselines=names(baselines),
            min_overlap=min_overlap,
            through_cli=through_cli,
            options=AlignOptions(weights=weights, device=device, threads=threads, seed=seed),
            progress=countdown(step),
        )
    outputs.write(report, console)
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
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """The paper's ModelNet protocol: 1,024 points of a shape, both crops keep 70 %."""
    outputs = Outputs(json_out, html_out, overwrite)
    asked = Asked(data, pairs, weights, baselines, points, workers, outputs, device, seed, quiet)
    measure(asked, lambda: _crops("modelnet", 0.7, sampling, rotations))


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
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = _DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """The paper's ModelLoNet protocol: 1,024 points of a shape, both crops keep 50 %."""
    outputs = Outputs(json_out, html_out, overwrite)
    asked = Asked(data, pairs, weights, baselines, points, workers, outputs, device, seed, quiet)
    measure(asked, lambda: _crops("modelonet", 0.5, sampling, rotations))


@bench.command("range-scans")
def range_scans(
    data: Data = "procedural",
    pairs: Pairs = 300,
    weights: SeveralWeights = None,
    baselines: Matchers = "",
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
    """Virtual range scans of whole shapes from two sides, in random poses, by overlap band."""
    outputs = Outputs(json_out, html_out, overwrite)
    asked = Asked(data, pairs, weights, baselines, points, workers, outputs, device, seed, quiet)
    measure(asked, _range_scans)


@dataclass(frozen=True)
class Asked:
    """What the protocols on synthetic pairs are asked for alike."""

    data: str
    pairs: int
    weights: list[str] | None
    baselines: str
    points: int
    workers: int
    outputs: Outputs
    device: str
    seed: int
    quiet: bool


def measure(asked: Asked, make_protocol: Callable[[], AnyProtocol]) -> None:
    """Run a protocol on synthetic pairs, write what was asked for, print its tables."""
    asked.outputs.check()
    baselines = names(asked.baselines)
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
    asked.outputs.write(report, console)
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


def names(text: str) -> list[str]:
    """Take apart a list with commas."""
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
