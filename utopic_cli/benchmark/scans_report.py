"""What the protocol ``scans`` found: every attempt, the summary by overlap band, table and JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from utopic_cli.benchmark.method import remarks
from utopic_cli.benchmark.metrics import (
    MAX_RRE_DEG,
    MAX_RTE_SHARE,
    OVERLAP_BANDS,
    PoseError,
    Summary,
    band_name,
    overlap_band,
    summarise,
)
from utopic_cli.benchmark.reports import counted, make_table, number, with_weights

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Attempt:
    """One method on one trial.

    Attributes:
        method: its name.
        pair: the pair's position in gt.json.
        source: file name of the scan that moves.
        target: file name of the scan that stays.
        overlap: overlap ratio of the smaller side.
        extent: the pair's extent, file units.
        pose: number of the start pose.
        gt_T_target_source: (4, 4) answer from the start pose.
        T_target_source: (4, 4) estimate, or None.
        error: distance between the two, or None.
        seconds: wall time.
        cpu_seconds: CPU time of all threads, and of processes it started.
        message: what was raised where there is no estimate.
    """

    method: str
    pair: int
    source: str
    target: str
    overlap: float
    extent: float
    pose: int
    gt_T_target_source: np.ndarray
    T_target_source: np.ndarray | None
    error: PoseError | None
    seconds: float
    cpu_seconds: float
    message: str | None = None

    @property
    def success(self) -> bool:
        """Whether there is an estimate within both bounds."""
        return self.error is not None and self.error.success

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready data."""
        estimate = self.T_target_source
        return {
            "method": self.method,
            "pair": self.pair,
            "source": self.source,
            "target": self.target,
            "overlap": self.overlap,
            "band": overlap_band(self.overlap),
            "extent": self.extent,
            "pose": self.pose,
            "success": self.success,
            "rre_deg": None if self.error is None else self.error.rre_deg,
            "rte": None if self.error is None else self.error.rte,
            "rte_share": None if self.error is None else self.error.rte_share,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "message": self.message,
            "gt_T_target_source": self.gt_T_target_source.tolist(),
            "T_target_source": None if estimate is None else estimate.tolist(),
        }


@dataclass(frozen=True)
class Report:
    """Everything one run of the protocol found.

    Attributes:
        settings: what the run was asked for, the methods' settings, versions and machine.
        attempts: in the order of pairs, poses, methods.
    """

    settings: dict[str, Any]
    attempts: tuple[Attempt, ...]

    def summaries(self) -> dict[str, dict[str, Summary]]:
        """Summarise by band, then by method; bands and methods without attempts are left out."""
        table: dict[str, dict[str, Summary]] = {}
        for name in (band_name(*band) for band in OVERLAP_BANDS):
            members = [attempt for attempt in self.attempts if overlap_band(attempt.overlap) == name]
            for method in dict.fromkeys(attempt.method for attempt in members):
                own = [attempt for attempt in members if attempt.method == method]
                table.setdefault(name, {})[method] = summarise(
                    [a.error for a in own], [a.seconds for a in own], [a.cpu_seconds for a in own]
                )
        return table

    @property
    def title(self) -> str:
        """Protocol, data and weights in one line."""
        tried = len({attempt.pair for attempt in self.attempts})
        title = (
            f"scans: {self.settings['directory']} - {counted(tried, 'pair')} x "
            f"{counted(self.settings['poses'], 'start pose')}, seed {self.settings['seed']}"
        )
        methods = self.settings.get("methods", {}).values()
        networks = [(one["weights_name"], one["weights_sha256"]) for one in methods if "weights_name" in one]
        return with_weights(title, networks)

    def tables(self) -> list[Table]:
        """Return the table by overlap band."""
        return [_by_band(self)]

    def losses(self) -> list[str]:
        """Say what must be known of methods, and which exceptions ended how many attempts, by lines."""
        messages = [(attempt.method, attempt.message) for attempt in self.attempts if attempt.message]
        return remarks(self.settings.get("methods", {})) + [
            f"{method} failed {messages.count((method, message))} times with {message}"
            for method, message in sorted(set(messages))
        ]

    def to_json(self) -> str:
        """Return the whole report as indented JSON text."""
        rows = [
            {"band": band, "method": method, **asdict(summary)}
            for band, methods in self.summaries().items()
            for method, summary in methods.items()
        ]
        attempts = [attempt.to_dict() for attempt in self.attempts]
        content = {**self.settings, "summary": rows, "attempts": attempts}
        return json.dumps(content, indent=2, allow_nan=False) + "\n"


def render(report: Report, console: Console) -> None:
    """Print the table by overlap band, and the failures that raised an exception."""
    for table in report.tables():
        console.print(table)
    console.print("Medians of RRE and RTE; means of wall and CPU time.", highlight=False)
    for line in report.losses():
        console.print(line, markup=False, highlight=False)


def _by_band(report: Report) -> Table:
    table = make_table(
        report.title,
        f"success: RRE < {MAX_RRE_DEG:g} deg and RTE < {MAX_RTE_SHARE:.0%} of the extent, "
        "RTE at the source's centroid; overlap of the smaller side",
        ("overlap", "method"),
        ("success", "RRE of\nsuccesses, deg", "RRE of\nall, deg", "RTE of\nsuccesses", "time, s", "CPU, s"),
    )
    for band, methods in report.summaries().items():
        for place, (method, summary) in enumerate(methods.items()):
            table.add_row(
                band if place == 0 else "",
                method,
                f"{summary.successes}/{summary.attempts} ({summary.success_rate:.0%})",
                number(summary.median_rre_deg_of_successes, "{:.3f}"),
                number(summary.median_rre_deg, "{:.2f}"),
                number(summary.median_rte_share_of_successes, "{:.3%}"),
                f"{summary.mean_seconds:.2f}",
                f"{summary.mean_cpu_seconds:.2f}",
            )
        table.add_section()
    return table
