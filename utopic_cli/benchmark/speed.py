"""Protocol ``speed``: time and memory of the network alone and of a whole alignment, by number of points.

Definition. Simulated range scans of held-out shapes (20,000 points each where as many are seen, overlap
.5 to .9, any pose) are read into memory before any clock starts. Every case (so many points, a batch, a
device) runs in a process of its own with one CPU thread: once unmeasured, then once for each pair.
*forward* is the network on a prepared pair, a batch of 4 being the same pair four times; *align* is
``utopic_cli.pipeline.register``, everything that ``utopic align`` does between reading and writing.
Baselines get the same pairs and are followed by the same refinement. The linear assignment (the
paper's; the robust solve tries what follows from it beside other hypotheses) is timed by itself on
the pair's matching scores. Memory is the peak of the process, or, of a network on CUDA, what PyTorch
has held there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from utopic_cli.benchmark.baselines import find_baselines
from utopic_cli.benchmark.curves import BAND, CLEAN, SCAN_POINTS
from utopic_cli.benchmark.held_out import held_out, made_of
from utopic_cli.benchmark.method import Trial, checked, refined
from utopic_cli.benchmark.metrics import pair_extent, pose_error
from utopic_cli.benchmark.pool import each
from utopic_cli.benchmark.speed_clock import Peak, Stopwatch, available_memory
from utopic_cli.benchmark.speed_report import ALIGN, FORWARD, SCHEMA_VERSION, Measurement, SpeedReport
from utopic_cli.benchmark.versions import versions
from utopic_cli.bridge import load_network, predict, to_cloud_input
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError
from utopic_cli.estimation.correspondences import linear_assignment
from utopic_cli.model.cloud_input import stack_clouds
from utopic_cli.pipeline import FEWEST_NODES, register
from utopic_cli.preprocess import prepare
from utopic_cli.synthesis.pairs import evaluation_pair
from utopic_cli.synthesis.scan_pair import ScanPair
from utopic_cli.synthesis.shapes import ShapeLibrary

POINTS = (512, 717, 1024, 2048, 5000)
BATCHES = (1, 4)
Progress = Callable[[int, int, str], None]


def run(
    shapes: ShapeLibrary,
    data: str,
    pairs: int = 3,
    seed: int = 0,
    weights: str = AlignOptions().weights,
    points: Sequence[int] = POINTS,
    batches: Sequence[int] = BATCHES,
    baselines: Sequence[str] = (),
    device: str = "auto",
    progress: Progress | None = None,
) -> SpeedReport:
    """Measure one network, and baselines beside it.

    Args:
        shapes: a library; only its shapes held out from training are used.
        data: what to call them.
        pairs: how many pairs each case is measured on.
        seed: of the pairs and of all draws.
        weights: bundled name or path.
        points: most sampled points per cloud, one case each.
        batches: pairs in one forward, one case each.
        baselines: names from ``baselines.BASELINES``.
        device: cpu, cuda or mps; auto: the CPU and, where there is one, CUDA.
        progress: called with (cases done, cases in all, what comes next).

    Raises:
        InputError: no held-out shapes, no pair can be made of them, or weights or device can't be used.
        UsageError: a number makes no sense, or an unknown or unusable baseline.
    """
    if pairs < 1 or seed < 0 or not points or min(points) < FEWEST_NODES:
        raise UsageError(
            "pairs must be at least 1, the seed not negative, and every number of points at least "
            f"{FEWEST_NODES}"
        )
    if not batches or min(batches) < 1:
        raise UsageError("every batch must hold at least 1 pair")
    methods = find_baselines(baselines)
    devices = _devices(device)
    model, card = load_network(weights, devices[0])
    test, split = held_out(shapes)
    with made_of(data):
        made = [evaluation_pair(test, seed, number, (BAND,), CLEAN) for number in range(pairs)]
    settings = {
        "schema_version": SCHEMA_VERSION,
        "protocol": {
            "name": "speed",
            "points_per_scan": SCAN_POINTS,
            "overlap": list(BAND),
            "threads": 1,
            "unmeasured_runs": 1,
        },
        "data": data,
        "split": split,
        "shapes": len(test),
        "pairs": pairs,
        "seed": seed,
        "points": list(points),
        "batches": list(batches),
        "devices": devices,
        "weights": card["name"],
        "weights_sha256": card["sha256"],
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "methods": {method.name: method.settings() for method in methods},
        "versions": versions(),
    }
    sizes = sorted(dict.fromkeys(points))
    cases: list[tuple[str, int | None, int, str]] = []
    for one in devices:
        cases += [(FORWARD, size, batch, one) for batch in dict.fromkeys(batches) for size in sizes]
        cases += [(ALIGN, size, 1, one) for size in sizes]
    cases += [(method.name, None, 1, "cpu") for method in methods]
    found: list[Measurement] = []
    for done, (what, size, batch, where) in enumerate(cases):
        if progress is not None:
            words = what if size is None else f"{what}, {size} points, batch {batch}, {where}"
            progress(done, len(cases), words)
        found.append(_measured(made, weights, seed, what, size, batch, where, found))
    return SpeedReport(settings, tuple(found))


def _devices(device: str) -> list[str]:
    if device != "auto":
        return [device]
    import torch

    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def _measured(
    pairs: list[ScanPair],
    weights: str,
    seed: int,
    what: str,
    points: int | None,
    batch: int,
    device: str,
    before: Sequence[Measurement],
) -> Measurement:
    """Measure a case in a process of its own, unless it would need more memory than there is."""
    blank = Measurement(what, points, batch, device)
    free = available_memory() if device == "cpu" else None
    wanted = _memory_wanted(blank, before)
    if free is not None and wanted is not None and wanted > free:
        return Measurement(
            what, points, batch, device, message=f"left out: needs about {wanted / 1e9:.1f} GB of memory"
        )
    try:
        return each(partial(_case, pairs, weights, seed, blank), 1, 1)[0]
    except (RuntimeError, MemoryError) as error:  # out of memory, most often; the other cases go on
        return Measurement(what, points, batch, device, message=f"{type(error).__name__}: {error}")


def _memory_wanted(case: Measurement, before: Sequence[Measurement]) -> float | None:
    """Foresee a forward's peak from the largest one so far: it grows with the square of the points."""
    like = [
        one
        for one in before
        if (one.what, one.device) == (FORWARD, case.device)
        and one.peak_bytes is not None
        and one.idle_bytes is not None
    ]
    if case.what != FORWARD or case.points is None or not like:
        return None
    last = max(like, key=lambda one: (one.points or 0) ** 2 * one.batch)
    growth = case.points**2 * case.batch / ((last.points or 1) ** 2 * last.batch)
    peak, idle = last.peak_bytes or 0, last.idle_bytes or 0
    return idle + (peak - idle) * growth


