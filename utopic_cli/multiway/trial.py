"""How a batch does on simulated scans whose answer is known, and how its work grows with them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from utopic_cli import __version__
from utopic_cli.config import AlignOptions
from utopic_cli.errors import OutputError, UsageError
from utopic_cli.geometry.rigid import apply, invert, relative_rotation_error_deg
from utopic_cli.io.output import write_atomically
from utopic_cli.multiway.batch import run_batch, weights_of
from utopic_cli.multiway.drawn import answers_of, make_drawing
from utopic_cli.multiway.journal import fingerprint
from utopic_cli.multiway.model import USED
from utopic_cli.multiway.outcome import BatchOutcome
from utopic_cli.multiway.plan import BatchRequest
from utopic_cli.multiway.simulated import Known, simulated
from utopic_cli.multiway.workers import Task

WRONG_DEG, WRONG_SHARE = 5.0, 0.05
"""A pair that the final transformations put farther off than this (share of the diagonal) is wrong."""


@dataclass(frozen=True)
class TrialRow:
    """How one batch went.

    Attributes:
        scans: how many.
        objects: of how many objects.
        drawn: whether pairs were answered by drawing, see ``drawn``, and not registered.
        pairs: tried.
        all_pairs: N (N - 1) / 2.
        scan_s: mean wall time of describing a scan, seconds; 0 where all pairs are tried.
        pair_s: mean wall time of registering a pair; where answers are drawn, that of all registered ones.
        own_s: wall time of everything else: hashing, choosing, connecting, writing.
        own_mb: most memory that this process ever had, MiB; None where the system doesn't tell.
        worker_mb: most memory that any of its worker processes ever had.
        exact: every group is one object's scans, all of them.
        placed: scans that lie in a group.
        wrong_joins: scans in a group most of whose scans are another object's.
        wrong_pairs: used pairs of two objects, or put wrongly.
        worst_deg: largest error of a scan's rotation, the frame of its group fixed at its first scan.
        worst_percent: largest error of the place of a scan's middle, percent of the diagonal.
    """

    scans: int
    objects: int
    drawn: bool
    pairs: int
    all_pairs: int
    scan_s: float
    pair_s: float
    own_s: float
    own_mb: float | None
    worker_mb: float | None
    exact: bool
    placed: int
    wrong_joins: int
    wrong_pairs: int
    worst_deg: float
    worst_percent: float

    @property
    def work_s(self) -> float:
        """What one worker takes for all scans and pairs, seconds; measured unless pairs are drawn."""
        return self.scans * self.scan_s + self.pairs * self.pair_s


def run_trials(
    counts: Sequence[int],
    options: AlignOptions,
    *,
    drawn: Sequence[int] = (),
    workers: int = 1,
    seed: int = 0,
    folder: Path | None = None,
    progress: Callable[[str], None] | None = None,
    make_task: Callable[[], Task] | None = None,
) -> list[TrialRow]:
    """Simulate folders of so many scans and run a batch on each.

    Args:
        counts: numbers of scans.
        options: of the pairwise registration.
        drawn: further numbers, whose pairs get answers drawn from those of the pairs registered.
        workers: processes.
        seed: of objects, views, noise, poses and names.
        folder: where all is kept, and gone on with by a later call; a temporary one if None.
        progress: called with a word on what is at work.
        make_task: see ``run_batch``.

    Raises:
        UsageError: the pairs registered don't tell what to draw.
        OutputError: the folder can't be made.
    """
    rows: list[TrialRow] = []
    answers: list[dict[str, Any]] = []
    with TemporaryDirectory(prefix="utopic-") if folder is None else nullcontext(str(folder)) as kept:
        for count in [*counts, *drawn]:
            home = _made(Path(kept) / f"{count}-scans-seed-{seed}")
            known = simulated(home, count, seed, progress)
            drawing = len(rows) >= len(counts)
            out = home / (f"drawn-{fingerprint(answers)[:8]}" if drawing else "out")
            if drawing:
                if {one["same"] for one in answers} != {True, False}:
                    raise UsageError(
                        "drawn answers need registered pairs of one object and of two: --scans 20"
                    )
                told = home / "answers.json"
                write_atomically(told, json.dumps(answers).encode("ascii"), overwrite=True)
                card = weights_of(options)["card"]
                make_task = partial(
                    make_drawing, options, __version__, card, str(home / "known.json"), str(told)
                )
            request = BatchRequest(
                (home / "scans",), out, options=options, workers=workers, resume=True, overwrite=False
            )
            outcome = run_batch(request, progress=progress, make_task=make_task)
            row = score(outcome, known, _mean_seconds(out / "scans"))
            if drawing:
                pair_s = float(np.mean([one.pair_s for one in rows if not one.drawn]))
                row = replace(row, drawn=True, pair_s=pair_s)
            else:
                answers += answers_of(outcome, known)
            rows.append(row)
    return rows


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: the folder can't be made ({error.strerror})") from None
    return folder


def score(outcome: BatchOutcome, known: dict[str, Known], scan_s: float) -> TrialRow:
    """Compare a batch with the answers.

    Args:
        outcome: of the batch.
        known: the answers by name, of all its scans.
        scan_s: mean wall time of describing a scan, seconds.
    """
    answers = [known[entry.file.name] for entry in outcome.scans]
    objects = {answer.thing for answer in answers}
    groups = [list(group.T_world_scan) for group in outcome.model.groups]
    wanted = {frozenset(i for i, a in enumerate(answers) if a.thing == thing) for thing in objects}
    degrees, shares, strangers = [0.0], [0.0], 0
    for group in groups:
        things = [answers[scan].thing for scan in group]
        strangers += len(things) - max(map(things.count, things))
        for scan in group[1:]:
            if answers[scan].thing == answers[group[0]].thing:
                turn, shift = _error(outcome, answers, scan, group[0])
                degrees.append(turn)
                shares.append(shift)
    wrong = 0
    for pair in outcome.model.pairs:
        if pair.verdict == USED:
            same = answers[pair.source].thing == answers[pair.target].thing
            turn, shift = _error(outcome, answers, pair.source, pair.target) if same else (180.0, 1.0)
            wrong += turn > WRONG_DEG or shift > WRONG_SHARE
    return TrialRow(
        scans=len(answers),
        objects=len(objects),
        drawn=False,
        pairs=len(outcome.model.pairs),
        all_pairs=len(answers) * (len(answers) - 1) // 2,
        scan_s=scan_s,
        pair_s=float(np.mean([record["seconds"] for record in outcome.records.values()])),
        own_s=outcome.seconds - outcome.waited_s,
        own_mb=_most_mb("RUSAGE_SELF"),
        worker_mb=_most_mb("RUSAGE_CHILDREN"),
        exact={frozenset(group) for group in groups} == {group for group in wanted if len(group) > 1},
        placed=sum(map(len, groups)),
        wrong_joins=strangers,
        wrong_pairs=wrong,
        worst_deg=max(degrees),
        worst_percent=100.0 * max(shares),
    )


def measured_with(options: AlignOptions, workers: int, seed: int) -> dict[str, Any]:
    """Return what rows are measured with, JSON-ready.

    Raises:
        InputError: the weights or the device can't be used.
    """
    weights = weights_of(options)
    return {
        "protocol": "batch",
        "utopic_cli": __version__,
        "options": asdict(options),
        "weights_name": weights["name"],
        "weights_sha256": weights["sha256"],
        "workers": workers,
        "seed": seed,
    }


def to_json(rows: Sequence[TrialRow], settings: Mapping[str, Any]) -> str:
    """Return all rows with what they were measured with."""
    content = {**settings, "rows": [{**asdict(row), "work_s": row.work_s} for row in rows]}
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _error(outcome: BatchOutcome, answers: Sequence[Known], source: int, target: int) -> tuple[float, float]:
    """Return how wrongly one scan lies relative to another: degrees, and share of the diagonal."""
    places = [outcome.scans[scan].T_world_scan for scan in (source, target)]
    assert places[0] is not None and places[1] is not None  # both lie in a group
    found = invert(places[1]) @ places[0]
    right = invert(answers[target].T_thing_scan) @ answers[source].T_thing_scan
    middle = np.array(outcome.described[source]["centroid"])
    gap = float(np.linalg.norm(apply(found, middle) - apply(right, middle)))
    return relative_rotation_error_deg(found, right), gap / answers[source].diagonal


def _mean_seconds(records: Path) -> float:
    """Return how long the jobs of a folder of records took, on average."""
    return float(
        np.mean([json.loads(path.read_bytes())["seconds"] for path in sorted(records.glob("*.json"))])
    )


def _most_mb(whose: str) -> float | None:
    """Return the most memory that this process, or one it has waited for, ever had."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    import sys

    most = resource.getrusage(getattr(resource, whose)).ru_maxrss
    return most / (1 << 20 if sys.platform == "darwin" else 1 << 10)
