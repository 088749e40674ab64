"""What the protocol ``confidence`` found as one self-contained HTML page."""

from __future__ import annotations

import html
import json

import numpy as np

from utopic_cli.benchmark.chart import Chart
from utopic_cli.benchmark.reliability import risk_coverage
from utopic_cli.benchmark.reports import number, share
from utopic_cli.benchmark.trust_report import (
    LEAST_RIGHT,
    MOST_WRONG,
    TrustReport,
    hindsight,
    met_in_words,
)
from utopic_cli.benchmark.web import document, figure, plain_table

COLUMNS = 20
"""Columns of the histogram."""

MOST_RISK = 0.2
"""End of the risk axis: what lies beyond is no verdict."""


def page(report: TrustReport) -> str:
    """Draw the reliability diagram, risk against coverage and the histogram, with the tables.

    Returns:
        One HTML page that loads nothing from elsewhere and runs no script.
    """
    mistakes = [
        (
            str(one.number),
            one.kind,
            one.shape[-60:],
            f"{one.overlap:.2f}",
            f"{one.confidence:.3f}",
            number(one.rotation_deg, "{:.1f}"),
            number(one.translation_share, "{:.3f}"),
        )
        for one in report.outcomes
        if one.trusted and not one.right
    ]
    fills = {
        "title": html.escape(report.title),
        "summary": html.escape(hindsight(report)),
        "targets": plain_table(
            ("", "measured [95 % interval]", "target", "met"),
            [(what, measured, target, met_in_words(met)) for what, measured, target, met in report.targets()],
        ),
        "figures": "\n".join(_figures(report)),
        "kinds": plain_table(
            ("", "trials", "right", "trusted, right", "trusted, wrong", "mean confidence", "CPU, s"),
            [(kind, *row.cells()) for kind, row in report.kinds().items()],
        ),
        "bins": plain_table(
            ("confidence", "answers", "mean", "right [95 % interval]"),
            [
                (
                    f"{one.low:.1f}-{one.high:.1f}",
                    str(one.count),
                    number(one.confidence, "{:.3f}"),
                    share(one.right),
                )
                for one in report.bins
            ],
        ),
        "mistakes": plain_table(
            ("trial", "kind", "shape", "overlap", "confidence", "off, degrees", "off, extents"), mistakes
        ),
        "settings": html.escape(json.dumps(report.settings, indent=2, allow_nan=False)),
    }
    return document("trust_page.html", fills)


def reliability_diagram(report: TrustReport) -> str:
    """Draw the share of right answers over the mean confidence of each bin (SVG)."""
    chart = Chart("Reliability diagram", "mean confidence", "share right")
    chart.line([(0.0, 0.0), (1.0, 1.0)], "ideal")
    for one in report.bins:
        if one.confidence is None or one.right is None:
            continue
        chart.line([(one.confidence, one.right.low), (one.confidence, one.right.high)], "interval")
        tip = f"{one.low:.1f}-{one.high:.1f}: mean confidence {one.confidence:.3f}, right {share(one.right)}"
        radius = 3.0 + 12.0 * float(np.sqrt(one.count / len(report.outcomes)))
        chart.dot(one.confidence, one.right.share, radius, "right", tip)
    return chart.svg()


def risk_curve(report: TrustReport) -> str:
    """Draw what each threshold lets through (SVG)."""
    chart = Chart(
        "Risk against coverage", "accepted", "wrong of the accepted", (1.0, MOST_RISK), ("{:.0%}", "{:.0%}")
    )
    chart.block((LEAST_RIGHT, 0.0), (1.0, MOST_WRONG), "goal")
    curve = risk_coverage(report.confidence, report.right)
    shown = curve.risk <= MOST_RISK
    for across, look in ((curve.coverage, "curve faint"), (curve.recall, "curve")):
        chart.line(list(zip(across[shown].tolist(), curve.risk[shown].tolist())), look)
    if not shown.any():
        chart.word(0.5, MOST_RISK / 2, f"more than {MOST_RISK:.0%} wrong at every threshold")
    right, wrong = report.summary.accepted.right, report.summary.accepted.wrong
    if right is not None and wrong is not None:
        chart.dot(right.share, wrong.share, 5.0, "wrong", f"right {share(right)}; wrong {share(wrong)}")
    return chart.svg()


def histogram(report: TrustReport) -> str:
    """Draw how many right (upwards) and wrong answers (downwards) have which confidence (SVG)."""
    edges = np.linspace(0.0, 1.0, COLUMNS + 1)
    counts = {
        "right": np.histogram(report.confidence[report.right], edges)[0],
        "wrong": np.histogram(report.confidence[~report.right], edges)[0],
    }
    tallest = max(int(column.max()) for column in counts.values())
    chart = Chart("Confidence of right and wrong answers", "confidence", "answers", forms=("{:.1f}", ""))
    gap = 0.1 / COLUMNS
    for look, columns in counts.items():
        for low, high, count in zip(edges[:-1].tolist(), edges[1:].tolist(), columns.tolist()):
            reach = 0.45 * float(np.log1p(count) / np.log1p(tallest))
            bottom, top = (0.5, 0.5 + reach) if look == "right" else (0.5 - reach, 0.5)
            if count:
                tip = f"{low:.2f}-{high:.2f}: {count} {look}"
                chart.block((low + gap, bottom), (high - gap, top), look, tip)
    chart.line([(0.0, 0.5), (1.0, 0.5)], "axis")
    chart.word(0.5, 0.95, "right")
    chart.word(0.5, 0.03, "wrong")
    return chart.svg()


def _figures(report: TrustReport) -> list[str]:
    right = int(report.right.sum())
    figures = (
        (
            reliability_diagram(report),
            "Reliability",
            "Share of right answers among those of like confidence, with its 95 % interval; the larger a "
            "dot, the more answers. On the dashed line a confidence means what it says.",
        ),
        (
            risk_curve(report),
            "Risk against coverage",
            "Moving the threshold: share of wrong answers among the accepted, over the share of the right "
            "ones accepted (strong) and of all (faint). Shaded: what is aimed at. Dot: the verdict.",
        ),
        (
            histogram(report),
            "Confidence of right and wrong answers",
            f"{right} right ones upwards, {len(report.right) - right} wrong ones downwards; logarithmic.",
        ),
    )
    return [figure(svg, name, caption) for svg, name, caption in figures]
