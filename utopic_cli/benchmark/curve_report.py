"""What a robustness curve or the overlap sweep found: success and errors by level, and by overlap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.answers import FLOOR, REFINED, Answer
from utopic_cli.benchmark.pair_metrics import SUCCESS
from utopic_cli.benchmark.reports import add_groups, make_table, number, share_cell
from utopic_cli.benchmark.synthetic_report import Report, who
from utopic_cli.benchmark.synthetic_summary import Summary, summarise

if TYPE_CHECKING:
    from rich.table import Table

OVERLAP_STEP = 0.1
SWEEP = "overlap-sweep"

Who = tuple[str, str]
"""A method and a stage."""


class CurveReport(Report):
    """A report whose groups are the levels of one parameter, with the curve in the foreground."""

    @property
    def label(self) -> str:
        """What the horizontal axis of the curve says."""
        protocol = self.settings["protocol"]
        return "mean overlap" if protocol["name"] == SWEEP else str(protocol["level_means"])

    def curve(self) -> dict[Who, list[tuple[float, Summary]]]:
        """Return (place along the axis, summary) of each level that was reached, by method and stage.

        The place is the level, and for the overlap sweep the mean overlap there.
        """
        levels = dict(zip(self.groups, self.settings["protocol"]["levels"]))
        sweep = self.settings["protocol"]["name"] == SWEEP
        found: dict[Who, list[tuple[float, Summary]]] = {}
        for (group, method, stage), row in self.summaries().items():
            place = row.overlap if sweep else float(levels[group])
            found.setdefault((method, stage), []).append((place, row))
        return found

    def tables(self) -> list[Table]:
        """Return the curve as a table; of the overlap sweep also success by each pair's own overlap."""
        tables = [_by_level(self)]
        if self.settings["protocol"]["name"] == SWEEP:
            tables.append(_by_overlap(self.answers))
        return tables


def by_overlap(answers: Sequence[Answer]) -> dict[Who, list[tuple[float, Summary]]]:
    """Summarise answers by the overlap of their pairs, in steps of ``OVERLAP_STEP``.

    Returns:
        By method and stage: (mean overlap of a step, summary), from little to much; without the floor.
    """
    found: dict[Who, list[tuple[float, Summary]]] = {}
    for key in dict.fromkeys((answer.method, answer.stage) for answer in answers):
        if key[1] == FLOOR:
            continue
        own = [answer for answer in answers if (answer.method, answer.stage) == key]
        steps = sorted({_step(answer) for answer in own})
        rows = [summarise([answer for answer in own if _step(answer) == step]) for step in steps]
        found[key] = [(row.overlap, row) for row in rows]
    return found


def _step(answer: Answer) -> int:
    # A hair is added so that 0.3, which is no binary number, falls into the step it opens.
    return min(int(answer.overlap / OVERLAP_STEP + 1e-9), round(1.0 / OVERLAP_STEP) - 1)


def _levels(protocol: dict[str, Any]) -> str:
    """Say what the levels are, and what the paper says of them."""
    quoted = protocol.get("quoted_overlaps")
    said = f"; quoted overlaps: about {', '.join(map(str, quoted))}" if quoted else ""
    return f"{protocol['level_means']}{said}"


def _by_level(report: CurveReport) -> Table:
    protocol = report.settings["protocol"]
    degrees, length = SUCCESS
    table = make_table(
        report.title,
        f"{_levels(protocol)}; success: under {degrees:g} degrees and {length:g} "
        f"({protocol['length_unit']}), translations compared {protocol['translation_error']}; or symmetric: "
        "or the object lies within 2 % of its extent of its place; medians of all answers; "
        "[95 % Wilson interval]",
        ("level", "method"),
        (
            "pairs",
            "mean\noverlap",
            "success",
            "or symmetric",
            "Error(R)\nmedian, deg",
            "Error(t)\nmedian",
            "hit rate",
            "no answer",
            "CPU, s",
        ),
    )
    rows = (
        (
            group,
            who(method, stage),
            str(row.pairs),
            f"{row.overlap:.2f}",
            share_cell(row.success),
            share_cell(row.symmetric_success),
            number(row.error_r_median, "{:.3f}"),
            number(row.error_t_median, "{:.4f}"),
            number(row.hit_rate, "{:.3f}"),
            str(row.without_answer),
            f"{sum(row.cpu_seconds.values()):.2f}",
        )
        for (group, method, stage), row in report.summaries().items()
    )
    add_groups(table, rows)
    return table


def _by_overlap(answers: Sequence[Answer]) -> Table:
    table = make_table(
        "By the overlap of each pair",
        f"steps of {OVERLAP_STEP:g}, whatever number of points was kept",
        ("mean\noverlap", "method"),
        ("pairs", "success", "or symmetric", "Error(R)\nmedian, deg", "Error(t)\nmedian"),
    )
    for (method, stage), rows in by_overlap(answers).items():
        if stage != REFINED:
            continue
        for place, row in rows:
            table.add_row(
                f"{place:.2f}",
                who(method, stage),
                str(row.pairs),
                share_cell(row.success),
                share_cell(row.symmetric_success),
                number(row.error_r_median, "{:.3f}"),
                number(row.error_t_median, "{:.4f}"),
            )
        table.add_section()
    return table
