"""What a protocol on synthetic pairs found: every answer, the summary, tables and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.answers import FLOOR, REFINED, SOLVED, Answer
from utopic_cli.benchmark.method import remarks
from utopic_cli.benchmark.quoted import DATA, METRICS, OVERLAP_ACCURACY, QUOTED
from utopic_cli.benchmark.reports import (
    add_groups,
    counted,
    json_by_rows,
    make_table,
    number,
    share_cell,
    with_weights,
)
from utopic_cli.benchmark.synthetic_summary import OverlapSummary, Summary, summarise
from utopic_cli.benchmark.uncertainty import MATCHED, UncertaintySummary, summarise_uncertainty
from utopic_cli.estimation.prior import ANY_ROTATION
from utopic_cli.synthesis.packing import describe_data

if TYPE_CHECKING:
    from rich.table import Table

SCHEMA_VERSION = 1
FEWEST = 10
"""Pairs, or shapes, below which the table says that they are too few."""


@dataclass(frozen=True)
class Report:
    """Everything one run found.

    Attributes:
        settings: the protocol's definition, what was asked for, the methods, versions and machine.
        groups: names of the groups of pairs, in the order of the table.
        answers: in the order of pairs, methods, stages.
    """

    settings: dict[str, Any]
    groups: tuple[str, ...]
    answers: tuple[Answer, ...]

    @property
    def title(self) -> str:
        """Protocol, data and weights in one line."""
        protocol = self.settings["protocol"]
        how = [f"{protocol[key]}" for key in ("sampling", "rotations") if key in protocol]
        name = f"{protocol['name']} ({', '.join(how)})" if how else protocol["name"]
        data = describe_data(self.settings["data"])
        if not self.settings["data"].startswith(DATA.get(protocol["name"], "")):
            data += " (not the paper's data)"
        if protocol.get("relief"):
            data += " with relief added"
        title = (
            f"{name}: {counted(self.settings['pairs'], 'pair')} of {self.settings['shapes']} "
            f"'{self.settings['split']}' shapes, {data}, seed {self.settings['seed']}"
        )
        if self.settings.get("max_rotation", ANY_ROTATION) < ANY_ROTATION:
            title += f", solved for turns of {self.settings['max_rotation']:g} degrees at most"
        methods = self.settings.get("methods", {}).items()
        networks = [(name, one["weights_sha256"]) for name, one in methods if "weights_sha256" in one]
        return with_weights(title, networks)

    def summaries(self) -> dict[tuple[str, str, str], Summary]:
        """Summarise by (group, method, stage), in the order of the table."""
        table = {}
        for group in self.groups:
            members = [answer for answer in self.answers if answer.group == group]
            floor = [answer for answer in members if answer.stage == FLOOR]
            for method, stage in dict.fromkeys((answer.method, answer.stage) for answer in members):
                own = [answer for answer in members if (answer.method, answer.stage) == (method, stage)]
                table[group, method, stage] = summarise(own, floor)
        return table

    def uncertainties(self) -> dict[tuple[str, str], UncertaintySummary]:
        """Summarise raw uncertainty over all groups, by (method, look) with look ``first`` or ``final``."""
        solved = [answer for answer in self.answers if answer.stage == SOLVED and answer.pose is not None]
        table = {}
        for method in dict.fromkeys(answer.method for answer in solved):
            for look in ("first", "final"):
                pairs, right = [], []
                for answer in solved:
                    measured = getattr(answer, f"{look}_uncertainty")
                    if answer.method == method and measured is not None and answer.pose is not None:
                        pairs.append(measured)
                        right.append(answer.pose.symmetric)
                if pairs:
                    table[method, look] = summarise_uncertainty(pairs, right)
        return table

    def tables(self) -> list[Table]:
        """Return the tables: poses, the paper's six metrics, matches and overlap, uncertainty."""
        tables = [_poses(self)]
        if self.quoted_rows():
            tables.append(_paper(self))
        tables.append(_matches(self))
        if self.uncertainties():
            tables += [_uncertainty(self), _matches_by_place(self)]
        return tables

    def losses(self) -> list[str]:
        """Say what must be known of methods, and how often and why there was no answer, by lines."""
        # A pair without an answer has none at any stage.
        lost = {(answer.method, answer.message, answer.pair) for answer in self.answers if answer.message}
        reasons = [(method, message) for method, message, _ in lost]
        return remarks(self.settings.get("methods", {})) + [
            f"{method}: no answer to {reasons.count((method, message))} of the pairs: {message}"
            for method, message in sorted(set(reasons))
        ]

    def to_json(self) -> str:
        """Return the whole report as JSON text, one answer a line."""
        rows = [
            {"group": group, "method": method, "stage": stage, **asdict(summary)}
            for (group, method, stage), summary in self.summaries().items()
        ]
        uncertainty = [
            {"method": method, "look": look, **asdict(summary)}
            for (method, look), summary in self.uncertainties().items()
        ]
        found = {
            "quoted": self._quoted(),
            "quoted_overlap_accuracy": self._accuracies(),
            "summary": rows,
            "uncertainty": uncertainty,
        }
        answers = (answer.to_dict() for answer in self.answers)
        return json_by_rows({**self.settings, **found}, "answers", answers)

    def _quoted(self) -> dict[str, dict[str, float]]:
        rows = QUOTED.get(self.settings["protocol"]["name"], {})
        return {name: dict(zip(METRICS, values)) for name, values in rows.items()}

    def _accuracies(self) -> dict[str, float]:
        return OVERLAP_ACCURACY.get(self.settings["protocol"]["name"], {})

    def accuracy_rows(self) -> list[tuple[str, str]]:
        """Return the paper's overlap accuracies as cells: name and share."""
        return [(f"{name} (quoted)", f"{value:.3f} / - / -") for name, value in self._accuracies().items()]

    def quoted_rows(self) -> list[list[str]]:
        """Return the paper's figures as cells: name and six metrics."""
        return [
            [f"{name} (quoted)", *(number(row[key], _FORMS[key]) for key in METRICS)]
            for name, row in self._quoted().items()
        ]


