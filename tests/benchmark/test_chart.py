from __future__ import annotations

import re

import pytest

from utopic_cli.benchmark.chart import Chart, round_up
from utopic_cli.benchmark.plots import LOOKS, recall_plot, value_plot
from utopic_cli.benchmark.web import document
from utopic_cli.page.skeleton import resource


@pytest.mark.parametrize(
    ("value", "end"), [(0.0, 1.0), (0.0016, 0.002), (0.23, 0.25), (1.0, 1.0), (9.9, 10.0), (31.0, 40.0)]
)
def test_axes_end_at_round_numbers(value: float, end: float) -> None:
    assert round_up(value) == pytest.approx(end)
    assert round_up(value) >= value


def test_long_numbers_get_room() -> None:
    def left(form: str) -> float:
        chart = Chart("name", "x", "y", (1.0, 1.0), ("{:.1f}", form))
        chart.dot(0.0, 0.0, 1.0, "look", "tip")
        found = re.search(r'cx="([\d.]+)"', chart.svg())
        assert found is not None
        return float(found[1])

    assert left("{:.1f}") == 52 < left("{:.8f}")


def test_lines_beyond_the_looks_are_left_to_the_tables() -> None:
    series = {f"method {place}": [(0.0, 1.0), (1.0, 2.0)] for place in range(LOOKS + 1)}
    drawn = value_plot("name", "caption", ("x", "y"), series, 1.0)
    assert drawn.count("<polyline") == LOOKS and f"method {LOOKS}" not in drawn
    style = resource("utopic_cli.benchmark", "page.css")
    assert all(f"svg .s{place}, .k{place}" in style for place in range(LOOKS))
    # Half of the pairs are off by 2 degrees, a quarter has no answer.
    drawn = recall_plot({"one": [2.0, 2.0, 30.0, None]})
    assert drawn.count("<polyline") == 1


def test_one_point_is_seen_though_no_line_goes_through_it() -> None:
    chart = Chart("name", "x", "y")
    chart.line([(0.5, 0.5)], "curve")
    (place,) = re.findall(r'<circle class="curve" cx="([\d.]+)" cy="([\d.]+)"', chart.svg())
    assert place == ("226.0", "155.0") and "<polyline" not in chart.svg()


def test_a_plot_without_values_says_so() -> None:
    assert "no answers" in value_plot("name", "caption", ("x", "y"), {"one": []}, 1.0)
    drawn = value_plot("name", "caption", ("x", "y"), {"one": [(0.0, 0.0)]}, 1.0)
    assert "no answers" not in drawn and '<circle class="place s0"' in drawn


@pytest.mark.parametrize("template", ["result_page.html", "trust_page.html"])
def test_pages_share_one_head(template: str) -> None:
    body = resource("utopic_cli.benchmark", template)
    fills = dict.fromkeys(re.findall(r"{{(\w+)}}", body), "filled")
    page = document(template, fills)
    assert page.startswith("<!doctype html>") and "<title>filled</title>" in page
    assert "--paper" in page and "{{" not in page
