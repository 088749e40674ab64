"""A batch as one self-contained page: the graph, the groups, and what became of every pair."""

from __future__ import annotations

import html
import math

from utopic_cli import __version__
from utopic_cli.multiway.model import REJECTED, USED
from utopic_cli.multiway.outcome import BatchOutcome

GROUP_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")
_ALONE = "#999999"
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;width:100%;margin:1rem 0}td,th{padding:.25rem .6rem;text-align:left;
border-bottom:1px solid #ddd}td.n{text-align:right;font-variant-numeric:tabular-nums}
tr.used td:first-child{border-left:4px solid #009e73}tr.rejected td:first-child{border-left:4px solid #d55e00}
svg{max-width:100%;height:auto}svg text{font:11px system-ui,sans-serif}
"""


def batch_page(outcome: BatchOutcome) -> bytes:
    """Return the page as UTF-8 HTML that opens without a network."""
    placed = sum(entry.group is not None for entry in outcome.scans)
    groups = len(outcome.model.groups)
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>utopic batch</title>",
        f"<style>{_STYLE}</style><h1>{placed} of {len(outcome.scans)} files placed, "
        f"{groups} group{'' if groups == 1 else 's'}</h1>",
        f"<p>{len(outcome.model.pairs)} pairs tried. <code>p_world = T_world_scan @ p_scan</code>; each "
        "group's world frame is that of its first scan. Green lines hold the model together, orange "
        "ones were rejected.</p>",
        _graph(outcome),
        "<h2>Scans</h2><table><tr><th>scan<th>group<th>status<th>points<th>reason</tr>",
        *(_scan_row(outcome, number) for number in range(len(outcome.scans))),
        "</table><h2>Pairs</h2><table><tr><th>source--target<th>verdict<th>overlap<th>confidence"
        "<th>loops for, against<th>missed<th>reason</tr>",
        *(_pair_row(outcome, index) for index in range(len(outcome.model.pairs))),
        "</table>",
    ]
    if outcome.notes:
        parts.append("<h2>Notes</h2><ul>" + "".join(f"<li>{_text(note)}" for note in outcome.notes) + "</ul>")
    parts.append(f"<p>utopic-cli {__version__}, weights {_text(outcome.weights['name'])}</p></html>\n")
    return "\n".join(parts).encode("utf-8")


def _graph(outcome: BatchOutcome) -> str:
    """Draw scans on a circle, group by group, and the pairs that count or were rejected."""
    order = sorted(range(len(outcome.scans)), key=lambda i: (outcome.scans[i].group or len(outcome.scans), i))
    place = {}
    for i, number in enumerate(order):
        angle = 2.0 * math.pi * i / len(order)
        place[number] = (320.0 + 240.0 * math.cos(angle), 280.0 + 240.0 * math.sin(angle))
    parts = ["<svg viewBox='0 0 640 560' role='img' aria-label='scans and the pairs between them'>"]
    for pair in outcome.model.pairs:
        if pair.verdict in (USED, REJECTED):
            (x1, y1), (x2, y2) = place[pair.source], place[pair.target]
            colour = "#009e73" if pair.verdict == USED else "#d55e00"
            width = 0.5 + 3.0 * (pair.overlap or 0.0)
            dash = "" if pair.verdict == USED else " stroke-dasharray='4 4'"
            parts.append(
                f"<line x1='{x1:.1f}' y1='{y1:.1f}' x2='{x2:.1f}' y2='{y2:.1f}' stroke='{colour}' "
                f"stroke-width='{width:.1f}' stroke-opacity='.6'{dash}/>"
            )
    for number, (x, y) in place.items():
        entry = outcome.scans[number]
        colour = _ALONE if entry.group is None else GROUP_COLOURS[(entry.group - 1) % len(GROUP_COLOURS)]
        anchor = "start" if x >= 320 else "end"
        name = entry.file.name if len(entry.file.name) <= 16 else entry.file.name[:15] + "…"
        shift = 10 if x >= 320 else -10
        parts.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='6' fill='{colour}'/>")
        if len(place) <= 60:
            parts.append(
                f"<text x='{x + shift:.1f}' y='{y + 4:.1f}' text-anchor='{anchor}'>{_text(name)}</text>"
            )
    return "".join([*parts, "</svg>"])


def _scan_row(outcome: BatchOutcome, number: int) -> str:
    entry = outcome.scans[number]
    status, reason = entry.status
    cells = [_text(entry.file.name), str(entry.group or ""), status]
    points = "" if entry.points is None else f"{entry.points:,}"
    return "<tr><td>" + "<td>".join(cells) + f"<td class='n'>{points}<td>{_text(reason)}</tr>"


def _pair_row(outcome: BatchOutcome, index: int) -> str:
    pair = outcome.model.pairs[index]
    record = outcome.records[pair.source, pair.target]
    confidence = record["report"]["confidence"] if record["status"] == "done" else None
    shares = [
        "" if value is None else f"{value:.{digits}%}"
        for value, digits in ((pair.overlap, 0), (confidence, 0), (pair.missed, 2))
    ]
    loops = "" if pair.belief is None else f"{pair.belief.agree}, {pair.belief.disagree}"
    name = _text(outcome.pair_name(pair.source, pair.target))
    return (
        f"<tr class='{pair.verdict}'><td>{name}<td>{pair.verdict}<td class='n'>{shares[0]}"
        f"<td class='n'>{shares[1]}<td>{loops}<td class='n'>{shares[2]}<td>{_text(pair.reason)}</tr>"
    )


def _text(text: str) -> str:
    """Return text for a page, whatever of a file's name it quotes."""
    return html.escape(text.encode("utf-8", "backslashreplace").decode("utf-8"))
