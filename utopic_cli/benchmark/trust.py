"""Protocol ``confidence``: is the confidence of an alignment what it says, and whom does it let through.

Labelled trials (``trials``), about half of which have an answer that can be found, are registered
as a user's files are; the confidence is compared with whether the answer was right. The shapes are
those that neither training nor the calibration has seen.

For commands: ``report = run(shapes, data, ...)``, then ``render(report, console)`` prints the tables,
``report.to_json()`` is the text of the JSON file and ``trust_page.page(report)`` the HTML page.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from utopic_cli.benchmark import trial_folder
from utopic_cli.benchmark.held_out import made_of
from utopic_cli.benchmark.labelled import Trial
from utopic_cli.benchmark.metrics import pose_error
from utopic_cli.benchmark.pool import each
from utopic_cli.benchmark.trial_folder import FolderTrials
from utopic_cli.benchmark.trials import KINDS, bench_half, trial
from utopic_cli.benchmark.trust_report import SCHEMA_VERSION, Outcome, TrustReport, render
from utopic_cli.benchmark.versions import versions
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.model.weights import load_weights
from utopic_cli.pipeline import register
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import RegistrationResult
from utopic_cli.synthesis.shapes import ShapeLibrary

__all__ = ["Outcome", "TrustReport", "render", "run", "run_folder"]

Progress = Callable[[int, int, str], None]


class Register(Protocol):
    """Anything that is called as ``pipeline.register`` is."""

    def __call__(self, source: PointCloud, target: PointCloud, options: AlignOptions) -> RegistrationResult:
        """Register two clouds."""
        ...


def run(
    shapes: ShapeLibrary,
    data: str,
    pairs: int = 300,
    seed: int = 0,
    options: AlignOptions | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> TrustReport:
    """Measure the verdict on labelled trials.

    Args:
        shapes: a library; only ``trials.bench_half`` of it is used.
        data: what to call it.
        pairs: number of trials.
        seed: of the trials; the pipeline's is among the options.
        options: of the pipeline; the defaults if None.
        workers: processes, each with one thread; the results do not depend on their number.
        progress: called with (trials done, trials in all, what goes on).

    Raises:
        InputError: no held-out shapes, no trial can be made of them, or the weights can't be used
            or carry no calibration.
        UsageError: a number makes no sense.
    """
    half = bench_half(shapes)
    what = f"{len(half)} held-out shapes of {data}"
    return _measure(partial(_made_of, half, data, seed), KINDS, what, pairs, seed, options, workers, progress)


def run_folder(
    directory: Path,
    pairs: int | None = None,
    seed: int = 0,
    options: AlignOptions | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> TrustReport:
    """Measure the verdict on real scans: every pair of a folder, those that don't overlap as well.

    Args:
        directory: folder with scan files and ``gt.json``.
        pairs: number of trials; the pairs in turn, then again from other start poses. None: each once.
        seed: of the start poses.
        options: see `run`, as for the arguments after it.
        workers: see `run`.
        progress: see `run`.

    Raises:
        InputError: ``gt.json``, a scan or the weights can't be used, or these carry no calibration.
        UsageError: a number makes no sense.
    """
    trials = FolderTrials.of(directory, seed)
    count = len(trials.pairs) if pairs is None else pairs
    what = f"{len(trials.pairs)} pairs of scans in {directory}"
    return _measure(trials, trial_folder.KINDS, what, count, seed, options, workers, progress)


def _measure(
    make: Callable[[int], Trial],
    kinds: Sequence[str],
    what: str,
    pairs: int,
    seed: int,
    options: AlignOptions | None,
    workers: int,
    progress: Progress | None,
) -> TrustReport:
    if pairs < 1 or workers < 1 or seed < 0:
        raise UsageError("pairs and workers must be at least 1, and the seed not negative")
    options = options or AlignOptions()
    card = load_weights(options.weights)[1]  # so that weights that can't be used are no failed trials
    settings = {
        "schema_version": SCHEMA_VERSION,
        "protocol": "confidence",
        "data": what,
        "pairs": pairs,
        "seed": seed,
        "kinds": list(kinds),
        "options": asdict(options),
        "weights_name": card["name"],
        "weights_sha256": card["sha256"],
        "calibration": card.get("calibration"),
        "workers": workers,
        "versions": versions(),
    }

    def tell(done: int, of: int) -> None:
        if progress is not None:
            progress(done, of, f"confidence, {what}")

    return TrustReport(settings, tuple(each(partial(_task, make, options), pairs, workers, tell)))


def _made_of(shapes: ShapeLibrary, data: str, seed: int, number: int) -> Trial:
    with made_of(data):
        return trial(shapes, seed, number)


def _task(make: Callable[[int], Trial], options: AlignOptions) -> Callable[[int], Outcome]:
    return partial(judge, register, make, options)


def judge(register: Register, make: Callable[[int], Trial], options: AlignOptions, number: int) -> Outcome:
    """Make trial ``number``, register it, and say what was claimed and what is true.

    No transformation found is an answer too: one without any confidence.

    Raises:
        InputError: no such trial can be made, or the result carries no confidence.
    """
    made = make(number)
    about = (number, made.kind, made.shape, made.overlap, len(made.source), len(made.target))
    answerable = made.gt_T_target_source is not None
    begin = time.process_time()
    try:
        result = register(made.source, made.target, options)
    except InputError as error:
        seconds = time.process_time() - begin
        return Outcome(*about, answerable, right=False, confidence=0.0, trusted=False, reasons=(str(error),),
                       rotation_deg=None, translation_share=None, cpu_seconds=seconds)  # fmt: skip
    seconds = time.process_time() - begin
    if result.confidence is None:
        raise InputError(
            f"{options.weights}: these weights carry no calibration, so there is no confidence to measure; "
            "choose others"
        )
    rotation = translation = None
    if made.gt_T_target_source is not None:
        centroid = np.asarray(made.source.points).mean(axis=0)
        off = pose_error(result.T_target_source, made.gt_T_target_source, centroid, made.extent)
        rotation, translation = off.rre_deg, off.rte_share
    return Outcome(
        *about,
        answerable,
        right=made.right(result.T_target_source),
        confidence=float(result.confidence),
        trusted=bool(result.trusted),
        reasons=result.reasons,
        rotation_deg=rotation,
        translation_share=translation,
        cpu_seconds=seconds,
    )
