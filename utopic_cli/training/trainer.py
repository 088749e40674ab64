"""The training loop: two stages, read top to bottom."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from utopic_cli.errors import InputError, UtopicError
from utopic_cli.model.utopic import Utopic
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training.batched import BatchedPairs, batches_on_device
from utopic_cli.training.config import Schedule, TrainingConfig
from utopic_cli.training.data import BatchOrder, SynthesisedPairs, batch_loader
from utopic_cli.training.journal import Journal
from utopic_cli.training.network import TrainingNetwork, TrainingPair, total_loss
from utopic_cli.training.optimisation import learning_rate, step
from utopic_cli.training.pace import InterruptedRun, Limits, Meter, caught_signals
from utopic_cli.training.processes import Processes, joined_processes
from utopic_cli.training.run import Run, export, start_run, total_pairs
from utopic_cli.training.validation import PeriodicValidation, fixed_pairs, validation_pairs
from utopic_cli.training.variance import fit_variance

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]
RECORD_SECONDS = 20.0


class DivergedError(UtopicError):
    """The loss is no number any more; the last good checkpoint is kept."""


def train(
    config: TrainingConfig,
    training_shapes: ShapeLibrary,
    validation_shapes: ShapeLibrary,
    out: Path,
    *,
    resume: bool = False,
    minutes: float | None = None,
    device: torch.device | None = None,
    workers: int = 1,
    synthesis: str = "auto",
    start_from: dict[str, torch.Tensor] | None = None,
    before: Sequence[dict[str, Any]] = (),
    progress: Progress | None = None,
) -> Path:
    """Train, checkpoint, and export the averaged weights.

    Under ``torchrun`` each process takes its share of every batch, and the first one writes.

    Args:
        config: settings of the run; when resuming, they must equal the checkpoint's.
        training_shapes: shapes to make pairs of.
        validation_shapes: held-out shapes.
        out: folder of the run: ``checkpoint.pt``, what ``Journal`` writes,
            ``utopic.safetensors`` + card.
        resume: go on from ``out/checkpoint.pt``.
        minutes: stop, with a checkpoint and an export, after this long.
        device: where to train; the CPU if None.
        workers: processes that make pairs, for each process that trains.
        synthesis: where pairs are made: by the ``workers``, each shown ``repeats`` times; in batches on
            the training ``device``, all new; ``auto``: on a GPU if that is what trains.
        start_from: weights of the inference network to start from.
        before: the runs that these come from, as their card has them.
        progress: called with every record of the journal.

    Returns:
        Path of the exported weights.

    Raises:
        InputError: nothing to resume, other settings than the checkpoint's, or a batch that
            can't be shared among the processes.
        DivergedError: the loss became NaN or infinite.
        InterruptedRun: Ctrl-C; saved and exported all the same.
        OutputError: the folder can't be written.
    """
    device = device or torch.device("cpu")
    with joined_processes(device) as processes, caught_signals() as received:
        if config.schedule.batch % processes.count:
            raise InputError(
                f"batch {config.schedule.batch} can't be shared by {processes.count} processes; "
                "choose a multiple in the configuration"
            )
        out.mkdir(parents=True, exist_ok=True)
        run = start_run(config, device, out, resume, start_from, before)
        limits = Limits(minutes, lambda: bool(received))
        on_device = synthesis == "device" or (synthesis == "auto" and device.type == "cuda")
        batches = _batches(run, training_shapes, processes, None if on_device else workers)
        measured = _loop(run, batches, validation_shapes, processes, limits, progress)
        path = out / "utopic.safetensors"
        if processes.leads:
            card = {
                **run.record(),
                "data": {
                    "shapes": len(training_shapes),
                    "sets": sorted(set(training_shapes.sets.tolist())),
                },
                "validation": measured,
            }
            model = run.average.network(run.network.inference)
            if config.schedule.variance_pairs and run.done >= total_pairs(config.schedule):
                card["uncertainty"] = _fit_variance(model, config, training_shapes)
            export(model, card, out)
        if signal.SIGINT in received:
            raise InterruptedRun(path)  # saved, but not what was asked for in the first place
        return path


def _fit_variance(model: Utopic, config: TrainingConfig, shapes: ShapeLibrary) -> dict[str, Any]:
    """Fit the head of the variance by itself, and say so for the card."""
    count = config.schedule.variance_pairs
    pairs = fixed_pairs(shapes, config, config.schedule.seed, count)
    before, after = fit_variance(model, (_to(pair, next(model.parameters()).device) for pair in pairs))
    return {
        "what": "the head of the variance, fitted by itself after the last run",
        "pairs": count,
        "seed": config.schedule.seed,
        "shown": "the right transformation, and none",
        "loss": [round(before, 4), round(after, 4)],
    }


def _batches(
    run: Run, shapes: ShapeLibrary, processes: Processes, workers: int | None
) -> Iterable[TrainingPair]:
    """What is left of the run, as this process' share of each batch.

    Args:
        run: how far it is.
        shapes: to make pairs of.
        processes: among which batches are shared.
        workers: processes that make pairs; None makes them on the training device.
    """
    schedule, k = run.config.schedule, run.config.model.neighbours
    order = BatchOrder(
        run.done // schedule.batch,
        total_pairs(schedule) // schedule.batch,
        schedule.batch,
        1 if workers is None else schedule.repeats,
        lambda pairs: _limits_of(pairs, schedule),
        (processes.rank, processes.count),
    )
    if workers is None:
        pairs = BatchedPairs(shapes, run.config.pairs, device=run.device, neighbours=k)
        return batches_on_device(pairs, order, schedule.seed)
    made = SynthesisedPairs(shapes, run.config.pairs, schedule.seed, k)
    return batch_loader(made, order, workers, pinned=run.device.type == "cuda")


def _loop(
    run: Run,
    batches: Iterable[TrainingPair],
    validation_shapes: ShapeLibrary,
    processes: Processes,
    limits: Limits,
    progress: Progress | None,
) -> dict[str, float]:
    """Go through the batches; returns the last validation."""
    schedule, network, device = run.config.schedule, run.network, run.device
    weights = run.config.loss.weights()
    # On CPUs without matrix units bfloat16 costs half as much again, so only GPUs get it.
    reduced = schedule.bfloat16 and device.type == "cuda"
    held_out = validation_pairs(validation_shapes, run.config, limits.minutes) if processes.leads else []
    measured: dict[str, float] = {}
    meter = Meter()
    begun, elapsed_before = time.monotonic(), run.elapsed
    last_saved = -math.inf  # the first checkpoint comes with the first record
    validation = PeriodicValidation(held_out, schedule, limits)
    settings = run.config.as_dict()
    with Journal(run.out, run.done, settings=settings) if processes.leads else nullcontext() as journal:
        if journal is not None and not run.done:  # what the untrained network makes of them
            measured = validation(run, joint=not schedule.descriptor_pairs)
            stage = "descriptor" if schedule.descriptor_pairs else "joint"
            first = {"pairs": 0, "of": total_pairs(schedule), "stage": stage, "elapsed_s": 0.0, **measured}
            journal.write(first)
            if progress is not None:
                progress(first)
            begun = time.monotonic()
            meter = Meter()
        asked = time.monotonic()
        for batch in batches:
            meter.waited += time.monotonic() - asked
            network.train()
            joint = run.done >= schedule.descriptor_pairs
            with torch.autocast(device.type, torch.bfloat16, enabled=reduced):
                terms = _losses(network, _to(batch, device), run.done + processes.rank, joint, run.config)
                loss = total_loss(terms, weights) if joint else terms["descriptor"]
            if processes.any_of(not bool(torch.isfinite(loss)), device):
                raise DivergedError(
                    f"{run.out}: the loss is {loss.item()} at step {run.done // schedule.batch}, pairs "
                    f"{run.done} to {run.done + schedule.batch - 1}; the last good checkpoint is "
                    f"{run.checkpoint}. Lower the learning rate in the configuration"
                )
            loss.backward()
            processes.average_gradients(network.parameters())
            rate = learning_rate(schedule, run.done)
            norm = step(network, run.optimiser, rate, schedule.clip)
            run.done += schedule.batch
            run.average.update(network.inference, run.done // schedule.batch)
            run.elapsed = elapsed_before + time.monotonic() - begun
            meter.add(terms, schedule.batch)
            finished = run.done >= total_pairs(schedule)
            stop = processes.any_of(limits.seconds_left() < validation.seconds or limits.asked(), device)
            last = finished or stop
            if journal is not None and (last or meter.seconds() > RECORD_SECONDS):
                now = time.monotonic()
                if last or now - last_saved > schedule.checkpoint_seconds:
                    run.save()
                    last_saved = now
                record: dict[str, Any] = {
                    "pairs": run.done,
                    "of": total_pairs(schedule),
                    "stage": "joint" if joint else "descriptor",
                    "elapsed_s": round(run.elapsed, 1),
                    "left_s": round(_seconds_left(run, meter.rate(), limits), 1),
                    "rate": float(f"{rate:.3g}"),
                    "gradient": round(float(norm), 3),
                    **meter.read(),
                }
                if last or validation.due():
                    measured = validation(run, joint)
                    record.update(measured)
                journal.write(record)
                if progress is not None:
                    progress(record)
                meter = Meter()
            if last:
                break
            asked = time.monotonic()
    return measured


def _seconds_left(run: Run, rate: float, limits: Limits) -> float:
    """Seconds to the end at the present pace, or to when time is up."""
    schedule = run.config.schedule
    return max(0.0, min((total_pairs(schedule) - run.done) / max(rate, 1e-9), limits.seconds_left()))


def _losses(
    network: TrainingNetwork, pair: TrainingPair, draw: int, joint: bool, config: TrainingConfig
) -> dict[str, torch.Tensor]:
    if not joint:
        return network.descriptor_stage(pair)
    schedule = config.schedule
    generator = torch.Generator().manual_seed(schedule.seed * 1_000_003 + draw)
    share = (draw - schedule.descriptor_pairs) / max(schedule.joint_pairs, 1)
    return network.joint_stage(
        pair, generator, masking=share >= schedule.masking_from, completion=config.loss.completion > 0
    )


def _limits_of(pairs: int, schedule: Schedule) -> tuple[int, int]:
    """Fewest and most points of a cloud after so many pairs: more in the last fifth of the joint stage."""
    late = pairs >= schedule.descriptor_pairs + 0.8 * schedule.joint_pairs
    fewest, most = schedule.last_points if late else schedule.points
    return fewest, most


def _to(pair: TrainingPair, device: torch.device) -> TrainingPair:
    source, target, *answers = pair
    return TrainingPair(source.to(device), target.to(device), *(answer.to(device) for answer in answers))