_FORMS = {
    "rmse_r": "{:.4f}",
    "mae_r": "{:.4f}",
    "rmse_t": "{:.5f}",
    "mae_t": "{:.5f}",
    "error_r": "{:.4f}",
    "error_t": "{:.5f}",
}


def _poses(report: Report) -> Table:
    protocol = report.settings["protocol"]
    floor = "; x floor: over the error of Procrustes on the true correspondences, no lower bound"
    table = make_table(
        report.title,
        f"{_too_few(report.settings)}"
        f"recall: both errors are less; lengths in: {protocol['length_unit']}; translations compared "
        f"{protocol['translation_error']}; or symmetric: or the object lies within 2 % of its extent of its "
        f"place; [95 % Wilson interval]{floor if any(one.stage == FLOOR for one in report.answers) else ''}",
        ("pairs", "method"),
        (
            "Error(R)\nmean, deg",
            "\nmedian",
            "Error(t)\nmean",
            "recall\n1 deg, .02",
            "recall\n5 deg, .05",
            "or symmetric",
            "x floor\nR",
            "\nmedian",
            "\nt",
            "CPU, s",
        ),
    )
    rows = (
        (
            group,
            who(method, stage),
            number(row.error_r, "{:.3f}"),
            number(row.error_r_median, "{:.3f}"),
            number(row.error_t, "{:.4f}"),
            f"{row.fine.share:.1%}",
            f"{row.success.share:.1%}",
            share_cell(row.symmetric_success),
            number(row.floor_ratio_r, "{:.2f}"),
            number(row.floor_ratio_r_median, "{:.2f}"),
            number(row.floor_ratio_t, "{:.2f}"),
            f"{sum(row.cpu_seconds.values()):.2f}",
        )
        for (group, method, stage), row in report.summaries().items()
    )
    add_groups(table, rows)
    return table


def _too_few(settings: dict[str, Any]) -> str:
    """Warn of figures that say little."""
    for what in ("pairs", "shapes"):
        if settings[what] < FEWEST:
            return f"only {counted(settings[what], what[:-1])}: too few to mean much; "
    return ""


