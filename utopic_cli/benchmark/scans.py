"""Protocol ``scans``: real scans with known poses, started from random ones.

Definition. Every pair of a folder's ``gt.json`` (layout: `utopic_cli.benchmark.ground_truth`) whose
smaller-side overlap reaches a minimum is tried from several start poses: a rotation drawn uniformly
from SO(3) about the source's centroid, then a translation drawn uniformly from the cube of half
side *extent*, applied to the SOURCE alone. *Extent* is the diagonal of the bounding box of the
larger scan, as the scans lie in their files. The draw depends on (seed, the pair's position in
gt.json, number of the pose) and nothing else, so that every method, and every later run, meets the
same trials, however many pairs are chosen. Success: rotation error under 5 degrees and, at the
source's centroid, translation error under 5 % of the extent.

All methods end with the same refinement at full resolution (`utopic_cli.estimation.refinement`):
``utopic`` does so by itself, the baselines' estimates are given to it; the time includes it. With
``refine=False`` nobody gets it. Times are taken after the scans have been read; through the command
line they include starting Python and reading both files. On a machine that does other work at the
same time the wall time says little, and the CPU time beside it is the one to compare.

For commands: ``report = run(directory, ...)``, then ``render(report, console)`` prints the table
and ``report.to_json()`` is the text of the JSON file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from utopic_cli.benchmark.baselines import find_baselines
from utopic_cli.benchmark.ground_truth import KnownPair, measured_overlap, read_ground_truth
from utopic_cli.benchmark.method import Method, Trial, Utopic, UtopicCommand, checked, refined
from utopic_cli.benchmark.metrics import (
    MAX_RRE_DEG,
    MAX_RTE_SHARE,
    pair_extent,
    pose_error,
)
from utopic_cli.benchmark.scans_report import SCHEMA_VERSION, Attempt, Report, render
from utopic_cli.benchmark.speed_clock import cpu_seconds_so_far
from utopic_cli.benchmark.versions import versions
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.geometry.rigid import invert, random_rotation, rigid
from utopic_cli.io.scan import Scan, read_scan

__all__ = ["Attempt", "Report", "render", "run", "run_methods", "start_transformation"]

Progress = Callable[[int, int, str], None]


def run(
    directory: Path,
    pairs: int | None = None,
    poses: int = 3,
    seed: int = 0,
    baselines: Sequence[str] = (),
    min_overlap: float = 0.1,
    through_cli: bool = False,
    options: AlignOptions | None = None,
    progress: Progress | None = None,
) -> Report:
    """Measure ``utopic`` and baselines on a folder of scans.

    Args:
        directory: folder with scan files and ``gt.json``.
        pairs: try only so many, chosen evenly over the range of overlaps; None or 0 for all.
        poses: start poses a pair.
        seed: seed of the start poses and of the baselines.
        baselines: names from `utopic_cli.benchmark.baselines`.
        min_overlap: pairs whose smaller-side overlap is less are left out.
        through_cli: run ``utopic align`` in a process of its own on files, as a user does.
        options: options of ``utopic``; the defaults if None.
        progress: called with (attempts done, attempts in all, what comes next).

    Raises:
        InputError: ``gt.json``, a scan or the weights can't be used, or no pair is left.
        UsageError: a number makes no sense, a baseline is unknown or its library missing.
    """
    options = options or AlignOptions()
    utopic = UtopicCommand(options) if through_cli else Utopic(options)
    methods: tuple[Method, ...] = (utopic, *find_baselines(baselines))
    return run_methods(methods, directory, pairs, poses, seed, min_overlap, options.refine, progress)


def run_methods(
    methods: tuple[Method, ...],
    directory: Path,
    pairs: int | None = None,
    poses: int = 3,
    seed: int = 0,
    min_overlap: float = 0.1,
    refine: bool = True,
    progress: Progress | None = None,
) -> Report:
    """Measure any methods: what `run` does after it has put them together.

    Args:
        methods: at least one.
        directory: see `run`, as for the arguments after it.
        pairs: see `run`.
        poses: see `run`.
        seed: see `run`.
        min_overlap: see `run`.
        refine: give the estimates of methods that do not refine by themselves to the refinement.
        progress: see `run`.

    Raises:
        InputError: see `run`.
        UsageError: see `run`.
    """
    if poses < 1 or seed < 0 or (pairs or 0) < 0:
        raise UsageError("poses must be at least 1; seed and pairs must not be negative")
    settings = {
        "schema_version": SCHEMA_VERSION,
        "protocol": "scans",
        "directory": str(directory),
        "pairs": pairs or None,
        "poses": poses,
        "seed": seed,
        "min_overlap": min_overlap,
        "refine": refine,
        "success": {"rre_deg_below": MAX_RRE_DEG, "rte_share_of_extent_below": MAX_RTE_SHARE},
        "extent": "diagonal of the bounding box of the larger scan, as in its file",
        "methods": {method.name: method.settings() for method in methods},
        "versions": versions(),
    }
    read = lru_cache(maxsize=8)(read_scan)
    chosen = _choose(read_ground_truth(directory), read, pairs, min_overlap)
    total = len(chosen) * poses * len(methods)
    attempts: list[Attempt] = []
    for pair, overlap in chosen:
        source, target = read(pair.source), read(pair.target)
        extent = pair_extent(source.cloud, target.cloud)
        centroid = source.cloud.points.mean(axis=0)
        for pose in range(poses):
            start = start_transformation(seed, pair.index, pose, centroid, extent)
            moved = source.cloud.transformed(start)
            trial_seed = int(np.random.default_rng([seed, pair.index, pose, 1]).integers(2**31))
            trial = Trial(moved, target.cloud, extent, trial_seed, start, source, target)
            for method in methods:
                if progress:
                    what = f"{method.name}: {pair.source.name} -> {pair.target.name}"
                    progress(len(attempts), total, what)
                attempts.append(_attempt(method, trial, pair, pose, overlap, refine))
    if progress:
        progress(total, total, "done")
    return Report(settings, tuple(attempts))


def start_transformation(seed: int, pair: int, pose: int, centroid: np.ndarray, extent: float) -> np.ndarray:
    """Draw the start pose of a trial: what the source is moved by before any method sees it.

    Args:
        seed: the run's seed.
        pair: the pair's position in gt.json.
        pose: number of the pose.
        centroid: (3,) the source's centroid, which the rotation keeps in place.
        extent: the pair's extent, same units; the translation is uniform in +-extent per axis.

    Returns:
        (4, 4) float64.
    """
    rng = np.random.default_rng([seed, pair, pose])
    rotation = random_rotation(rng)
    shift = rng.uniform(-extent, extent, 3)
    return rigid(rotation, centroid + shift - rotation @ centroid)


def _choose(
    known: Sequence[KnownPair], read: Callable[[Path], Scan], pairs: int | None, min_overlap: float
) -> list[tuple[KnownPair, float]]:
    """Keep pairs with enough overlap, and at most ``pairs`` of them, evenly over the overlaps."""
    enough = []
    for pair in known:
        ratio = pair.overlap_ratio
        if ratio is None:
            source, target = read(pair.source).cloud, read(pair.target).cloud
            extent = pair_extent(source, target)
            ratio = measured_overlap(source, target, pair.gt_T_target_source, extent)
        if min(ratio.values()) >= min_overlap:
            enough.append((pair, min(ratio.values())))
    if not enough:
        raise InputError(f"gt.json: none of its {len(known)} pairs has an overlap of {min_overlap:g} or more")
    if not pairs or pairs >= len(enough):
        return enough
    by_overlap = sorted(enough, key=lambda entry: (-entry[1], entry[0].index))
    places = np.linspace(0, len(enough) - 1, pairs).round().astype(int)
    return sorted((by_overlap[place] for place in places), key=lambda entry: entry[0].index)


def _attempt(
    method: Method, trial: Trial, pair: KnownPair, pose: int, overlap: float, refine: bool
) -> Attempt:
    gt = pair.gt_T_target_source @ invert(trial.start)
    estimate, error, message = None, None, None
    begin, cpu_begin = time.perf_counter(), cpu_seconds_so_far()
    try:
        estimate = checked(method.estimate(trial))
        if refine and not method.refines:
            estimate = refined(trial, estimate)
    except Exception as raised:  # whatever a method does wrong is a failure of that method
        estimate, message = None, " ".join(f"{type(raised).__name__}: {raised}".splitlines())
    seconds, cpu_seconds = time.perf_counter() - begin, cpu_seconds_so_far() - cpu_begin
    if estimate is not None:
        error = pose_error(estimate, gt, trial.source.points.mean(axis=0), trial.extent)
    return Attempt(
        method=method.name,
        pair=pair.index,
        source=pair.source.name,
        target=pair.target.name,
        overlap=overlap,
        extent=trial.extent,
        pose=pose,
        gt_T_target_source=gt,
        T_target_source=estimate,
        error=error,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        message=message,
    )
