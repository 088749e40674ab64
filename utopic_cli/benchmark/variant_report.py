"""What ``ablation``, ``attention`` and ``uncertainty`` found: tables, an honest reading, JSON, figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.paired import Difference, Figure, mean_figure
from utopic_cli.benchmark.plots import recall_plot
from utopic_cli.benchmark.quoted import METRICS
from utopic_cli.benchmark.reports import HASH, json_by_rows, make_table, share_cell
from utopic_cli.benchmark.variant_pairs import FLOOR, SOLVERS, PairResult
from utopic_cli.benchmark.variant_summary import (
    MEASURES,
    PoseSummary,
    compare,
    summarise_poses,
    told_apart,
)
from utopic_cli.benchmark.variants import CONTROL, FULL, Row

if TYPE_CHECKING:
    from rich.table import Table

SCHEMA_VERSION = 1
SOLVES = {"svd": "paper's", "auto": "robust"}
_FORMS = dict(zip(METRICS, ("{:.3f}", "{:.3f}", "{:.4f}", "{:.4f}", "{:.3f}", "{:.4f}")))
_HEADINGS = ("RMSE(R), deg", "MAE(R), deg", "RMSE(t)", "MAE(t)", "Error(R), deg", "Error(t)")


@dataclass(frozen=True)
class VariantRun:
    """One variant, trained and measured.

    Attributes:
        row: of the table.
        pairs_seen: in training, those that all share left out.
        minutes: that its training took.
        results: on the test pairs, in their order.
    """

    row: Row
    pairs_seen: int
    minutes: float
    results: tuple[PairResult, ...]


@dataclass(frozen=True)
class VariantReport:
    """Everything one table rests on.

    Attributes:
        settings: the budget, the configuration, the test pairs, the variants, versions and machine.
        runs: in the order of the table; the full network and the control are among them.
    """

    settings: dict[str, Any]
    runs: tuple[VariantRun, ...]

    @property
    def title(self) -> str:
        """Table, data and budget in one line."""
        test, budget = self.settings["test"], self.settings["budget"]
        return (
            f"{self.settings['protocol']}: each variant trained on {budget['pairs']:,} pairs of "
            f"{self.settings['data']}, tested on {test['pairs']} pairs of {test['shapes']} '{test['split']}' "
            f"shapes, seed {test['seed']}"
        )

    @cached_property
    def differences(self) -> dict[str, dict[str, Difference | None]]:
        """Return how each other variant differs from the full network, by variant and measure."""
        full = self._run(FULL).results
        return {run.row.variant: compare(run.results, full) for run in self.runs if run.row.variant != FULL}

    def poses(self, run: VariantRun, solver: str) -> PoseSummary:
        """Summarise one solve of a run."""
        return summarise_poses([result.poses[solver] for result in run.results])

    def tables(self) -> list[Table]:
        """Return the tables: the paper's metrics, matches and overlap, differences from the full network."""
        return [_paper(self), _matches(self), _differences(self)]

    def losses(self) -> list[str]:
        """Say what the budget was, what it told apart, and how often there was no answer: one line each."""
        lines = [self._budget(), self._reading()]
        for run in self.runs:
            for solver in SOLVERS:
                count = self.poses(run, solver).without_answer
                if count:
                    lines.append(f"{run.row.label}: no answer {count} times by the {SOLVES[solver]} solve")
        return lines

    def figures(self) -> list[str]:
        """Return the plot of rotation errors after the robust solve."""
        errors = {run.row.label: _angles(run.results, "auto") for run in self.runs}
        return [recall_plot(errors)]

    def to_json(self) -> str:
        """Return the whole report as JSON text, one pair of a variant a line."""
        rows = [
            {
                "label": run.row.label,
                "variant": run.row.variant,
                "pairs_seen": run.pairs_seen,
                "minutes": run.minutes,
                "poses": {solver: asdict(self.poses(run, solver)) for solver in SOLVERS},
                "matches": {
                    one.name: None
                    if (found := mean_figure(one.values(run.results))) is None
                    else asdict(found)
                    for one in MEASURES
                },
                "difference_from_full": None
                if run.row.variant == FULL
                else {
                    name: None
                    if found is None
                    else {**asdict(found), "told_apart": self._told_apart(run.row.variant, name)}
                    for name, found in self.differences[run.row.variant].items()
                },
                "quoted": {
                    **dict(zip(METRICS, run.row.quoted)),
                    "overlap_accuracy": run.row.quoted_accuracy,
                }
                if run.row.quoted
                else None,
            }
            for run in self.runs
        ]
        summary = {"reading": self.losses(), "summary": rows}
        answers = (
            {"variant": run.row.variant, **result.to_dict()} for run in self.runs for result in run.results
        )
        return json_by_rows({**self.settings, **summary}, "answers", answers)

    def _run(self, variant: str) -> VariantRun:
        return next(run for run in self.runs if run.row.variant == variant)

    def _told_apart(self, variant: str, measure: str) -> bool:
        control = self.differences.get(CONTROL, {}).get(measure)
        comparisons = len(MEASURES) * sum(name != CONTROL for name in self.differences)
        return variant != CONTROL and told_apart(self.differences[variant][measure], control, comparisons)

    def _budget(self) -> str:
        budget = self.settings["budget"]
        how = f"budget: {budget['pairs']:,} pairs each"
        if budget["minutes"] is not None:
            how += (
                f", about {budget['minutes']:g} minutes at the {budget['pairs_per_s']:.2f} pairs/s "
                "measured before"
            )
        if budget["descriptor_pairs"]:
            how += f", from descriptors that all share ({budget['descriptor_pairs']:,} pairs more)"
        return f"{how}; the same pairs, order, rates and first weights for all"

    def _reading(self) -> str:
        apart = []
        for run in self.runs:
            if run.row.variant in (FULL, CONTROL):
                continue
            names = [
                one.heading.replace("\n", " ")
                for one in MEASURES
                if self._told_apart(run.row.variant, one.name)
            ]
            if names:
                apart.append(f"{run.row.label} ({'; '.join(names)})")
        if not apart:
            return "within noise: this budget tells no variant from the full network, by any measure"
        return f"told apart from the full network: {', '.join(apart)}; everything else is within noise"


