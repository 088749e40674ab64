"""The curves of a training run as one self-contained HTML page."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from utopic_cli.page.skeleton import resource, script_json, whole_page
from utopic_cli.training.network import LossWeights

MOST_POINTS = 1500
"""Points of a curve that the page holds at most; longer runs are thinned to means of neighbours."""

SPEED = ("pairs_per_s", "waiting")
OPTIMISER = ("rate", "gradient")
LOSSES = ("loss", *LossWeights._fields)
ABOUT = ("pairs", "of", "stage", "elapsed_s", "left_s")
"""Keys of a record that say where in the run it was made; they are no curves."""

LABELS = {
    "loss": "total loss",
    "pairs_per_s": "pairs/s",
    "waiting": "waiting for pairs",
    "rate": "learning rate",
    "gradient": "gradient norm",
    "known_overlap_accuracy": "known overlap accuracy",
}
TOGETHER = (("hit_rate", "match_rate", "inlier_ratio"), ("overlap_accuracy", "known_overlap_accuracy"))
"""Validation metrics that are read against each other and share a chart."""

TABLE = ("validation", "loss", "optimiser", "speed")
"""Order of the kinds in the table of last values."""

SHARES = ("_rate", "_ratio", "_accuracy", "_recall", "_auc", "waiting")
"""Endings of names whose values are shares of one."""


def kind_of(name: str) -> str:
    """Tell what a key of a training record is.

    Returns:
        ``loss``, ``speed``, ``optimiser``, ``about`` (where in the run), or else ``validation``.
    """
    for kind, names in (("loss", LOSSES), ("speed", SPEED), ("optimiser", OPTIMISER), ("about", ABOUT)):
        if name in names:
            return kind
    return "validation"


def is_share(name: str) -> bool:
    """Tell whether a value is a share of one, which is shown as a percentage."""
    return name.endswith(SHARES)


def label_of(name: str) -> str:
    """Return the name of a value as a person reads it."""
    return LABELS.get(name, name.replace("_", " "))


def curves_page(
    records: Sequence[Mapping[str, Any]],
    title: str,
    settings: Mapping[str, Any],
    *,
    now: datetime | None = None,
) -> str:
    """Draw the curves of a run.

    Args:
        records: the run's records in order, as in ``log.jsonl``: ``pairs``, ``of``, ``stage``,
            ``elapsed_s`` (seconds), loss terms, speeds, and validation metrics now and then.
        title: name of the run.
        settings: sections of settings, as ``TrainingConfig.as_dict`` gives them.
        now: when the last record was made, while the run goes on: the page stays as it is, so the
            time left is said as of then. Of a run that ended (None) no time is left.

    Returns:
        One HTML page that loads nothing from elsewhere, under 1 MB for a run of any length.
    """
    names = _names(records)
    validations = [record for record in records if any(name in record for name in names["validation"])]
    running = [name for kind in ("loss", "optimiser", "speed") for name in names[kind]]
    data = {
        "records": _table(records, running),
        "validations": _table(validations, names["validation"]),
        "stages": _stage_changes(records),
        "groups": _groups(names),
        "last": _place(records[-1]) if records else {"pairs": 0, "minutes": 0},
    }
    last = records[-1] if records else {}
    fills = {
        "title": html.escape(title),
        "summary": html.escape(_summary(last, now)),
        "percent": f"{100 * last['pairs'] / max(last['of'], 1):.1f}" if last else "0",
        "rows": "\n".join(_row(name, records) for kind in TABLE for name in names[kind]),
        "settings": "\n".join(_setting_rows(settings)),
        "note": html.escape(_note(len(records))),
        "data": script_json(data),
    }
    style, body = resource(__package__, "curves.css"), resource(__package__, "curves.html")
    return whole_page(f"{fills['title']} · training curves", style, body, fills)


def _names(records: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return the names of all numbers by kind, losses in the order of the network's terms."""
    names: dict[str, list[str]] = {kind: [] for kind in TABLE}
    for name in dict.fromkeys(name for record in records for name in record):
        kind = kind_of(name)
        if kind in names and any(_number(record.get(name)) is not None for record in records):
            names[kind].append(name)
    names["loss"].sort(key=LOSSES.index)
    return names


