"""What the reports of the protocols share: tables and their cells, the printing, JSON with a row a line."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from utopic_cli.benchmark.synthetic_summary import Share

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


HASH = 12
"""Digits of the hash of weights that titles and tables show; the JSON has them all."""


class Tabled(Protocol):
    """A report in tables."""

    def tables(self) -> list[Table]:
        """Return them in order."""

    def losses(self) -> list[str]:
        """Say what must be known beside them, by lines."""


def render(report: Tabled, console: Console) -> None:
    """Print the tables, and what must be known beside them."""
    for table in report.tables():
        console.print(table)
    for line in report.losses():
        console.print(line, markup=False, highlight=False)


def make_table(title: str, caption: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """Return an empty table.

    Args:
        title: plain text, as the caption.
        caption: what its reader must know.
        words: headings of the first columns.
        numbers: headings of the others, which are aligned at the right.
    """
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title), caption=escape(caption))
    for heading in words:
        table.add_column(heading)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def with_weights(title: str, weights: Iterable[tuple[str, str]]) -> str:
    """Say in a title which weights were measured.

    Args:
        title: of a report.
        weights: names with the sha256 of their files; where there are none, the title stays as it is.
    """
    named = ", ".join(f"{name} (sha256 {sha256[:HASH]})" for name, sha256 in weights)
    return f"{title}, weights {named}" if named else title


def counted(count: int, what: str) -> str:
    """Write how many there are of what is called so in the singular."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def add_groups(table: Table, rows: Iterable[Sequence[str]]) -> None:
    """Add rows whose first cell names their group: it is said once, and a line is drawn between groups."""
    previous = ""
    for group, *cells in rows:
        if group != previous and previous:
            table.add_section()
        table.add_row("" if group == previous else group, *cells)
        previous = group


def number(value: float | None, form: str) -> str:
    """Write a number, or a dash where there is none."""
    return "-" if value is None else form.format(value)


def share(value: Share | None) -> str:
    """Write a share with its 95 % interval."""
    if value is None:
        return "-"
    return f"{value.share:.1%} of {value.of} [{100 * value.low:.1f}-{100 * value.high:.1f}]"


def share_cell(value: Share) -> str:
    """Write a share with its interval, shorter and as markup."""
    return f"{value.share:.1%} \\[{100 * value.low:.0f}-{100 * value.high:.0f}]"


def json_by_rows(content: dict[str, Any], name: str, rows: Iterable[dict[str, Any]]) -> str:
    """Return content as JSON text, indented, and at its end under ``name`` many rows, one a line."""
    head = json.dumps(content, indent=2, allow_nan=False)
    lines = ",\n    ".join(json.dumps(row, allow_nan=False) for row in rows)
    return f'{head[:-2]},\n  "{name}": [\n    {lines}\n  ]\n}}\n'
