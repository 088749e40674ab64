"""What the commands say on stderr, and the options they share."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any, Literal

import typer

_DEBUG = "utopic_cli.debug"

SOLVING = "How to align"
RUNNING = "How to run"
SECONDS_BETWEEN_LINES = 10.0  # of progress, where stderr is a file or a pipe


def debug_wanted(ctx: Any) -> bool:
    """Tell whether --debug was given to the command that ran under this context."""
    return bool(ctx.meta.get(_DEBUG, False))


def _remember_debug(ctx: typer.Context, wanted: bool) -> bool:
    # The context's meta is shared with the parents: the door in cli.py reads it there.
    ctx.meta[_DEBUG] = wanted
    return wanted


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing on stderr but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more: seconds per step, weights.")]
Debug = Annotated[
    bool,
    typer.Option("--debug", callback=_remember_debug, is_eager=True, help="Show tracebacks of errors."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]

Weights = Annotated[
    str,
    typer.Option(
        metavar="NAME|PATH",
        help="Bundled weights by name, or a .safetensors file with its JSON card beside it.",
        rich_help_panel=SOLVING,
    ),
]
Device = Annotated[
    Literal["auto", "cpu", "cuda", "mps"],
    typer.Option(help="Where the network runs.", rich_help_panel=RUNNING),
]
Threads = Annotated[
    int,
    typer.Option(min=0, help="CPU threads; 0: the library's choice.", rich_help_panel=RUNNING),
]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        help="Seed of every random draw; the same seed on the same kind of machine gives the same bits.",
        rich_help_panel=RUNNING,
    ),
]


class Console:
    """Lines and progress on stderr; stdout is left to results.

    Attributes:
        quiet: say nothing.
        verbose: say more.
    """

    def __init__(self, quiet: bool = False, verbose: bool = False) -> None:
        """Open stderr."""
        from rich.console import Console as RichConsole

        self.quiet = quiet
        self.verbose = verbose
        self._rich = RichConsole(stderr=True, highlight=False, emoji=False)

    def line(self, text: str = "") -> None:
        """Write one line, unless quiet."""
        if not self.quiet:
            self._rich.print(" ".join(text.splitlines()), markup=False, soft_wrap=True)

    def detail(self, text: str) -> None:
        """Write one line if verbose."""
        if self.verbose:
            self.line(text)

    def warnings(self, texts: tuple[str, ...]) -> None:
        """Write warnings, one line each."""
        for text in texts:
            self.line(f"utopic: warning: {text}")

    @contextmanager
    def progress(self) -> Iterator[Callable[[str], None]]:
        """Show the step at work while the block runs; where there is no terminal, a line now and then.

        Yields:
            A function to call with the name of each step as it begins.
        """
        if self.quiet or not self._rich.is_terminal:
            yield self._now_and_then()
            return
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
        with Progress(
            *columns, console=self._rich, transient=True, redirect_stdout=False, redirect_stderr=False
        ) as bar:
            task = bar.add_task("starting", total=None)
            yield lambda step: bar.update(task, description=step)

    def _now_and_then(self) -> Callable[[str], None]:
        said = time.monotonic()

        def progress(step: str) -> None:
            nonlocal said
            if time.monotonic() - said >= SECONDS_BETWEEN_LINES:
                said = time.monotonic()
                self.line(f"  at work: {step}")

        return progress


@contextmanager
def stopwatch(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Add the wall time of the block to ``seconds[step]``."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[step] = seconds.get(step, 0.0) + time.perf_counter() - start
