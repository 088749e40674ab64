"""Stdout for tables: as they are where there is room, else a paragraph for each row."""

from __future__ import annotations

from typing import Any

from rich.console import Console, Group
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

_ANY_WIDTH = 10_000


class ResultConsole(Console):
    """A console that never cuts a number off."""

    def print(self, *objects: Any, **settings: Any) -> None:
        """Print as rich does, but tables that are too wide for the terminal row by row."""
        super().print(*(self._fitting(one) if isinstance(one, Table) else one for one in objects), **settings)

    def _fitting(self, table: Table) -> Any:
        room = self.options.update(width=_ANY_WIDTH, max_width=_ANY_WIDTH)
        wide = Measurement.get(self, room, table).maximum
        return table if wide <= self.width else self._rows(table)

    def _rows(self, table: Table) -> Group:
        """Return a paragraph for each row: its labels, then its numbers with their headings."""
        columns = [
            (self._text(one.header), one.justify == "right", [self._text(cell) for cell in one.cells])
            for one in table.columns
        ]
        labels = [column for column in columns if not column[1]]
        numbers = [column for column in columns if column[1]]
        said: list[Any] = []
        if table.title:
            said.append(Text.from_markup(str(table.title), style="italic"))
        before = [""] * len(labels)
        for row in range(table.row_count):
            # A label that is left out is that of the row above.
            before = [cells[row].plain or before[i] for i, (_, _, cells) in enumerate(labels)]
            said.append(Text(", ".join(filter(None, before)), style="bold"))
            pairs = [(heading.plain, cells[row].plain) for heading, _, cells in numbers]
            said.append(Padding(Text("\n".join(self._lines(pairs))), (0, 0, 0, 2)))
        if table.caption:
            said.append(Text.from_markup(str(table.caption), style="dim"))
        return Group(*said)

    def _lines(self, pairs: list[tuple[str, str]]) -> list[str]:
        """Return numbers with their headings as lines that only break between two of them."""
        lines = [""]
        for name, value in pairs:
            if value in ("", "-"):
                continue
            said = f"{name} {value}"
            if lines[-1] and len(lines[-1]) + len(said) + 5 > self.width:
                lines[-1] += ";"
                lines.append("")
            lines[-1] += f";  {said}" if lines[-1] else said
        return lines

    def _text(self, cell: Any) -> Text:
        text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
        return Text(" ".join(text.plain.split()))
