"""A batch as one self-contained page: the model, the graph, and what became of every scan and pair."""

from __future__ import annotations

import base64
import html
import math
from typing import Any

import numpy as np

from utopic_cli import __version__
from utopic_cli.geometry.rigid import apply
from utopic_cli.multiway.colours import scan_colour
from utopic_cli.multiway.model import FAILED, REJECTED, UNCONFIRMED, UNUSABLE, USED, PairAnswer
from utopic_cli.multiway.outcome import NOTHING, WHOLE, BatchOutcome
from utopic_cli.multiway.tasks import sample_of
from utopic_cli.page.skeleton import resource, script_json, whole_page

MOST_POINTS = 60_000
"""Points of a model that the page draws at most."""

MOST_MODELS = 8
"""Groups that the page draws, the largest."""

GROUP_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#b8a800")
_ALONE = "#8a8a8a"
_MOST_NAMES = 60  # beyond, names in the graph would hide each other
_NAME_LENGTH = 14
_OPEN = 100  # more pairs of one kind are folded away at first
_MEANING = {
    USED: "hold the model together",
    REJECTED: "contradict their group",
    UNCONFIRMED: "too little evidence to join anything",
    UNUSABLE: "can't be edges",
    FAILED: "no answer",
}


def batch_page(outcome: BatchOutcome) -> bytes:
    """Return the page as UTF-8 HTML that opens without a network."""
    placed = sum(entry.group is not None for entry in outcome.scans)
    wanted = sum(entry.passed_over is None for entry in outcome.scans)
    count = len(outcome.model.groups)
    groups = "one group" if count == 1 else f"{count} groups"
    kind, mark = {WHOLE: ("yes", "✓"), NOTHING: ("no", "✗")}.get(outcome.exit_code, ("none", "!"))
    verdicts = [pair.verdict for pair in outcome.model.pairs]
    counts = [f"{verdicts.count(verdict)} {verdict}" for verdict in _MEANING if verdict in verdicts]
    left_out = [
        f"{entry.file.name}: {entry.left_out}" for entry in outcome.scans if entry.left_out is not None
    ]
    title = f"A batch of {wanted} scans"
    script = resource(__package__, "page.js")
    fills = {
        "title": title,
        "verdict": kind,
        "mark": mark,
        "headline": f"{placed} of {wanted} scans placed, in {groups}" if count else "No two scans connect",
        "summary": f"{len(verdicts)} pairs tried: {', '.join(counts)}." if verdicts else "No pair was tried.",
        "left_out": _list(left_out),
        "notes": f"<section class='warnings'><h2>Notes</h2>{_list(outcome.notes)}</section>"
        if outcome.notes
        else "",
        "view": _view(outcome),
        "graph": _graph(outcome),
        "scans": "\n".join(_scan_row(outcome, number) for number in range(len(outcome.scans))),
        "pairs": "\n".join(_pairs_of(outcome, verdict) for verdict in _MEANING if verdict in verdicts),
        "made_by": f"utopic-cli {__version__}, weights {_text(outcome.weights['name'])}",
        "model": script_json(_models(outcome)),
        "script": script,
    }
    style = f"{resource('utopic_cli.page', 'page.css')}\n{resource(__package__, 'page.css')}"
    body = resource(__package__, "page.html")
    return whole_page(f"{title} · utopic batch", style, body, fills, only_script=script).encode("utf-8")