def _paper(report: Report) -> Table:
    table = make_table(
        "The paper's metrics",
        "quoted: from the paper, with shared points and its rotations, on other pairs than these; compare "
        "ratios to the statistical floor, not digits",
        ("pairs", "method"),
        ("RMSE(R)", "MAE(R)", "RMSE(t)", "MAE(t)", "Error(R)", "Error(t)"),
    )
    for (group, method, stage), row in report.summaries().items():
        cells = [number(getattr(row, key), _FORMS[key]) for key in METRICS]
        table.add_row(group, who(method, stage), *cells)
    table.add_section()
    for name, *cells in report.quoted_rows():
        table.add_row("", name, *cells)
    return table


def _matches(report: Report) -> Table:
    table = make_table(
        "Matches and overlap at the sampled points",
        "accuracy / precision / recall at 0.5; mutual: accuracy by the paper's labels (mutual nearest "
        "neighbours); final: shown the answer; CPU seconds",
        ("pairs", "method"),
        (
            "hit rate",
            "inliers of\nsurest 250",
            "first overlap\nacc / prec / rec",
            "\nmutual",
            "final overlap\nacc / prec / rec",
            "\nmutual",
            "look",
            "solve",
            "refine",
        ),
    )
    rows = (
        (
            group,
            who(method, stage),
            number(row.hit_rate, "{:.3f}"),
            number(row.inlier_ratio, "{:.3f}"),
            *_overlap(row.first_overlap),
            *_overlap(row.final_overlap),
            *(number(row.cpu_seconds.get(step), "{:.2f}") for step in ("look", "solve", "refine")),
        )
        for (group, method, stage), row in report.summaries().items()
        if stage != FLOOR and row.inlier_ratio is not None  # who answers as a whole has no matches to show
    )
    add_groups(table, rows)
    for place, (name, accuracy) in enumerate(report.accuracy_rows()):
        if place == 0:
            table.add_section()
        table.add_row("", name, "", "", accuracy)
    return table


def _uncertainty(report: Report) -> Table:
    headings = ("border", "inside", "outside", "plain", "rich", "AUC\nborder, inside", "AUC\nplain, rich")
    table = make_table(
        "Raw uncertainty (variance of the sampled overlap) by place and by pair",
        "border: of the overlap; plain, rich: the quarters of its inside with the least and the most "
        "relief; AUC: probability that the former is more uncertain than the latter",
        ("method", "look"),
        (*headings, "pairs\nthat fail", "others", "AUC\nfailing pairs"),
    )
    for (method, look), row in report.uncertainties().items():
        values = (*row.places.values(), row.border_auc, row.plain_auc, row.failed, row.right, row.failed_auc)
        table.add_row(method, look, *(number(value, "{:.3f}") for value in values))
    return table


def _matches_by_place(report: Report) -> Table:
    table = make_table(
        "Matches by place, and whether uncertainty tells the wrong ones",
        "hit rate of the overlapping nodes, places as above; AUC: probability that one whose best match is "
        "wrong is more uncertain than one whose is right",
        ("method", "look"),
        (*(f"hit rate\n{place}" for place in MATCHED), "AUC\nwrong, right"),
    )
    for (method, look), row in report.uncertainties().items():
        values = (*(number(row.hits[place], "{:.3f}") for place in MATCHED), number(row.wrong_auc, "{:.3f}"))
        table.add_row(method, look, *values)
    return table


def who(method: str, stage: str) -> str:
    """Name a method at a stage, as markup."""
    from rich.markup import escape

    if stage == FLOOR:
        return "statistical floor"
    return escape(f"{method} + refinement" if stage == REFINED else method)


def _overlap(summary: OverlapSummary | None) -> tuple[str, str]:
    if summary is None:
        return "-", "-"
    parts = (summary.accuracy, summary.precision, summary.recall)
    return " / ".join(number(part, "{:.3f}") for part in parts), f"{summary.accuracy_mutual:.3f}"
