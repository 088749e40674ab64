"""What the protocols of ``utopic bench`` share: options, files, progress, tables."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from utopic_cli.commands.console import (
    DEFAULTS,
    MEASURING,
    RUNNING,
    SHAPES,
    WRITING,
    Console,
    Debug,
    Device,
    MaxRotation,
    Overwrite,
    Quiet,
    Seed,
    complete_weights,
)

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from utopic_cli.benchmark.result_page import AnyReport
    from utopic_cli.synthesis.shapes import ShapeLibrary

TABLE_WIDTH = 160  # in files and pipes, which have no width of their own
REGISTRATIONS = "open3d-ransac, open3d-ransac-fine, open3d-fgr, open3d-icp, kiss-matcher, small-gicp"

JsonOut = Annotated[
    Path | None,
    typer.Option(
        "--json", metavar="OUT", help="Every single result, with all settings.", rich_help_panel=WRITING
    ),
]
HtmlOut = Annotated[
    Path | None,
    typer.Option(
        "--html", metavar="OUT", help="One page with the tables and plots.", rich_help_panel=WRITING
    ),
]
Data = Annotated[
    str,
    typer.Option(
        metavar=SHAPES,
        help="Shapes that pairs are made of; only those held out from training are used.",
        rich_help_panel=MEASURING,
    ),
]
Pairs = Annotated[
    int,
    typer.Option(min=1, help="Number of pairs; more begin with the same ones.", rich_help_panel=MEASURING),
]
SeveralWeights = Annotated[
    list[str] | None,
    typer.Option(
        "--weights",
        metavar="NAME|PATH",
        help="Weights to measure; may be given several times.",
        show_default=DEFAULTS.weights,
        rich_help_panel=MEASURING,
        autocompletion=complete_weights,
    ),
]
Baselines = Annotated[
    str,
    typer.Option(
        "--baselines",
        metavar="NAME,..",
        help=f"Methods to measure beside: {REGISTRATIONS}.",
        rich_help_panel=MEASURING,
    ),
]
Contestants = Annotated[
    str,
    typer.Option(
        "--baselines",
        metavar="NAME,..",
        help=f"Measure beside: fpfh (features, same solver), {REGISTRATIONS}.",
        rich_help_panel=MEASURING,
    ),
]
Points = Annotated[
    int,
    typer.Option(min=50, help="Most points per cloud that the methods see.", rich_help_panel=MEASURING),
]
Workers = Annotated[
    int,
    typer.Option(
        min=1, help="Processes, one thread each; their number changes no result.", rich_help_panel=RUNNING
    ),
]
Sampling = Annotated[
    Literal["shared", "independent"],
    typer.Option(
        help="Both clouds are crops of one sample (the paper's figures), or of two samples.",
        rich_help_panel=MEASURING,
    ),
]
Rotations = Annotated[
    Literal["euler45", "uniform"] | None,
    typer.Option(
        help="Euler angles in 0 to 45 degrees and translation within 0.5, or uniform over SO(3).",
        show_default="the paper's euler45 for shared, uniform for independent",
        rich_help_panel=MEASURING,
    ),
]


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

        self.write_texts(report.to_json, lambda: page(report), console)

    def write_texts(self, to_json: Callable[[], str], to_html: Callable[[], str], console: Console) -> None:
        """Write what these return, where it is asked for."""
        from utopic_cli.io.output import write_atomically

        for path, text in ((self.json_out, to_json), (self.html_out, to_html)):
            if path is not None:
                write_atomically(path, text().encode("utf-8"), overwrite=self.overwrite)
                console.line(f"wrote {path}")


@dataclass(frozen=True)
class Common:
    """What most protocols are asked for alike."""

    outputs: Outputs
    device: str
    seed: int
    quiet: bool


def with_options_of(collect: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return what gives a function, after its own options, those of another.

    Args:
        collect: the other; the function's first parameter receives what it returns.
    """
    shared = inspect.signature(collect, eval_str=True).parameters

    def give(command: Callable[..., Any]) -> Callable[..., Any]:
        _, *own = inspect.signature(command, eval_str=True).parameters.values()

        def run(**given: Any) -> Any:
            collected = collect(**{name: given.pop(name) for name in shared})
            return command(collected, **given)

        parameters = [*own, *shared.values()]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        run.__name__, run.__doc__ = command.__name__, command.__doc__
        return run

    return give


def _common(
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
    overwrite: Overwrite = False,
    device: Device = "auto",
    seed: Seed = DEFAULTS.seed,
    quiet: Quiet = False,
    debug: Debug = False,
) -> Common:
    return Common(Outputs(json_out, html_out, overwrite), device, seed, quiet)


with_common_options = with_options_of(_common)


@dataclass(frozen=True)
class Asked(Common):
    """What the protocols on synthetic pairs are asked for alike."""

    pairs: int
    weights: list[str] | None
    baselines: str
    points: int
    max_rotation: float
    workers: int


@with_common_options
def _asked(
    common: Common,
    pairs: Pairs = 300,
    weights: SeveralWeights = None,
    baselines: Contestants = "",
    points: Points = DEFAULTS.points,
    max_rotation: MaxRotation = DEFAULTS.max_rotation,
    workers: Workers = 1,
) -> Asked:
    return Asked(
        **vars(common),
        pairs=pairs,
        weights=weights,
        baselines=baselines,
        points=points,
        max_rotation=max_rotation,
        workers=workers,
    )


with_shared_options = with_options_of(_asked)


def open_data(data: str, step: Callable[[str], None]) -> ShapeLibrary:
    """Return the shapes that ``data`` stands for, telling what goes on."""
    from utopic_cli.synthesis.packing import open_shapes

    step("making shapes" if data == "procedural" else f"reading shapes from {data}")
    return open_shapes(data, progress=countdown(step))


def table_console() -> RichConsole:
    """Return stdout for tables, of any width; see ``ResultConsole``."""
    from utopic_cli.commands.result_console import ResultConsole

    console = ResultConsole()
    return console if console.is_terminal else ResultConsole(width=TABLE_WIDTH)


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
