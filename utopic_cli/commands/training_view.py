"""How a training run looks while it goes on: live on a terminal, else a line a record."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

from utopic_cli.commands.console import Console
from utopic_cli.training.curves import SPEED, is_share, kind_of, label_of, readable

if TYPE_CHECKING:
    from rich.console import Group, RenderableType

Record = Mapping[str, Any]


class TrainingView:
    """Shows the records of a run; used as a context manager around it."""

    def __init__(self, console: Console) -> None:
        """Prepare; nothing is shown before the block begins."""
        self._console = console
        self._record: Record | None = None
        self._came = time.monotonic()
        self._first: Record = {}
        self._before: Record = {}
        self._last: Record = {}
        self._live: Any = None

    def __enter__(self) -> TrainingView:
        from rich.console import Console as RichConsole
        from rich.live import Live

        rich = RichConsole(stderr=True, highlight=False, emoji=False)
        if rich.is_terminal and not self._console.quiet:
            # Results go to stdout, which stays as it is; what is logged appears above the view.
            self._live = Live(
                get_renderable=self._render, console=rich, refresh_per_second=2, redirect_stdout=False
            )
            self._live.start()
        self._came = time.monotonic()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, record: Record) -> None:
        """Show one record of the journal."""
        validation = {name: value for name, value in record.items() if kind_of(name) == "validation"}
        if validation:
            self._before, self._last = self._last, validation
            self._first = self._first or validation
        self._record, self._came = record, time.monotonic()
        if self._live is None:
            self._console.line(describe(record, self._before if validation else {}))

    def outcome(self) -> str:
        """Return the last validation beside the first, or where the run ended if there is none."""
        told = [
            f"{label_of(name)} {readable(name, value)}"
            + (f" (at first {readable(name, self._first[name])})" if name in self._first else "")
            for name, value in self._last.items()
        ]
        pairs = f"{self._record['pairs']:,} pairs seen" if self._record else "no pairs seen"
        return f"{pairs}; {', '.join(told)}" if told else pairs

    def _render(self) -> RenderableType:
        from rich.text import Text

        if self._record is None:
            waited = clock(time.monotonic() - self._came)
            return Text(f"making the first pairs, {waited}; the first record takes a while", style="dim")
        return _panel(self._record, time.monotonic() - self._came, self._last, self._before)


def describe(record: Record, before: Record | None = None) -> str:
    """Return one record of the journal as one line.

    Args:
        record: see ``Journal.write``.
        before: the validation before this one, to compare with.
    """
    parts = [f"{record['pairs']}/{record['of']} pairs", str(record["stage"]), _times(record, 0.0)]
    for name, value in record.items():
        if kind_of(name) == "about" or name in ("rate", "gradient"):
            continue
        parts.append(f"{label_of(name)} {readable(name, value)}{_change(name, value, before or {})[0]}")
    return ", ".join(parts)


def clock(seconds: float) -> str:
    """Return a duration as m:ss or h:mm:ss."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _times(record: Record, since: float) -> str:
    """Return the time taken and left, ``since`` seconds after the record."""
    text = clock(record["elapsed_s"] + since)
    left = record.get("left_s")
    if left is None:
        return text
    whole = (record["of"] - record["pairs"]) / max(record["pairs_per_s"], 1e-9)
    if left < 0.9 * whole:  # --minutes ends it before all pairs are seen
        return f"{text}, stops in {clock(left - since)}"
    return f"{text}, about {clock(left - since)} left"


def _change(name: str, value: float, before: Record) -> tuple[str, str]:
    """Return an arrow with the change against the validation before, and its colour."""
    if kind_of(name) != "validation" or name not in before:
        return "", ""
    change = value - before[name]
    size = f"{100 * abs(change):.1f}" if is_share(name) else f"{abs(change):.3g}"
    if not float(size):  # too small to show
        return " unchanged", "dim"
    better = (change > 0) == is_share(name)  # what is no share is an error
    return f" {'▲' if change > 0 else '▼'}{size}", "green" if better else "yellow"


def _panel(record: Record, since: float, validation: Record, before: Record) -> Group:
    """Return three rows: how far, the losses, the last validation with its change."""
    from rich.console import Group
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    head = Table.grid(padding=(0, 2))
    head.add_row(
        Text(f"{record['stage']} stage", style="bold"),
        ProgressBar(total=record["of"], completed=record["pairs"], width=24),
        Text(f"{record['pairs']:,}/{record['of']:,} pairs"),
    )
    speed = [_times(record, since)]
    speed += [f"{readable(name, record[name])} {label_of(name)}" for name in SPEED if name in record]
    rows = Table.grid(padding=(0, 2))
    rows.add_row(Text("time", style="dim"), Text(", ".join(speed)))
    losses = [(name, value) for name, value in record.items() if kind_of(name) == "loss"]
    rows.add_row(Text("loss", style="dim"), _values(losses, {}))
    if validation:
        rows.add_row(Text("validation", style="dim"), _values(list(validation.items()), before))
    return Group(head, rows)


def _values(values: list[tuple[str, float]], before: Record) -> Any:
    from rich.text import Text

    text = Text()
    for number, (name, value) in enumerate(values):
        change, colour = _change(name, value, before)
        # Only the gaps between values may break: a name stays with its number.
        said = f"{label_of(name)} {readable(name, value)}".replace(" ", "\N{NO-BREAK SPACE}")
        text.append("  " if number else "").append(said)
        text.append(change.replace(" ", "\N{NO-BREAK SPACE}"), style=colour)
    return text