def _table(records: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """Return records as columns, thinned to means over runs of records of one stage."""
    size = math.ceil(len(records) / MOST_POINTS)
    groups: list[list[Mapping[str, Any]]] = []
    for record in records:
        if not groups or len(groups[-1]) >= size or groups[-1][-1]["stage"] != record["stage"]:
            groups.append([])
        groups[-1].append(record)
    places = [_place(group[-1]) for group in groups]
    return {
        "pairs": [place["pairs"] for place in places],
        "minutes": [place["minutes"] for place in places],
        "stage": [html.escape(str(group[-1]["stage"])) for group in groups],
        "values": {name: [_mean(group, name) for group in groups] for name in names},
    }


def _mean(group: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = [value for record in group if (value := _number(record.get(name))) is not None]
    return float(f"{sum(values) / len(values):.5g}") if values else None


def _number(value: Any) -> float | None:
    """Return a finite number, or None: JSON has no other."""
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    return None


def _place(record: Mapping[str, Any]) -> dict[str, float]:
    return {"pairs": record["pairs"], "minutes": round(record["elapsed_s"] / 60, 3)}


def _stage_changes(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"name": html.escape(str(after["stage"])), **_place(before)}
        for before, after in itertools.pairwise(records)
        if before["stage"] != after["stage"]
    ]


def _groups(names: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Say which chart stands where."""
    measured = list(names["validation"])
    together = [[name for name in chart if name in measured] for chart in TOGETHER]
    alone = [[name] for name in measured if not any(name in chart for chart in together)]
    layout = (
        ("Validation on held-out pairs", "validations", [chart for chart in together if chart] + alone),
        ("Loss", "records", [[name] for name in names["loss"]]),
        ("Rate and speed", "records", [[name] for name in (*names["optimiser"], *names["speed"])]),
    )
    return [
        {
            "title": title,
            "large": table == "validations",
            "charts": [_chart(chart, table) for chart in charts],
        }
        for title, table, charts in layout
        if charts
    ]


def _chart(names: Sequence[str], table: str) -> dict[str, Any]:
    kind = kind_of(names[0])
    return {
        "names": list(names),
        "labels": [html.escape(label_of(name)) for name in names],
        "table": table,
        "smooth": kind in ("loss", "speed") or names[0] == "gradient",
        "dots": kind == "validation",
        "share": is_share(names[0]),
        "zero": kind != "loss" and not names[0].endswith("_accuracy"),
    }


def _summary(last: Mapping[str, Any], now: datetime | None) -> str:
    if not last:
        return "No record yet."
    taken = _duration(last["elapsed_s"])
    text = f"{last['pairs']:,} of {last['of']:,} pairs in {taken}, {last['stage']} stage"
    left = _number(last.get("left_s"))
    if now is None or not left:
        return text
    return f"{text}, about {_duration(left)} left as of {now.isoformat(' ', 'minutes')}"


def _duration(seconds: float) -> str:
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def _row(name: str, records: Sequence[Mapping[str, Any]]) -> str:
    """Return one row of the table: the last value, the first, and for validations the best."""
    known = [
        (value, record["pairs"]) for record in records if (value := _number(record.get(name))) is not None
    ]
    best, place = "", ""
    if kind_of(name) == "validation":
        value, pairs = (max if is_share(name) else min)(known, key=lambda one: one[0])
        best, place = readable(name, value), f"{pairs:,}"
    cells = (label_of(name), readable(name, known[-1][0]), readable(name, known[0][0]), best, place)
    return "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"


def readable(name: str, value: float) -> str:
    """Return a value as a person reads it: shares as percentages, the rest in four digits."""
    return f"{100 * value:.1f} %" if is_share(name) else f"{value:.4g}"


def _setting_rows(settings: Mapping[str, Any], section: str = "") -> list[str]:
    rows = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            rows += _setting_rows(value, f"{section}{name}.")
        else:
            rows.append(
                f"<tr><td>{html.escape(f'{section}{name}')}</td><td>{html.escape(str(value))}</td></tr>"
            )
    return rows


def _note(count: int) -> str:
    size = math.ceil(count / MOST_POINTS)
    thinned = f" Each point is the mean of up to {size} of them." if size > 1 else ""
    return f"{count:,} records.{thinned} Light: as recorded; strong: smoothed within each stage."
