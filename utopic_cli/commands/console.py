"""What the commands say on stderr, and the options they share."""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from utopic_cli.config import AlignOptions, ColourMapName
from utopic_cli.errors import OutputError
from utopic_cli.io.files import printable

_DEBUG = "utopic_cli.debug"

DEFAULTS = AlignOptions()
"""What the options below are where they are not given."""

MEASURING = "What to measure"
WRITING = "What to write"
SOLVING = "How to align"
RUNNING = "How to run"
SHAPES = "procedural|DIR|modelnet40:DIR"  # what --data takes
LABEL_WIDTH = 9
BAR_WIDTH = 16
SECONDS_BETWEEN_LINES = 10.0  # of progress, where stderr is a file or a pipe
_COUNT = re.compile(r"(\d+)/(\d+)\b")
_BRACED = re.compile(r"\{(.+)\}(|\.\.\.)$")


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
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace existing files.", rich_help_panel=WRITING)
]


def complete_weights(incomplete: str) -> list[str]:
    """Return what a shell may complete ``--weights`` to: bundled names, files and folders."""
    from utopic_cli.model.bundled import bundled_weights

    typed = Path(incomplete)
    folder = typed if incomplete.endswith("/") else typed.parent
    try:
        there = [path for path in sorted(folder.iterdir()) if path.is_dir() or path.suffix == ".safetensors"]
    except OSError:
        there = []
    words = [*bundled_weights(), *(f"{path}/" if path.is_dir() else str(path) for path in there)]
    return [word for word in words if word.startswith(incomplete)]


