"""Protocols on synthetic pairs: ``modelnet``, ``modelonet``, ``range-scans``, ``rooms``, and the curves.

Definitions: ``protocols``, ``curves``. Everybody meets the same pairs in the same run. The matches of
networks and hand-made features go into the same robust solve; whole methods answer by themselves. Each
answer is measured twice: as solved (no refinement), and after the same refinement at full resolution.

For commands: ``report = run(protocol, shapes, ...)``, then ``reports.render(report, console)``
prints the tables and ``report.to_json()`` is the text of the JSON file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from utopic_cli.benchmark.answers import Answer, answer_pair
from utopic_cli.benchmark.contestants import Contestants, load_contestants
from utopic_cli.benchmark.curve_report import CurveReport
from utopic_cli.benchmark.held_out import held_out, made_of
from utopic_cli.benchmark.pool import each
from utopic_cli.benchmark.protocols import AnyProtocol
from utopic_cli.benchmark.synthetic_report import SCHEMA_VERSION, Report
from utopic_cli.benchmark.versions import versions
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError
from utopic_cli.estimation.prior import Prior
from utopic_cli.synthesis.shapes import ShapeLibrary

Progress = Callable[[int, int, str], None]


def run(
    protocol: AnyProtocol,
    shapes: ShapeLibrary,
    data: str,
    pairs: int = 300,
    seed: int = 0,
    weights: Sequence[str] = ("utopic",),
    baselines: Sequence[str] = (),
    workers: int = 1,
    points: int = AlignOptions().points,
    max_rotation: float = AlignOptions().max_rotation,
    device: str = "auto",
    progress: Progress | None = None,
) -> Report:
    """Measure weights and baselines on the pairs of a protocol.

    Args:
        protocol: makes the pairs.
        shapes: a library; only its shapes held out from training are used.
        data: what to call them.
        pairs: how many pairs in all.
        seed: of the pairs and of the networks' own draws.
        weights: bundled names or paths.
        baselines: names from ``contestants.KNOWN``.
        workers: processes, each with one thread; the results do not depend on their number.
        points: most sampled points per cloud.
        max_rotation: degrees beyond which the robust solve takes no answer; whole methods are not told.
        device: of the networks.
        progress: called with (pairs done, pairs in all, what goes on).

    Raises:
        InputError: no held-out shapes, no pair can be made of them, or weights can't be used.
        UsageError: a number makes no sense, or an unknown or unusable baseline.
    """
    if pairs < 1 or workers < 1 or seed < 0:
        raise UsageError("pairs and workers must be at least 1, and the seed not negative")
    test, split = held_out(shapes)
    load = partial(load_contestants, tuple(weights), tuple(baselines), seed, device)
    settings: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "protocol": protocol.settings(),
        "data": data,
        "split": split,
        "shapes": len(test),
        "pairs": pairs,
        "seed": seed,
        "points": points,
        "max_rotation": max_rotation,
        "workers": workers,
        # Loaded here once, so that what can't be used ends the run before any work.
        "methods": load().settings(),
        "versions": versions(),
    }

    def tell(done: int, of: int) -> None:
        if progress is not None:
            progress(done, of, f"{protocol.name}, pairs of {data}")

    answers = each(
        partial(_task, protocol, test, data, seed, points, Prior(max_rotation=max_rotation), load),
        pairs,
        workers,
        tell,
    )
    kind = CurveReport if "levels" in settings["protocol"] else Report
    return kind(settings, protocol.groups, tuple(answer for some in answers for answer in some))


def _task(
    protocol: AnyProtocol,
    shapes: ShapeLibrary,
    data: str,
    seed: int,
    points: int,
    prior: Prior,
    load: Callable[[], Contestants],
) -> Callable[[int], list[Answer]]:
    """What a worker does once, before it answers pairs by number."""
    return partial(answers_to, protocol, shapes, data, seed, points, prior, load())


def answers_to(
    protocol: AnyProtocol,
    shapes: ShapeLibrary,
    data: str,
    seed: int,
    points: int,
    prior: Prior,
    contestants: Contestants,
    number: int,
) -> list[Answer]:
    """Make pair ``number`` and let everybody answer it; arguments as for ``run``.

    Raises:
        InputError: no such pair can be made of the shapes.
    """
    with made_of(data):
        pair = protocol.pair(shapes, seed, number)
    return answer_pair(pair, number, protocol, contestants, points, seed, prior)
