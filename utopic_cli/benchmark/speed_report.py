"""What the protocol ``speed`` found: every case, tables, plots and JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.method import remarks
from utopic_cli.benchmark.plots import value_plot
from utopic_cli.benchmark.quoted import SECONDS, TIMED_ON
from utopic_cli.benchmark.reports import counted, make_table, number, with_weights
from utopic_cli.benchmark.speed_clock import Peak, Stopwatch
from utopic_cli.synthesis.packing import describe_data

if TYPE_CHECKING:
    from rich.table import Table

SCHEMA_VERSION = 1
FORWARD, ALIGN = "forward", "align"


@dataclass(frozen=True)
class Measurement:
    """One case; medians over the pairs.

    Attributes:
        what: ``forward``, ``align``, or the name of a baseline.
        points: most sampled points per cloud; None for baselines.
        batch: pairs in one forward.
        device: where the network runs.
        runs: how many were measured.
        nodes: mean number of points the network saw per cloud.
        wall_seconds: of one run, that is one batch.
        cpu_seconds: likewise, all threads.
        assignment_seconds: wall time of one linear assignment.
        peak_bytes: peak memory.
        idle_bytes: of that, before the first run (libraries, weights, pairs).
        right: answers under 5 degrees and under 5 % of the extent; None of a forward.
        steps_s: wall time by step of the pipeline.
        message: why there is no measurement.
    """

    what: str
    points: int | None
    batch: int
    device: str
    runs: int = 0
    nodes: float | None = None
    wall_seconds: float | None = None
    cpu_seconds: float | None = None
    assignment_seconds: float | None = None
    peak_bytes: int | None = None
    idle_bytes: int | None = None
    right: int | None = None
    steps_s: dict[str, float] = field(default_factory=dict)
    message: str | None = None

    def measured(self, watch: Stopwatch, peak: Peak, nodes: float | None = None) -> Measurement:
        """Return the case with what clock and scale say."""
        return replace(
            self,
            runs=watch.laps,
            nodes=nodes,
            wall_seconds=watch.wall_seconds,
            cpu_seconds=watch.cpu_seconds,
            peak_bytes=peak.peak_bytes,
            idle_bytes=peak.idle_bytes,
        )

    def with_answers(
        self, nodes: float | None, right: int, assignment_seconds: float | None, steps_s: dict[str, float]
    ) -> Measurement:
        """Return the case with what is known of its answers."""
        return replace(self, nodes=nodes, right=right, assignment_seconds=assignment_seconds, steps_s=steps_s)

    @property
    def pairs_per_second(self) -> float | None:
        """Throughput."""
        return None if not self.wall_seconds else self.batch / self.wall_seconds

    @property
    def assignment_share(self) -> float | None:
        """Wall time of the linear assignment over that of the whole."""
        if self.assignment_seconds is None or not self.wall_seconds:
            return None
        return self.assignment_seconds / self.wall_seconds


@dataclass(frozen=True)
class SpeedReport:
    """Everything one run found.

    Attributes:
        settings: the definition, what was asked for, the weights, versions and machine.
        measurements: in the order they were made.
    """

    settings: dict[str, Any]
    measurements: tuple[Measurement, ...]

    @property
    def title(self) -> str:
        """Protocol, data and weights in one line."""
        title = (
            f"speed: {counted(self.settings['pairs'], 'pair')} of {self.settings['shapes']} "
            f"'{self.settings['split']}' shapes, {describe_data(self.settings['data'])}, "
            f"seed {self.settings['seed']}"
        )
        return with_weights(title, [(self.settings["weights"], self.settings["weights_sha256"])])

    def tables(self) -> list[Table]:
        """Return the tables: the network alone, and whole alignments with the baselines."""
        return [_forwards(self), _alignments(self)]

    def losses(self) -> list[str]:
        """Say what must be known of methods, and which cases have no measurement, and why."""
        return remarks(self.settings.get("methods", {})) + [
            f"{one.what}, {one.points} points, batch {one.batch}, {one.device}: {one.message}"
            for one in self.measurements
            if one.message
        ]

    def figures(self) -> list[str]:
        """Draw wall time over the number of points, of the network alone and of everything."""
        series: dict[str, dict[str, list[tuple[float, float]]]] = {FORWARD: {}, ALIGN: {}}
        for one in self.measurements:
            if one.points is not None and one.wall_seconds is not None:
                name = f"{one.device}, batch {one.batch}" if one.what == FORWARD else one.device
                series[one.what].setdefault(name, []).append((one.points, one.wall_seconds / one.batch))
        most = float(max(self.settings["points"]))
        captions = {
            FORWARD: ("The network alone", "Wall time a pair."),
            ALIGN: ("Whole alignment", "Wall time, without reading and writing files."),
        }
        return [
            value_plot(*captions[what], ("points", "seconds"), lines, most, ("{:.0f}", "{:.3g}"))
            for what, lines in series.items()
        ]

    def to_json(self) -> str:
        """Return the whole report as indented JSON text."""
        rows = [
            {
                **asdict(one),
                "pairs_per_second": one.pairs_per_second,
                "assignment_share": one.assignment_share,
            }
            for one in self.measurements
        ]
        quoted = {"on": TIMED_ON, "seconds_by_points": SECONDS}
        content = {**self.settings, "quoted": quoted, "measurements": rows}
        return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _forwards(report: SpeedReport) -> Table:
    table = make_table(
        report.title,
        "the network alone, one CPU thread; medians over the pairs; peak of the process (of CUDA: what "
        "PyTorch held there), of which so much before the first run",
        (),
        ("points", "batch", "device", "nodes", "wall, s", "CPU, s", "pairs/s", "peak, MB", "before, MB"),
    )
    for one in report.measurements:
        if one.what == FORWARD:
            table.add_row(
                str(one.points),
                str(one.batch),
                one.device,
                number(one.nodes, "{:.0f}"),
                number(one.wall_seconds, "{:.3f}"),
                number(one.cpu_seconds, "{:.3f}"),
                number(one.pairs_per_second, "{:.2f}"),
                _megabytes(one.peak_bytes),
                _megabytes(one.idle_bytes),
            )
    return table


def _alignments(report: SpeedReport) -> Table:
    from rich.markup import escape

    table = make_table(
        "Whole alignments",
        "without reading and writing files; right: under 5 degrees and under 5 % of the extent; linear "
        "assignment: one, timed by itself, and its share of the whole; quoted: from the paper, on "
        "other pairs and another machine",
        ("method",),
        (
            "points",
            "device",
            "wall, s",
            "CPU, s",
            "right",
            "linear\nassignment, s",
            "share",
            "peak, MB",
            "before, MB",
        ),
    )
    for one in report.measurements:
        if one.what != FORWARD:
            table.add_row(
                escape(report.settings["weights"] if one.what == ALIGN else one.what),
                "" if one.points is None else str(one.points),
                one.device,
                number(one.wall_seconds, "{:.2f}"),
                number(one.cpu_seconds, "{:.2f}"),
                "-" if one.right is None else f"{one.right}/{one.runs}",
                number(one.assignment_seconds, "{:.4f}"),
                number(one.assignment_share, "{:.2%}"),
                _megabytes(one.peak_bytes),
                _megabytes(one.idle_bytes),
            )
    table.add_section()
    for name, seconds in SECONDS.items():
        table.add_row(
            f"{name} (quoted)",
            " / ".join(map(str, seconds)),
            TIMED_ON,
            " / ".join(f"{second:.2f}" for second in seconds.values()),
        )
    return table


def _megabytes(count: int | None) -> str:
    return "-" if count is None else f"{count / 1e6:.0f}"
