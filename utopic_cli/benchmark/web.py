"""The pieces that the pages of all protocols are put together from."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from utopic_cli.page.skeleton import resource, whole_page

if TYPE_CHECKING:
    from rich.table import Table


def document(template: str, fills: Mapping[str, str]) -> str:
    """Fill a template of this folder, the body of a page whose title is ``fills["title"]`` (HTML)."""
    style, body = resource(__package__, "page.css"), resource(__package__, template)
    return whole_page(fills["title"], style, body, fills)


def plain_table(
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    ends: Sequence[int] = (),
    words: Sequence[int] = (),
) -> str:
    """Return a table of plain text.

    Args:
        headings: of the columns.
        rows: cells.
        ends: rows, from 0, below which a stronger line is drawn.
        words: columns, from 0, that hold words and not numbers; the first always does.
    """

    def cells(row: Sequence[str], tag: str) -> str:
        looks = [' class="words"' if place in words else "" for place in range(len(row))]
        return "".join(f"<{tag}{look}>{html.escape(cell)}</{tag}>" for look, cell in zip(looks, row))

    lines = []
    for place, row in enumerate(rows):
        look = ' class="end"' if place in ends else ""
        lines.append(f"<tr{look}>{cells(row, 'td')}</tr>")
    if not lines:
        return "<p>None.</p>"
    head = cells(headings, "th")
    body = "\n".join(lines)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def printed_table(table: Table) -> str:
    """Return a table as it is printed in the terminal: title, cells, caption."""
    from rich.text import Text

    def plain(markup: object) -> str:
        return Text.from_markup(str(markup)).plain

    headings = [plain(column.header) for column in table.columns]
    for place, heading in enumerate(headings):  # "\nmedian" stands under the words of its left neighbour
        if heading.startswith("\n"):
            headings[place] = headings[place - 1].split("\n")[0] + heading
    rows = list(zip(*([plain(cell) for cell in column.cells] for column in table.columns)))
    ends = [place for place, row in enumerate(table.rows) if row.end_section]
    parts = [f"<h2>{html.escape(plain(table.title))}</h2>" if table.title else ""]
    words = [place for place, column in enumerate(table.columns) if column.justify == "left"]
    parts.append(plain_table([heading.replace("\n", " ") for heading in headings], rows, ends, words))
    parts.append(f"<p>{html.escape(plain(table.caption))}</p>" if table.caption else "")
    return "\n".join(filter(None, parts))


def figure(svg: str, name: str, caption: str, series: Sequence[str] = ()) -> str:
    """Frame an SVG chart with its name, a key to its lines, and what is to be seen.

    Args:
        svg: the chart.
        name: plain text, as all that follows.
        caption: what is to be seen.
        series: names of the lines, whose looks are ``s0``, ``s1`` and so on.
    """
    key = "".join(
        f'<span class="key k{place}">{html.escape(one)}</span> ' for place, one in enumerate(series)
    )
    caption = f"<figcaption><b>{html.escape(name)}.</b> {html.escape(caption)} {key}</figcaption>"
    return f"<figure>{svg}{caption}</figure>"