def _models(outcome: BatchOutcome) -> list[dict[str, Any]]:
    """Return some points of each group: 16 bits a coordinate, from -1 to 1 across the group."""
    models = []
    for group in outcome.model.groups[:MOST_MODELS]:
        clouds = []
        for scan, transformation in group.T_world_scan.items():
            sample = sample_of(outcome.described[scan])
            each = max(1, MOST_POINTS // len(group.T_world_scan))
            clouds.append(apply(transformation, sample[:: -(-len(sample) // each)]))
        points = np.concatenate(clouds)
        points = points - (points.max(axis=0) + points.min(axis=0)) / 2
        points /= max(float(np.linalg.norm(points, axis=1).max()), 1e-300)
        stored = np.rint(32767 * points).astype("<i2")
        models.append(
            {
                "points": base64.b64encode(stored.tobytes()).decode("ascii"),
                "scan": [len(cloud) for cloud in clouds],
                "colours": [scan_colour(scan) for scan in group.T_world_scan],
            }
        )
    return models


def _view(outcome: BatchOutcome) -> str:
    groups = outcome.model.groups[:MOST_MODELS]
    if not groups:
        return ""
    buttons = "".join(
        f"<button type='button' data-group='{i}' aria-pressed='{str(i == 0).lower()}'>group {i + 1} "
        f"({len(group.T_world_scan)})</button>"
        for i, group in enumerate(groups)
    )
    buttons = f"<div class='buttons' role='group' aria-label='Which group'>{buttons}</div>"
    more = len(outcome.model.groups) - len(groups)
    return (
        f"<section class='card' aria-label='Model'><h2>Model</h2>{buttons if len(groups) > 1 else ''}"
        "<div class='stage'><canvas id='canvas' tabindex='0' role='application' aria-label='The scans of a "
        "group, put together. Arrow keys turn it, plus and minus zoom, 0 resets it.'></canvas>"
        "<p id='no_view'>The model is drawn by a script in this page. Everything else is here without "
        "it.</p></div><p class='small'>A few points of each scan, in the scan's colour (see the table). "
        "Drag to turn, scroll or pinch to zoom."
        f"{f' {more} more groups are not drawn.' if more else ''}</p></section>"
    )


def _graph(outcome: BatchOutcome) -> str:
    """Draw scans on a circle, group by group, and the pairs that count or were rejected."""
    order = sorted(range(len(outcome.scans)), key=lambda i: (outcome.scans[i].group or len(outcome.scans), i))
    named = len(order) <= _MOST_NAMES
    middle, radius = (300.0, 260.0), (170.0 if named else 240.0, 215.0 if named else 240.0)
    place = {}
    for i, number in enumerate(order):
        angle = 2.0 * math.pi * (i + 0.5) / len(order)
        place[number] = tuple(c + r * f(angle) for c, r, f in zip(middle, radius, (math.cos, math.sin)))
    parts = ["<svg class='graph' viewBox='0 0 600 520' role='img' aria-label='scans and pairs'>"]
    for pair in outcome.model.pairs:
        if pair.verdict in (USED, REJECTED):
            (x1, y1), (x2, y2) = place[pair.source], place[pair.target]
            parts.append(
                f"<line class='{pair.verdict}' x1='{x1:.1f}' y1='{y1:.1f}' x2='{x2:.1f}' y2='{y2:.1f}' "
                f"stroke-width='{0.6 + 3.0 * (pair.overlap or 0.0):.1f}'><title>"
                f"{_text(outcome.pair_name(pair.source, pair.target))}: {pair.verdict}</title></line>"
            )
    for number, (x, y) in place.items():
        entry = outcome.scans[number]
        colour = _ALONE if entry.group is None else GROUP_COLOURS[(entry.group - 1) % len(GROUP_COLOURS)]
        said = f"{entry.file.name}: " + (f"group {entry.group}" if entry.group else entry.status[0])
        parts.append(
            f"<circle cx='{x:.1f}' cy='{y:.1f}' r='{6 if named else 4}' fill='{colour}'>"
            f"<title>{_text(said)}</title></circle>"
        )
        if named:
            name = entry.file.name
            name = name if len(name) <= _NAME_LENGTH else name[: _NAME_LENGTH - 1] + "…"
            anchor, shift = ("start", 11) if x >= middle[0] else ("end", -11)
            parts.append(
                f"<text x='{x + shift:.1f}' y='{y + 4:.1f}' text-anchor='{anchor}'>{_text(name)}</text>"
            )
    return "".join([*parts, "</svg>"])


def _scan_row(outcome: BatchOutcome, number: int) -> str:
    entry = outcome.scans[number]
    status, reason = entry.status
    colour = f"rgb{scan_colour(number)}" if entry.group is not None else "transparent"
    points = "" if entry.points is None else f"{entry.points:,}"
    return (
        f"<tr><td class='name'><i class='swatch' style='background:{colour}'></i>"
        f"<bdi>{_text(entry.file.name)}</bdi><td class='n'>{entry.group or ''}<td class='status'>{status}"
        f"<td class='n'>{points}<td class='reason'>{_text(reason)}</tr>"
    )


def _pairs_of(outcome: BatchOutcome, verdict: str) -> str:
    pairs = [pair for pair in outcome.model.pairs if pair.verdict == verdict]
    head = "".join(
        f"<th scope='col'{' class=n' if number else ''}>{name}"
        for name, number in (
            ("source--target", False),
            ("overlap", True),
            ("confidence", True),
            ("loops", True),
            ("missed", True),
            ("why", False),
        )
    )
    rows = "\n".join(_pair_row(outcome, pair) for pair in pairs)
    return (
        f"<details{' open' if len(pairs) <= _OPEN else ''}><summary>{len(pairs)} {verdict}: "
        f"{_MEANING[verdict]}</summary><div class='wide' tabindex='0' role='group' "
        f"aria-label='Table of pairs that are {verdict}'><table class='pairs'><thead><tr>{head}</tr></thead>"
        f"<tbody>\n{rows}\n</tbody></table></div></details>"
    )


def _pair_row(outcome: BatchOutcome, pair: PairAnswer) -> str:
    record = outcome.records[pair.source, pair.target]
    report = record["report"] if record["status"] == "done" else {}
    shares = [
        "" if value is None else f"{value:.{digits}%}"
        for value, digits in ((pair.overlap, 0), (report.get("confidence"), 0), (pair.missed, 2))
    ]
    names = [_text(outcome.scans[scan].file.name) for scan in (pair.source, pair.target)]
    loops = "" if pair.loops is None else f"{pair.loops[0]} / {pair.loops[1]}"
    return (
        f"<tr><td class='name'><bdi>{names[0]}</bdi>--<br><bdi>{names[1]}</bdi>"
        f"<td class='n'>{shares[0]}<td class='n'>{shares[1]}<td class='n'>{loops}<td class='n'>{shares[2]}"
        f"<td class='reason'>{_text(pair.reason)}{_list(report.get('reasons') or ())}</tr>"
    )


def _list(texts: Any) -> str:
    return "<ul>" + "".join(f"<li>{_text(text)}</li>" for text in texts) + "</ul>" if texts else ""


def _text(text: str) -> str:
    """Return text for a page, whatever of a file's name it quotes."""
    return html.escape(text.encode("utf-8", "backslashreplace").decode("utf-8"))