def _paper(report: VariantReport) -> Table:
    table = make_table(
        report.title,
        "mean ± standard error over the pairs, no refinement; lengths in radii of the object; paper's "
        "solve: assignment and overlap-weighted Procrustes; floor: Procrustes on the true correspondences; "
        "quoted: from the paper, on ModelNet40, a larger network and some million pairs: compare the "
        "order, not the digits",
        ("variant", "solve"),
        (*_HEADINGS, "overlap\naccuracy"),
    )
    accuracy = MEASURES[0]
    for run in report.runs:
        for solver in SOLVERS:
            first = solver == SOLVERS[0]
            table.add_row(
                run.row.label if first else "",
                SOLVES[solver],
                *_metrics(report.poses(run, solver)),
                _figure(mean_figure(accuracy.values(run.results)), accuracy.form) if first else "",
            )
    floor = [result.poses[FLOOR] for result in report.runs[0].results if FLOOR in result.poses]
    if floor:
        table.add_section()
        table.add_row("statistical floor", "", *_metrics(summarise_poses(floor)), "")
    table.add_section()
    for run in report.runs:
        if run.row.quoted:
            told = run.row.quoted_accuracy
            table.add_row(
                f"{run.row.label} (quoted)",
                "",
                *(f"{value:.5g}" for value in run.row.quoted),
                "" if told is None else f"{told:.4f}",
            )
    return table


def _matches(report: VariantReport) -> Table:
    table = make_table(
        "Training, matches, overlap and recall",
        "mean ± standard error over the pairs; hit rate: overlapping points whose best match is right; "
        "overlap accuracy at 0.5 and at first sight (mutual: by narrower labels, mutual nearest neighbours); "
        "recall: both errors are less [95 % interval]; weights: what the sha256 of their file begins with",
        ("variant", "weights"),
        (
            "pairs\nseen",
            "minutes",
            "hit rate",
            "inliers of\nsurest 250",
            "overlap\naccuracy",
            "\nmutual",
            "median Error(R)\npaper's / robust",
            "1 deg, .02\nrobust",
            "5 deg, .05\npaper's",
            "\nrobust",
        ),
    )
    by_name = {one.name: one for one in MEASURES}
    for run in report.runs:
        paper, robust = (report.poses(run, solver) for solver in SOLVERS)
        mutual = [None if one.overlap is None else one.overlap.accuracy_mutual for one in run.results]
        table.add_row(
            run.row.label,
            report.settings["variants"][run.row.variant]["weights_sha256"][:HASH],
            f"{run.pairs_seen:,}",
            f"{run.minutes:.1f}",
            *(
                _figure(mean_figure(by_name[name].values(run.results)), "{:.3f}")
                for name in ("hit_rate", "inlier_ratio", "overlap_accuracy")
            ),
            _figure(mean_figure(mutual), "{:.3f}"),
            " / ".join(
                "-" if one.error_r_median is None else f"{one.error_r_median:.2f}" for one in (paper, robust)
            ),
            *(share_cell(one) for one in (robust.fine, paper.success, robust.success)),
        )
    return table


def _differences(report: VariantReport) -> Table:
    table = make_table(
        "Differences from the full network on the same pairs",
        "variant minus full ± half the 95 % interval over the pairs; * told apart: chance among the pairs "
        "makes so large a difference in fewer than 5 % of such tables, and it is larger than that of the "
        "full network trained with another seed; what has no * is within noise. Each variant is one "
        "training run",
        ("variant",),
        tuple(one.heading for one in MEASURES),
    )
    for run in report.runs:
        if run.row.variant == FULL:
            continue
        table.add_row(
            run.row.label,
            *(
                _change(
                    report.differences[run.row.variant][one.name],
                    one.change,
                    report._told_apart(run.row.variant, one.name),
                )
                for one in MEASURES
            ),
        )
    return table


def _metrics(poses: PoseSummary) -> list[str]:
    return [_figure(getattr(poses, name), _FORMS[name]) for name in METRICS]


def _figure(figure: Figure | None, form: str) -> str:
    if figure is None:
        return "-"
    error = "" if figure.error is None else f" ±{form.format(figure.error)}"
    return form.format(figure.value) + error


def _change(difference: Difference | None, form: str, apart: bool) -> str:
    if difference is None:
        return "-"
    half = ""
    if difference.high is not None:
        half = f" ±{form.replace('+', '').format(difference.high - difference.value)}"
    return f"{form.format(difference.value)}{half}{' *' if apart else ''}"


def _angles(results: Sequence[PairResult], solver: str) -> list[float | None]:
    poses = [result.poses[solver] for result in results]
    return [None if pose is None else pose.rotation_deg for pose in poses]
