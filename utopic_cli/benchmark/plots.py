"""The plots on the pages of protocols: shares and values over a parameter, one line a method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from utopic_cli.benchmark.chart import Chart, round_up
from utopic_cli.benchmark.reports import share
from utopic_cli.benchmark.synthetic_summary import Share
from utopic_cli.benchmark.web import figure

LOOKS = 8
MOST_DEGREES = 10.0
"""End of the axis of the recall plot."""


def share_plot(
    name: str,
    caption: str,
    across: str,
    series: Mapping[str, Sequence[tuple[float, Share]]],
    most: float,
    form: str = "{:.1f}",
) -> str:
    """Draw shares with their 95 % intervals.

    Args:
        name: of the figure.
        caption: what is to be seen.
        across: what the horizontal axis counts.
        series: (place, share) by the name of the line.
        most: end of the horizontal axis.
        form: how its numbers are written.
    """
    chart = Chart(name, across, "share", (most, 1.0), (form, "{:.0%}"))
    for look, (one, points) in zip(_looks(), series.items()):
        for place, value in points:
            chart.line([(place, value.low), (place, value.high)], f"span {look}")
        chart.line([(place, value.share) for place, value in points], f"series {look}")
        for place, value in points:
            chart.dot(
                place, value.share, 4.0, f"place {look}", f"{one}, {form.format(place)}: {share(value)}"
            )
    return figure(chart.svg(), name, caption, list(series)[:LOOKS])


def value_plot(
    name: str,
    caption: str,
    axes: tuple[str, str],
    series: Mapping[str, Sequence[tuple[float, float]]],
    most: float,
    forms: tuple[str, str] = ("{:.1f}", "{:.2g}"),
    ceiling: float = np.inf,
) -> str:
    """Draw values; the upward axis ends at a round number above the largest, or at the ceiling.

    Args:
        name: of the figure.
        caption: what is to be seen.
        axes: what the axes count, across and up.
        series: (place, value) by the name of the line.
        most: end of the horizontal axis.
        forms: how the axes' numbers are written.
        ceiling: what lies above is drawn there.
    """
    values = [value for points in series.values() for _, value in points]
    top = min(round_up(max(values, default=0.0)), ceiling)
    chart = Chart(name, *axes, (most, top), forms)
    if not values:
        chart.word(most / 2, top / 2, "no answers")
    for look, (one, points) in zip(_looks(), series.items()):
        chart.line(points, f"series {look}")
        for place, value in points:
            chart.dot(
                place, value, 4.0, f"place {look}", f"{one}, {forms[0].format(place)}: {value:.4g} {axes[1]}"
            )
    return figure(chart.svg(), name, caption, list(series)[:LOOKS])


def recall_plot(errors: Mapping[str, Sequence[float | None]]) -> str:
    """Draw the share of pairs whose rotation is off by less than so many degrees.

    Args:
        errors: Error(R) in degrees of every pair, None where there is no answer, by the line's name.
    """
    name = "Rotation errors"
    chart = Chart(name, "degrees", "share of the pairs below", (MOST_DEGREES, 1.0), ("{:.0f}", "{:.0%}"))
    for look, values in zip(_looks(), errors.values()):
        known = np.sort([value for value in values if value is not None])
        points = [(0.0, 0.0)]
        for count, value in enumerate(known[known <= MOST_DEGREES].tolist(), start=1):
            points += [(value, points[-1][1]), (value, count / len(values))]
        chart.line([*points, (MOST_DEGREES, points[-1][1])], f"series {look}")
    caption = "Share of all pairs that are off by less than this; what is missing at the right is lost."
    return figure(chart.svg(), name, caption, list(errors)[:LOOKS])


def _looks() -> list[str]:
    """Looks of as many lines as can be told apart; further ones are left to the tables."""
    return [f"s{place}" for place in range(LOOKS)]