Weights = Annotated[
    str,
    typer.Option(
        metavar="NAME|PATH",
        help="Bundled weights by name, or a .safetensors file with its JSON card beside it.",
        rich_help_panel=SOLVING,
        autocompletion=complete_weights,
    ),
]
MostPoints = Annotated[
    int,
    typer.Option(min=50, help="Most points per scan the network sees.", rich_help_panel=SOLVING),
]
MaxRotation = Annotated[
    float,
    typer.Option(
        metavar="DEG",
        min=1.0,
        max=180.0,
        help="The source is turned by so many degrees at most, from where it lies or an initial "
        "transformation puts it; 180: any pose.",
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

Colormap = Annotated[
    ColourMapName,
    typer.Option(
        metavar="MAP",
        help="Colours of overlap and uncertainty. blue-red: redder is more; purple-yellow: lighter is more, "
        "for every kind of colour vision.",
        rich_help_panel=WRITING,
    ),
]


class PlainUsage(TyperCommand):
    """A command whose usage line names its arguments as the help text does, without braces."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words after the command's name."""
        return [_BRACED.sub(_unbraced, piece) for piece in super().collect_usage_pieces(ctx)]


def _unbraced(found: re.Match[str]) -> str:
    return found[1] if "..." in found[1] else found[1] + found[2]


def _one_line(text: str) -> str:
    return " ".join(printable(text).splitlines())


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
            self._rich.print(_one_line(text), markup=False, soft_wrap=True)

    def headline(self, about: str, verdict: str, good: bool) -> None:
        """Write what it is about and how it went, which stands out on a terminal."""
        if not self.quiet:
            from rich.text import Text

            text = Text(_one_line(about) + " ")
            text.append(verdict, style="bold green" if good else "bold yellow")
            self._rich.print(text, soft_wrap=True)

    def fact(self, label: str, text: str, style: str = "") -> None:
        """Write one labelled line, unless quiet; on a terminal wrapped, the text in a column of its own.

        Args:
            label: a word.
            text: what it is.
            style: of the text, in rich's words; plain where there is no colour.
        """
        if self.quiet:
            return
        if not self._rich.is_terminal:
            self.line(f"  {label:<{LABEL_WIDTH}}{text}")
            return
        from rich.table import Table
        from rich.text import Text

        row = Table.grid()
        row.add_column(width=2 + LABEL_WIDTH, no_wrap=True)
        row.add_column(overflow="fold")
        row.add_row(Text(f"  {label}", style="dim"), Text(_one_line(text), style=style))
        self._rich.print(row)

    def files(self, paths: Sequence[Path]) -> None:
        """Say which files were written, a line for each folder."""
        folders: dict[Path, list[str]] = {}
        for path in paths:
            folders.setdefault(path.parent, []).append(path.name)
        for folder, names in folders.items():
            text = str(folder / names[0]) if len(names) == 1 else f"{folder}{os.sep}: {', '.join(names)}"
            self.fact("wrote", text)

    def detail(self, text: str) -> None:
        """Write one line if verbose."""
        if self.verbose:
            self.line(text)

    def warnings(self, texts: tuple[str, ...]) -> None:
        """Write warnings, one line each."""
        for text in texts:
            self.line(f"utopic: warning: {text}")

    @contextmanager
    def progress(self, lines: bool = True) -> Iterator[Callable[[str], None]]:
        """Show the step at work while the block runs, and if verbose what the library logs.

        Args:
            lines: say a step now and then where there is no terminal; not for seconds of work.

        Yields:
            A function to call with the name of each step as it begins. One that begins with a count,
            like "12/90", gets a bar.
        """
        with self._log_lines(), self._steps(lines) as progress:
            yield progress

    @contextmanager
    def _log_lines(self) -> Iterator[None]:
        if not self.verbose:
            yield
            return
        logger, handler = logging.getLogger("utopic_cli"), _LogLines(self)
        level = logger.level
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        try:
            yield
        finally:
            logger.setLevel(level)
            logger.removeHandler(handler)

    @contextmanager
    def _steps(self, lines: bool) -> Iterator[Callable[[str], None]]:
        """Show the step at work; where there is no terminal, a line now and then."""
        if self.quiet or not self._rich.is_terminal:
            yield self._now_and_then() if lines else _unsaid
            return
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.table import Column

        alone = Column(no_wrap=True, overflow="ellipsis", ratio=1)
        what = TextColumn("{task.description}", markup=False, table_column=alone)
        columns = (SpinnerColumn(), BarColumn(bar_width=BAR_WIDTH), what, TimeElapsedColumn())
        with Progress(
            *columns, console=self._rich, transient=True, redirect_stdout=False, redirect_stderr=False
        ) as bar:
            task = bar.add_task("starting", total=None)

            def progress(step: str) -> None:
                count = _COUNT.match(step)
                done, total = (int(count[1]), int(count[2])) if count else (0, None)
                bar.update(task, description=step, completed=done, total=total)

            yield progress

    def _now_and_then(self) -> Callable[[str], None]:
        said = time.monotonic()

        def progress(step: str) -> None:
            nonlocal said
            if time.monotonic() - said >= SECONDS_BETWEEN_LINES:
                said = time.monotonic()
                self.line(f"  at work: {step}")

        return progress


def _unsaid(step: str) -> None:
    """Take a step's name that nobody is told."""


class _LogLines(logging.Handler):
    """Steps that the library logs, as lines; its warnings are said by the commands themselves."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno < logging.WARNING:
            self._console.fact("step", record.getMessage())


def to_stdout(data: bytes) -> None:
    """Write a result, ASCII text, to stdout.

    Raises:
        OutputError: stdout is closed or can't be written.
    """
    if sys.stdout is None:  # closed by whoever started this process
        raise OutputError("stdout: can't be written: it is closed; name a file with -o")
    try:
        sys.stdout.write(data.decode("ascii"))
        sys.stdout.flush()
    except OSError as error:
        raise OutputError(f"stdout: can't be written: {error.strerror}; name a file with -o") from error


@contextmanager
def stopwatch(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Add the wall time of the block to ``seconds[step]``."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[step] = seconds.get(step, 0.0) + time.perf_counter() - start
