"""A simulated folder of scans with a known answer: someone walks round some objects, in no order."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.geometry.rigid import apply, invert, random_rotation, rigid
from utopic_cli.io.output import write_atomically
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.scanner import range_scan
from utopic_cli.synthesis.surface import bounding_diagonal, sample_surface

VIEWS = 10
"""Scans of each object, all the way round: neighbours are about 36 degrees apart."""

FAMILIES = ("blended", "displaced")
"""Objects that look different from every side: of others no program can tell the views apart."""

POINTS = 9_000
NOISE = 0.0008  # of the range, as a share of the object's diagonal

NEAR = 0.04
"""Within this share of the diagonal points overlap: about as far as some hundreds of them lie apart."""

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


def simulated(
    folder: Path, count: int, seed: int, progress: Callable[[str], None] | None = None
) -> dict[str, Known]:
    """Make scans as ``make_scans`` does, unless an earlier call has; their answers lie beside them.

    Args:
        folder: of ``scans`` and ``known.json``; its parent exists.
        count: of scans.
        seed: of everything random.
        progress: see ``make_scans``.
    """
    answers = folder / "known.json"
    if not answers.exists():
        folder.mkdir(exist_ok=True)
        known = make_scans(folder / "scans", count, np.random.default_rng([seed, count]), progress)
        content = {
            name: {"thing": one.thing, "T_thing_scan": one.T_thing_scan.tolist(), "diagonal": one.diagonal}
            for name, one in known.items()
        }
        write_atomically(answers, json.dumps(content).encode("ascii"), overwrite=True)
    return read_known(answers)


def read_known(path: Path) -> dict[str, Known]:
    """Read answers that ``simulated`` wrote."""
    return {
        name: Known(int(one["thing"]), np.array(one["T_thing_scan"]), float(one["diagonal"]))
        for name, one in json.loads(path.read_bytes()).items()
    }


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
    folder.mkdir(parents=True, exist_ok=True)
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
            write_atomically(folder / f"{name}.ply", data, overwrite=True)
            known[name] = Known(thing, pose, diagonal)
    return known


def overlap_ratio(points: tuple[np.ndarray, np.ndarray], known: tuple[Known, Known]) -> float:
    """Return which share of two scans overlaps, the smaller of the two; 0 for scans of two objects.

    Args:
        points: (N, 3), (M, 3) some hundreds of each scan's points, in the scans' frames.
        known: their answers.
    """
    if known[0].thing != known[1].thing:
        return 0.0
    placed = [apply(one.T_thing_scan, some) for one, some in zip(known, points, strict=True)]
    near = NEAR * known[0].diagonal
    return min(
        float((cKDTree(placed[1 - i]).query(placed[i], distance_upper_bound=near)[0] < near).mean())
        for i in range(2)
    )
