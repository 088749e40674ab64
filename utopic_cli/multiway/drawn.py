"""Answers drawn from registered ones: a batch at sizes at which registering would take days.

Which pairs a batch tries, and what choosing, connecting and writing cost it, follows from how scans look
to the network, and from how often and how surely pairs are answered. The former is real here too; the
latter is drawn from pairs that were registered: for two scans of an object from the pairs that overlapped
about as much, for scans of two objects from those of two objects. What is lost is that wrong answers
of one object resemble each other, so what a batch makes of drawn answers says little about its groups.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.config import AlignOptions
from utopic_cli.geometry.rigid import apply, invert, random_rotation, rigid
from utopic_cli.io.scan import Scan
from utopic_cli.multiway.outcome import BatchOutcome
from utopic_cli.multiway.simulated import Known, overlap_ratio, read_known
from utopic_cli.multiway.tasks import DescribeJob, Job, Reader, make_worker, sample_of

ALIKE = 9
"""An answer is drawn from this many pairs, those whose overlap is most like the pair's."""

LOOKED_AT = 600
"""Points of each scan by which the overlap of a pair is told."""

COPIED = ("confidence", "trusted", "overlap_ratio", "covariance", "unobservable")


def answers_of(outcome: BatchOutcome, known: Mapping[str, Known]) -> list[dict[str, Any]]:
    """Return what was answered of each pair registered, and by how much that was wrong, as JSON-ready data.

    Keys: ``same`` (object), ``overlap`` (see ``overlap_ratio``), ``errors``: of the answer and of each of its
    rivals, (4, 4) about the middle of the source, lengths in diagonals of the object; and what is copied.
    """
    answers = []
    for (source, target), record in outcome.records.items():
        if record["status"] != "done":
            continue
        report = record["report"]
        both = (known[outcome.scans[source].file.name], known[outcome.scans[target].file.name])
        middle = rigid(np.eye(3), np.array(outcome.described[source]["centroid"]))
        right = invert(both[1].T_thing_scan) @ both[0].T_thing_scan @ middle
        given = [report["T_target_source"], *report["ambiguous_with"]]
        errors = [
            _scaled(invert(right) @ np.array(answer) @ middle, 1.0 / both[0].diagonal) for answer in given
        ]
        clouds = tuple(sample_of(outcome.described[scan])[:LOOKED_AT] for scan in (source, target))
        answers.append(
            {
                "same": both[0].thing == both[1].thing,
                "overlap": overlap_ratio((clouds[0], clouds[1]), both),
                "errors": [error.tolist() for error in errors],
                **{name: report[name] for name in COPIED},
            }
        )
    return answers


def make_drawing(
    options: AlignOptions, version: str, card: str, known: str, answers: str
) -> Callable[[Job], Any]:
    """Return a task like that of ``tasks.make_worker`` that draws instead of registering.

    Args:
        options: see there.
        version: see there.
        card: see there.
        known: path of the scans' answers, see ``simulated``.
        answers: path of a JSON file of what ``answers_of`` returned.
    """
    work = make_worker(options, version, card)
    reader = Reader(options.seed)
    scans = read_known(Path(known))
    drawn_from = json.loads(Path(answers).read_bytes())

    def task(job: Job) -> dict[str, Any]:
        if isinstance(job, DescribeJob):
            return work(job)
        both = (scans[job.source.path.stem], scans[job.target.path.stem])
        seeds = [int(scan.sha256[:16], 16) for scan in (job.source, job.target)]
        return draw((reader(job.source), reader(job.target)), both, drawn_from, np.random.default_rng(seeds))

    return task


def draw(
    scans: tuple[Scan, Scan],
    known: tuple[Known, Known],
    answers: list[dict[str, Any]],
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return the part of a registration's report that a batch reads.

    Args:
        scans: source and target.
        known: their answers.
        answers: to draw from, see ``answers_of``.
        rng: source of randomness.
    """
    clouds = [scan.cloud.points[rng.permutation(len(scan.cloud))[:LOOKED_AT]] for scan in scans]
    overlap = overlap_ratio((clouds[0], clouds[1]), known)
    same = known[0].thing == known[1].thing
    eligible = sorted(
        (abs(one["overlap"] - overlap), i) for i, one in enumerate(answers) if one["same"] == same
    )
    chosen = answers[eligible[int(rng.integers(min(ALIKE, len(eligible))))][1]]
    centres = [scan.cloud.points.mean(axis=0) for scan in scans]
    middle = rigid(np.eye(3), centres[0])
    if same:
        right = invert(known[1].T_thing_scan) @ known[0].T_thing_scan @ middle
        errors = [_scaled(np.array(error), known[0].diagonal) for error in chosen["errors"]]
    else:  # any turn that lays middle on middle
        right = rigid(np.eye(3), centres[1])
        errors = [rigid(random_rotation(rng), np.zeros(3)) for _ in chosen["errors"]]
    given = [right @ error @ invert(middle) for error in errors]
    return {
        "T_target_source": given[0].tolist(),
        "ambiguous_with": [rival.tolist() for rival in given[1:]],
        "covariance_about": apply(given[0], centres[0]).tolist(),
        **{name: chosen[name] for name in COPIED},
    }


def _scaled(motion: np.ndarray, factor: float) -> np.ndarray:
    return rigid(motion[:3, :3], factor * motion[:3, 3])
