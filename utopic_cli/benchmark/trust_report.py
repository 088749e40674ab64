"""What the protocol ``confidence`` found: every trial, the summary, tables and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from utopic_cli.benchmark.reliability import (
    Accepted,
    Bin,
    accepted_at,
    accepted_where,
    auroc,
    brier,
    expected_calibration_error,
    reliability_bins,
    threshold_for,
)
from utopic_cli.benchmark.reports import counted, json_by_rows, make_table, number, share, with_weights

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

SCHEMA_VERSION = 1
LEAST_AUROC = 0.97
MOST_ECE = 0.05
MOST_WRONG = 0.01
LEAST_RIGHT = 0.90


@dataclass(frozen=True)
class Outcome:
    """One trial: what was claimed and what is true.

    Attributes:
        number: of the trial.
        kind: its recipe, one of ``trials.KINDS``.
        shape: what was scanned.
        overlap: share of the smaller side with a counterpart; 0 where there is no right answer.
        source_points: of the source.
        target_points: of the target.
        answerable: whether there is a right answer.
        right: whether the answer given is right.
        confidence: the claimed probability of that; 0 where no transformation was found.
        trusted: whether the answer was accepted.
        reasons: why or why not, in words.
        rotation_deg: distance from the known rotation; None without an answer, or a known one.
        translation_share: distance from the known translation, in extents; None likewise.
        cpu_seconds: of the registration.
    """

    number: int
    kind: str
    shape: str
    overlap: float
    source_points: int
    target_points: int
    answerable: bool
    right: bool
    confidence: float
    trusted: bool
    reasons: tuple[str, ...]
    rotation_deg: float | None
    translation_share: float | None
    cpu_seconds: float


@dataclass(frozen=True)
class KindSummary:
    """Trials of one kind.

    Attributes:
        trials: how many.
        right: answered right.
        accepted_right: of those, accepted.
        accepted_wrong: accepted, but wrong.
        confidence: mean.
        cpu_seconds: mean.
    """

    trials: int
    right: int
    accepted_right: int
    accepted_wrong: int
    confidence: float
    cpu_seconds: float

    def cells(self) -> tuple[str, ...]:
        """Return the numbers as a row of a table."""
        counts = (self.trials, self.right, self.accepted_right, self.accepted_wrong)
        return (*map(str, counts), f"{self.confidence:.3f}", f"{self.cpu_seconds:.2f}")


@dataclass(frozen=True)
class TrustSummary:
    """All trials.

    Attributes:
        auroc: see ``reliability``; None unless there are right and wrong answers.
        brier: see there.
        expected_calibration_error: over ten bins of equal width.
        accepted: what the verdict ``trusted`` lets through.
        threshold: the lowest at which at most ``MOST_WRONG`` of the accepted are wrong, chosen on
            these trials with hindsight; None if there is none.
        accepted_at_threshold: what that one would let through.
    """

    auroc: float | None
    brier: float
    expected_calibration_error: float
    accepted: Accepted
    threshold: float | None
    accepted_at_threshold: Accepted | None


@dataclass(frozen=True)
class TrustReport:
    """Everything one run found.

    Attributes:
        settings: what was asked for, the weights, versions and machine.
        outcomes: in the order of the trials, at least one.
    """

    settings: dict[str, Any]
    outcomes: tuple[Outcome, ...]

    @property
    def title(self) -> str:
        """Protocol, data and weights in one line."""
        trials = counted(len(self.outcomes), "trial")
        title = f"confidence: {trials}, {self.settings['data']}, seed {self.settings['seed']}"
        return with_weights(title, [(self.settings["weights_name"], self.settings["weights_sha256"])])

    @cached_property
    def confidence(self) -> np.ndarray:
        """The claimed probabilities (N,)."""
        return np.array([one.confidence for one in self.outcomes])

    @cached_property
    def right(self) -> np.ndarray:
        """Which answers are right (N,) bool."""
        return np.array([one.right for one in self.outcomes])

    @cached_property
    def bins(self) -> tuple[Bin, ...]:
        """The reliability diagram."""
        return reliability_bins(self.confidence, self.right)

    @cached_property
    def summary(self) -> TrustSummary:
        """All trials taken together."""
        threshold = threshold_for(self.confidence, self.right, MOST_WRONG)
        return TrustSummary(
            auroc(self.confidence, self.right),
            brier(self.confidence, self.right),
            expected_calibration_error(self.confidence, self.right),
            accepted_where(np.array([one.trusted for one in self.outcomes]), self.right),
            threshold,
            None if threshold is None else accepted_at(self.confidence, self.right, threshold),
        )

    def kinds(self) -> dict[str, KindSummary]:
        """Summarise the trials by kind, in the order of the settings."""
        table = {}
        for kind in self.settings["kinds"]:
            members = [one for one in self.outcomes if one.kind == kind]
            if members:
                table[kind] = KindSummary(
                    len(members),
                    sum(one.right for one in members),
                    sum(one.right and one.trusted for one in members),
                    sum(one.trusted and not one.right for one in members),
                    float(np.mean([one.confidence for one in members])),
                    float(np.mean([one.cpu_seconds for one in members])),
                )
        return table

    def targets(self) -> list[tuple[str, str, str, bool | None]]:
        """Return rows (what, measured, target, whether it is met; None if it can't be told)."""
        found = self.summary
        wrong, right = found.accepted.wrong, found.accepted.right
        return [
            (
                "AUROC",
                number(found.auroc, "{:.4f}"),
                f">= {LEAST_AUROC:g}",
                None if found.auroc is None else found.auroc >= LEAST_AUROC,
            ),
            (
                "expected calibration error",
                f"{found.expected_calibration_error:.4f}",
                f"<= {MOST_ECE:g}",
                found.expected_calibration_error <= MOST_ECE,
            ),
            ("Brier score", f"{found.brier:.4f}", "", None),
            (
                "wrong of the trusted",
                share(wrong),
                f"<= {MOST_WRONG:.0%}",
                None if wrong is None else wrong.share <= MOST_WRONG,
            ),
            (
                "trusted of the right",
                share(right),
                f">= {LEAST_RIGHT:.0%}",
                None if right is None else right.share >= LEAST_RIGHT,
            ),
            ("trusted of all", share(found.accepted.coverage), "", None),
        ]

    def to_json(self) -> str:
        """Return the whole report as JSON text, one trial a line."""
        found = {
            "summary": asdict(self.summary),
            "targets": [
                {"what": what, "measured": measured, "target": target, "met": met}
                for what, measured, target, met in self.targets()
            ],
            "by_kind": [{"kind": kind, **asdict(row)} for kind, row in self.kinds().items()],
            "reliability_bins": [asdict(one) for one in self.bins],
        }
        return json_by_rows({**self.settings, **found}, "trials", map(asdict, self.outcomes))


def render(report: TrustReport, console: Console) -> None:
    """Print the tables: the targets, the trials by kind, the reliability bins."""
    console.print(_targets(report))
    console.print(_kinds(report))
    console.print(_bins(report))


def hindsight(report: TrustReport) -> str:
    """Say in one line what the best threshold would have let through."""
    found = report.summary
    if found.threshold is None or found.accepted_at_threshold is None:
        return f"no threshold leaves {MOST_WRONG:.0%} of the accepted wrong"
    accepted = found.accepted_at_threshold
    return (
        f"with hindsight, threshold {found.threshold:.3f}: trusted of the right {share(accepted.right)}, "
        f"wrong of the trusted {share(accepted.wrong)}"
    )


def met_in_words(met: bool | None) -> str:
    """Say whether a target is met; nothing where that can't be told."""
    return "" if met is None else "yes" if met else "no"


def _targets(report: TrustReport) -> Table:
    from rich.markup import escape

    table = make_table(
        report.title,
        f"[95 % Wilson interval]; {hindsight(report)}",
        ("",),
        ("measured", "target", "met"),
    )
    for what, measured, target, met in report.targets():
        table.add_row(what, escape(measured), target, met_in_words(met))
    return table


def _kinds(report: TrustReport) -> Table:
    table = make_table(
        "By kind of trial",
        "right: under 5 degrees and under 5 % of the larger scan's extent; disjoint, different, mirrored: "
        "nothing is right",
        ("",),
        ("trials", "right", "trusted\nright", "trusted\nwrong", "mean\nconfidence", "CPU, s"),
    )
    for kind, row in report.kinds().items():
        table.add_row(kind, *row.cells())
    return table


def _bins(report: TrustReport) -> Table:
    from rich.markup import escape

    table = make_table(
        "Reliability",
        "answers of like confidence: a calibrated one is right as often as it says",
        ("",),
        ("answers", "mean\nconfidence", "right"),
    )
    for one in report.bins:
        name = f"{one.low:.1f}-{one.high:.1f}"
        table.add_row(name, str(one.count), number(one.confidence, "{:.3f}"), escape(share(one.right)))
    return table
