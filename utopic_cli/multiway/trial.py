"""A simulated folder of scans with a known answer, and how a batch does on it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from utopic_cli import __version__
from utopic_cli.config import AlignOptions
from utopic_cli.geometry.rigid import apply, invert, random_rotation, relative_rotation_error_deg, rigid
from utopic_cli.io.output import write_atomically
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.multiway.batch import run_batch
from utopic_cli.multiway.model import USED
from utopic_cli.multiway.outcome import BatchOutcome
from utopic_cli.multiway.plan import BatchRequest
from utopic_cli.multiway.workers import Task
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.scanner import range_scan
from utopic_cli.synthesis.surface import bounding_diagonal, sample_surface

VIEWS = 10
"""Scans of each object, all the way round: neighbours are about 36 degrees apart."""

FAMILIES = ("blended", "displaced")
"""Objects that look different from every side: of others no program can tell the views apart."""

POINTS = 9_000
NOISE = 0.0008  # of the range, as a share of the object's diagonal
WRONG_DEG, WRONG_SHARE = 5.0, 0.05
"""A pair that the final transformations put farther off than this (share of the diagonal) is wrong."""

_RESOLUTION = 72
_DENSE = 150_000
_CELL = 0.012


@dataclass(frozen=True)
class Known:
    """The answer for one scan.

    Attributes:
        thing: number of its object.
        T_thing_scan: (4, 4) from the scan's frame to its object's.
        diagonal: of the object's bounding box.
    """

    thing: int
    T_thing_scan: np.ndarray
    diagonal: float


@dataclass(frozen=True)
class TrialRow:
    """How one batch went.

    Attributes:
        scans: how many.
        objects: of how many objects.
        pairs: tried.
        all_pairs: N (N - 1) / 2.
        seconds: wall time of the batch.
        largest_mb: most memory that any one of its processes had, MiB; None where the system
            doesn't tell.
        exact: every group is one object's scans, all of them.
        placed: scans that lie in a group.
        wrong_joins: scans in a group most of whose scans are another object's.
        wrong_pairs: used pairs of two objects, or put wrongly.
        worst_deg: largest error of a scan's rotation, the frame of its group fixed at its first scan.
        worst_percent: largest error of the place of a scan's middle, percent of the diagonal.
    """

    scans: int
    objects: int
    pairs: int
    all_pairs: int
    seconds: float
    largest_mb: float | None
    exact: bool
    placed: int
    wrong_joins: int
    wrong_pairs: int
    worst_deg: float
    worst_percent: float


def run_trials(
    counts: Sequence[int],
    options: AlignOptions,
    *,
    workers: int = 1,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    make_task: Callable[[], Task] | None = None,
) -> list[TrialRow]:
    """Simulate folders of so many scans and run a batch on each, in a temporary folder.

    Args:
        counts: numbers of scans.
        options: of the pairwise registration.
        workers: processes.
        seed: of objects, views, noise, poses and names.
        progress: called with a word on what is at work.
        make_task: see ``run_batch``.
    """
    rows = []
    for count in counts:
        with TemporaryDirectory(prefix="utopic-") as folder:
            known = make_scans(Path(folder) / "scans", count, np.random.default_rng([seed, count]), progress)
            begin = time.monotonic()
            request = BatchRequest(
                (Path(folder) / "scans",), Path(folder) / "out", options=options, workers=workers
            )
            outcome = run_batch(request, progress=progress, make_task=make_task)
            rows.append(score(outcome, known, time.monotonic() - begin))
    return rows


def make_scans(
    folder: Path, count: int, rng: np.random.Generator, progress: Callable[[str], None] | None = None
) -> dict[str, Known]:
    """Write noisy scans of several objects, each in a pose of its own, their names in no order.

    Args:
        folder: is made.
        count: of scans; ``VIEWS`` of each object, the rest shared out.
        rng: source of randomness.
        progress: called with a word on what is at work.

    Returns:
        The answers by name.
    """
    folder.mkdir(parents=True)
    objects = max(1, round(count / VIEWS))
    numbers = rng.permutation(count)
    known: dict[str, Known] = {}
    for thing in range(objects):
        if progress is not None:
            progress(f"simulating object {thing + 1} of {objects}")
        vertices, faces = procedural_mesh(rng, _RESOLUTION, FAMILIES[thing % len(FAMILIES)])
        points, normals = sample_surface(vertices, faces, _DENSE, rng)
        diagonal = bounding_diagonal(points)
        of_it = numbers[thing::objects]
        for i, number in enumerate(of_it.tolist()):
            angle = 2.0 * np.pi * (i + rng.uniform(-0.1, 0.1)) / len(of_it)
            direction = np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.3, 0.5)])
            view = range_scan(
                points,
                normals,
                direction / np.linalg.norm(direction),
                rng,
                cell=_CELL,
                count=POINTS,
                noise=NOISE * diagonal,
            )
            pose = rigid(random_rotation(rng), rng.uniform(-2.0, 2.0, 3))
            moved = apply(invert(pose), view.points)
            name = f"scan-{number:05d}"
            data = scalar_cloud_ply(moved, np.full(moved.shape, 128, np.uint8), {})
            write_atomically(folder / f"{name}.ply", data, overwrite=False)
            known[name] = Known(thing, pose, diagonal)
    return known


def score(outcome: BatchOutcome, known: dict[str, Known], seconds: float) -> TrialRow:
    """Compare a batch with the answers.

    Args:
        outcome: of the batch.
        known: the answers by name, of all its scans.
        seconds: wall time it took.
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
        pairs=len(outcome.model.pairs),
        all_pairs=len(answers) * (len(answers) - 1) // 2,
        seconds=seconds,
        largest_mb=_largest_mb(),
        exact={frozenset(group) for group in groups} == {group for group in wanted if len(group) > 1},
        placed=sum(map(len, groups)),
        wrong_joins=strangers,
        wrong_pairs=wrong,
        worst_deg=max(degrees),
        worst_percent=100.0 * max(shares),
    )


def to_json(rows: Sequence[TrialRow], options: AlignOptions, workers: int, seed: int) -> str:
    """Return all rows with what they were measured with."""
    content = {
        "protocol": "batch",
        "utopic_cli": __version__,
        "options": asdict(options),
        "workers": workers,
        "seed": seed,
        "rows": [asdict(row) for row in rows],
    }
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


def _largest_mb() -> float | None:
    """Return the largest memory that this process or one it has waited for ever had."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    import sys

    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    most = max(resource.getrusage(kind).ru_maxrss for kind in kinds)
    return most / (1 << 20 if sys.platform == "darwin" else 1 << 10)