def _case(pairs: list[ScanPair], weights: str, seed: int, case: Measurement) -> Callable[[int], Measurement]:
    return partial(_run_case, pairs, weights, seed, case)


def _run_case(pairs: list[ScanPair], weights: str, seed: int, case: Measurement, number: int) -> Measurement:
    """Measure one case in this process; ``number`` is 0, a process serves one case."""
    if case.what == FORWARD:
        return _forward(pairs, weights, seed, case)
    if case.what == ALIGN:
        return _align(pairs, weights, seed, case)
    return _baseline(pairs, seed, case)


def _forward(pairs: list[ScanPair], weights: str, seed: int, case: Measurement) -> Measurement:
    import torch

    model, _ = load_network(weights, case.device)
    device = next(model.parameters()).device
    inputs = []
    for pair in pairs:
        prepared = prepare(pair.source, pair.target, case.points or 0, clean=True)
        clouds = [
            to_cloud_input(cloud, prepared.spacing, model.config.neighbours)
            for cloud in (prepared.source, prepared.target)
        ]
        inputs.append([stack_clouds([cloud] * case.batch).to(device) for cloud in clouds])
    nodes = float(np.mean([cloud.points.shape[1] for clouds in inputs for cloud in clouds]))
    watch, peak = Stopwatch(device), Peak(device)
    with torch.inference_mode():
        for source, target in [inputs[0], *inputs]:
            with watch.lap():
                model(source, target, generator=torch.Generator().manual_seed(seed))
    return case.measured(watch, peak, nodes=nodes)


def _align(pairs: list[ScanPair], weights: str, seed: int, case: Measurement) -> Measurement:
    options = AlignOptions(weights=weights, points=case.points or 0, device=case.device, threads=1, seed=seed)
    model, _ = load_network(weights, case.device)
    device = next(model.parameters()).device
    watch, assignment, peak = Stopwatch(device), Stopwatch(device), Peak(device)
    results = []
    for pair in [pairs[0], *pairs]:
        with watch.lap():
            results.append(register(pair.source, pair.target, options))
    measured = case.measured(watch, peak)  # before the assignment is timed, which takes memory of its own
    nodes = []
    for pair in [pairs[0], *pairs]:
        prepared = prepare(pair.source, pair.target, options.points, clean=True)
        nodes += [len(prepared.source.points), len(prepared.target.points)]
        scores = predict(model, prepared, seed).matching_scores
        with assignment.lap():
            linear_assignment(scores)
    steps = {
        step: float(np.median([result.timings_s[step] for result in results[1:] if step in result.timings_s]))
        for step in dict.fromkeys(step for result in results[1:] for step in result.timings_s)
    }
    right = _right(pairs, [result.T_target_source for result in results[1:]])
    return measured.with_answers(float(np.mean(nodes[2:])), right, assignment.wall_seconds, steps)


def _baseline(pairs: list[ScanPair], seed: int, case: Measurement) -> Measurement:
    (method,) = find_baselines([case.what])
    watch, peak = Stopwatch(), Peak()
    answers: list[np.ndarray | None] = []
    for pair in [pairs[0], *pairs]:
        trial = Trial(pair.source, pair.target, pair_extent(pair.source, pair.target), seed)
        answer = None
        with watch.lap(), suppress(Exception):  # who raises has failed on this pair, and its time counts
            answer = refined(trial, checked(method.estimate(trial)))
        answers.append(answer)
    return case.measured(watch, peak).with_answers(None, _right(pairs, answers[1:]), None, {})


def _right(pairs: list[ScanPair], answers: Sequence[np.ndarray | None]) -> int:
    """Count answers under 5 degrees and under 5 % of the extent from the known one."""
    right = 0
    for pair, answer in zip(pairs, answers):
        if answer is not None:
            centroid, extent = pair.source.points.mean(axis=0), pair_extent(pair.source, pair.target)
            right += pose_error(answer, pair.gt_T_target_source, centroid, extent).success
    return right
