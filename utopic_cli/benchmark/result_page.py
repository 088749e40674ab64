"""What a protocol found as one self-contained HTML page: its plots, its tables, its settings."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.answers import FLOOR, REFINED, SOLVED
from utopic_cli.benchmark.curve_report import SWEEP, CurveReport, Who, by_overlap
from utopic_cli.benchmark.metrics import OVERLAP_BANDS, band_name, overlap_band
from utopic_cli.benchmark.plots import LOOKS, MOST_DEGREES, recall_plot, share_plot, value_plot
from utopic_cli.benchmark.scans_report import Report as ScansReport
from utopic_cli.benchmark.speed_report import SpeedReport
from utopic_cli.benchmark.synthetic_report import Report
from utopic_cli.benchmark.synthetic_summary import Share, wilson
from utopic_cli.benchmark.variant_report import VariantReport
from utopic_cli.benchmark.web import document, printed_table

if TYPE_CHECKING:
    from rich.table import Table


AnyReport = Report | ScansReport | SpeedReport | VariantReport


def page(report: AnyReport) -> str:
    """Draw what a protocol on synthetic pairs or with variants, ``scans`` or ``speed`` found.

    Returns:
        One HTML page that loads nothing from elsewhere and runs no script.
    """
    if isinstance(report, SpeedReport | VariantReport):
        figures = report.figures()
    elif isinstance(report, ScansReport):
        figures = _scans_figures(report)
    elif isinstance(report, CurveReport):
        figures = _curve_figures(report)
    else:
        figures = _figures(report)
    return result_page(report.title, report.losses(), figures, report.tables(), report.settings)


def result_page(
    title: str,
    notes: Sequence[str],
    figures: Sequence[str],
    tables: Sequence[Table],
    settings: dict[str, Any],
) -> str:
    """Put a page together.

    Args:
        title: in one line.
        notes: what must be known beside figures and tables.
        figures: from ``plots``.
        tables: as they are printed in the terminal.
        settings: everything the run was asked for, JSON-ready.
    """
    return document(
        "result_page.html",
        {
            "title": html.escape(title),
            "summary": "<br>".join(map(html.escape, notes)),
            "figures": "\n".join(figures),
            "tables": "\n".join(map(printed_table, tables)),
            "settings": html.escape(json.dumps(settings, indent=2, allow_nan=False)),
        },
    )


def _figures(report: Report) -> list[str]:
    """Rotation errors, and success by overlap."""
    answers = [answer for answer in report.answers if answer.stage in (REFINED, FLOOR)]
    errors: dict[str, list[float | None]] = {}
    for answer in sorted(answers, key=lambda answer: answer.stage == FLOOR):
        name = "statistical floor" if answer.stage == FLOOR else answer.method
        errors.setdefault(name, []).append(None if answer.pose is None else answer.pose.rotation_deg)
    return [recall_plot(errors), _success_by_overlap(report)]


def _success_by_overlap(report: Report) -> str:
    series = {
        _name(who): [(place, row.symmetric_success) for place, row in rows]
        for who, rows in by_overlap(report.answers).items()
        if who[1] == REFINED
    }
    caption = "Success (or symmetric) after refinement, by the overlap of the smaller side in steps of .1."
    return share_plot("Success by overlap", caption, "overlap", series, 1.0)


def _curve_figures(report: CurveReport) -> list[str]:
    """Success and the median rotation error along the curve."""
    curve = report.curve()
    sweep = report.settings["protocol"]["name"] == SWEEP
    most = 1.0 if sweep else max(report.settings["protocol"]["levels"])
    form = "{:.2f}" if sweep else "{:.3f}" if most < 0.1 else "{:.2f}" if most < 1.0 else "{:.0f}"
    success = {
        _name(who): [(place, row.symmetric_success) for place, row in rows]
        for who, rows in curve.items()
        if who[1] == REFINED
    }
    errors = {
        _name(who): [(place, row.error_r_median) for place, row in rows if row.error_r_median is not None]
        # The floor last, so that a method has one colour in all plots.
        for who, rows in sorted(curve.items(), key=lambda item: item[0][1] == FLOOR)
        if who[1] != SOLVED
    }
    figures = [
        share_plot(
            "Success",
            "Share of the pairs after refinement (or symmetric), with its 95 % interval.",
            report.label,
            success,
            most,
            form,
        ),
        value_plot(
            "Median rotation error",
            f"Over all answers, after refinement; what lies above {MOST_DEGREES:g} is drawn there.",
            (report.label, "degrees"),
            errors,
            most,
            (form, "{:.2g}"),
            MOST_DEGREES,
        ),
    ]
    return [*figures, _success_by_overlap(report)] if sweep else figures


def _scans_figures(report: ScansReport) -> list[str]:
    """Rotation errors, and success by overlap band."""
    errors: dict[str, list[float | None]] = {}
    success: dict[str, list[tuple[float, Share]]] = {}
    for attempt in report.attempts:
        errors.setdefault(attempt.method, []).append(None if attempt.error is None else attempt.error.rre_deg)
    for method in list(errors)[:LOOKS]:
        success[method] = []
        for low, high in OVERLAP_BANDS:
            own = [
                attempt
                for attempt in report.attempts
                if attempt.method == method and overlap_band(attempt.overlap) == band_name(low, high)
            ]
            if own:
                place = sum(attempt.overlap for attempt in own) / len(own)
                success[method].append((place, wilson(sum(attempt.success for attempt in own), len(own))))
    caption = "Share of the attempts within both bounds, over the mean overlap of each band."
    return [recall_plot(errors), share_plot("Success by overlap", caption, "overlap", success, 1.0)]


def _name(who: Who) -> str:
    return "statistical floor" if who[1] == FLOOR else who[0]
