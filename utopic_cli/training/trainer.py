"""The training loop: two stages, read top to bottom."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from utopic_cli.errors import InputError, UtopicError
from utopic_cli.io.output import write_together
from utopic_cli.model.utopic import Utopic
from utopic_cli.model.weights import pack_weights
from utopic_cli.synthesis.pairs import random_pair
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training.batched import BatchedPairs, batches_on_device
from utopic_cli.training.checkpoint import describe_difference, read_checkpoint, write_checkpoint
from utopic_cli.training.config import Schedule, TrainingConfig, training_config_from
from utopic_cli.training.data import BatchOrder, SynthesisedPairs, batch_loader, sample_pair, to_training_pair
from utopic_cli.training.journal import Journal
from utopic_cli.training.network import TrainingNetwork, TrainingPair, total_loss
from utopic_cli.training.optimisation import RunningAverage, learning_rate, make_optimiser, step
from utopic_cli.training.processes import Processes, joined_processes
from utopic_cli.training.validation import validate

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]
VALIDATION_SEED = 900_001
VALIDATION_POINTS = 768
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
        progress: called with every record of the journal.

    Returns:
        Path of the exported weights.

    Raises:
        InputError: nothing to resume, other settings than the checkpoint's, or a batch that
            can't be shared among the processes.
        DivergedError: the loss became NaN or infinite.
        OutputError: the folder can't be written.
    """
    device = device or torch.device("cpu")
    with joined_processes(device) as processes, _signals() as received:
        if config.schedule.batch % processes.count:
            raise InputError(
                f"batch {config.schedule.batch} can't be shared by {processes.count} processes; "
                "choose a multiple in the configuration"
            )
        out.mkdir(parents=True, exist_ok=True)
        run = _start(config, device, out, resume, start_from)
        limits = _Limits(minutes, lambda: bool(received))
        on_device = synthesis == "device" or (synthesis == "auto" and device.type == "cuda")
        batches = _batches(run, training_shapes, processes, None if on_device else workers)
        measured = _loop(run, batches, validation_shapes, processes, limits, progress)
        path = out / "utopic.safetensors"
        if processes.leads:
            card = {
                "pairs_seen": run.done,
                "wall_clock_s": round(run.elapsed, 1),
                "training": config.as_dict(),
                "data": {
                    "shapes": len(training_shapes),
                    "sets": sorted(set(training_shapes.sets.tolist())),
                },
                "validation": measured,
            }
            export(run.average.network(run.network.inference), card, out)
        if signal.SIGINT in received:
            raise KeyboardInterrupt  # saved, but not what was asked for in the first place
        return path


@dataclass
class _Run:
    """The state of a run: what a checkpoint holds."""

    config: TrainingConfig
    device: torch.device
    out: Path
    network: TrainingNetwork
    optimiser: torch.optim.Optimizer
    average: RunningAverage
    done: int = 0
    elapsed: float = 0.0

    @property
    def checkpoint(self) -> Path:
        return self.out / "checkpoint.pt"

    def save(self) -> None:
        write_checkpoint(
            self.checkpoint,
            {
                "config": self.config.as_dict(),
                "model": self.network.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "average": self.average.weights,
                "pairs": self.done,
                "elapsed_s": self.elapsed,
            },
        )


@dataclass(frozen=True)
class _Limits:
    """When to stop before the schedule ends."""

    minutes: float | None
    asked: Callable[[], bool]
    started: float = field(default_factory=time.monotonic)

    def seconds_left(self) -> float:
        """Seconds until time is up; infinite without a limit."""
        if self.minutes is None:
            return math.inf
        return 60.0 * self.minutes - (time.monotonic() - self.started)


def _start(
    config: TrainingConfig,
    device: torch.device,
    out: Path,
    resume: bool,
    start_from: dict[str, torch.Tensor] | None,
) -> _Run:
    """Build everything a run consists of, new or as a checkpoint left it."""
    schedule = config.schedule
    torch.manual_seed(schedule.seed)  # initial weights only; every later draw has its own generator
    network = TrainingNetwork(
        config.model, config.loss.correspondence_radius, config.loss.completion_points
    ).to(device)
    if start_from is not None:
        changed = describe_difference(start_from, network.inference.state_dict())
        if changed:
            raise InputError(f"the weights to start from have another architecture: {changed}")
        network.inference.load_state_dict(start_from)
    run = _Run(
        config,
        device,
        out,
        network,
        make_optimiser(network, schedule),
        RunningAverage(network.inference, schedule.average),
    )
    if resume:
        state = read_checkpoint(run.checkpoint)
        other = training_config_from(state["config"], str(run.checkpoint))
        if other != config:
            changed = describe_difference(other.as_dict(), config.as_dict())
            raise InputError(
                f"{run.checkpoint}: made with other settings ({changed}); use the same --config to resume"
            )
        changed = describe_difference(state["model"], network.state_dict())
        if changed:
            raise InputError(f"{run.checkpoint}: holds another architecture: {changed}")
        network.load_state_dict(state["model"])
        run.optimiser.load_state_dict(state["optimiser"])
        run.average.restore(state["average"])
        run.done, run.elapsed = state["pairs"], state["elapsed_s"]
    return run


def _batches(
    run: _Run, shapes: ShapeLibrary, processes: Processes, workers: int | None
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
    run: _Run,
    batches: Iterable[TrainingPair],
    validation_shapes: ShapeLibrary,
    processes: Processes,
    limits: _Limits,
    progress: Progress | None,
) -> dict[str, float]:
    """Go through the batches; returns the last validation."""
    schedule, network, device = run.config.schedule, run.network, run.device
    weights = run.config.loss.weights()
    # On CPUs without matrix units bfloat16 costs half as much again, so only GPUs get it.
    reduced = schedule.bfloat16 and device.type == "cuda"
    held_out = _validation_pairs(validation_shapes, run.config) if processes.leads else []
    measured: dict[str, float] = {}
    meter = _Meter()
    begun, elapsed_before = time.monotonic(), run.elapsed
    last_saved = -math.inf  # the first checkpoint comes with the first record
    validation = _Validation(held_out, schedule, limits)
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
            meter = _Meter()
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
                meter = _Meter()
            if last:
                break
            asked = time.monotonic()
    return measured


class _Validation:
    """Validates now and then, and never for more than a tenth of the time."""

    def __init__(self, pairs: list[TrainingPair], schedule: Schedule, limits: _Limits) -> None:
        self.pairs, self.seed = pairs, schedule.seed
        self.seconds = 0.0  # how long the last one took
        self.patience = min(schedule.validation_seconds, limits.seconds_left() / 8)
        self.last = time.monotonic()

    def due(self) -> bool:
        """Whether it is time again."""
        return time.monotonic() - self.last > max(self.patience, 9.0 * self.seconds)

    def __call__(self, run: _Run, joint: bool) -> dict[str, float]:
        """Measure the averaged weights; before the joint stage only what is being trained."""
        begun = time.monotonic()
        model = run.average.network(run.network.inference)
        measured = validate(model, self.pairs, self.seed, descriptors_only=not joint)
        self.last = time.monotonic()
        self.seconds = self.last - begun
        return {name: round(value, 4) for name, value in measured.items()}


class _Meter:
    """Sums since the last record; read as floats only then, so that a GPU is never waited for."""

    def __init__(self) -> None:
        self.begun = time.monotonic()
        self.waited = 0.0
        self.pairs = self.batches = 0
        self.sums: dict[str, torch.Tensor] = {}

    def add(self, terms: dict[str, torch.Tensor], pairs: int) -> None:
        """Count one batch."""
        for name, term in terms.items():
            self.sums[name] = self.sums.get(name, torch.zeros_like(term.detach())) + term.detach()
        self.pairs, self.batches = self.pairs + pairs, self.batches + 1

    def seconds(self) -> float:
        """Seconds since the last record."""
        return time.monotonic() - self.begun

    def rate(self) -> float:
        """Pairs a second."""
        return self.pairs / max(self.seconds(), 1e-9)

    def read(self) -> dict[str, float]:
        """Return speed, share of the time spent waiting for pairs, and mean loss terms."""
        means = {name: round(float(value) / self.batches, 4) for name, value in self.sums.items()}
        waiting = self.waited / max(self.seconds(), 1e-9)
        return {"pairs_per_s": round(self.rate(), 2), "waiting": round(waiting, 3), **means}


def export(model: Utopic, card: dict[str, Any], out: Path) -> Path:
    """Write weights and card to a folder, both or neither."""
    blob, text = pack_weights(model, card)
    path = out / "utopic.safetensors"
    write_together({path.with_suffix(".json"): text, path: blob}, overwrite=True)
    return path


def total_pairs(schedule: Schedule) -> int:
    """Return how many pairs a run sees."""
    return schedule.descriptor_pairs + schedule.joint_pairs


def _seconds_left(run: _Run, rate: float, limits: _Limits) -> float:
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


def _validation_pairs(shapes: ShapeLibrary, config: TrainingConfig) -> list[TrainingPair]:
    made = []
    for number in range(config.schedule.validation_pairs):
        rng = np.random.default_rng([VALIDATION_SEED, number])
        pair = random_pair(shapes, rng, config.pairs)
        made.append(to_training_pair(sample_pair(pair, VALIDATION_POINTS, rng), config.model.neighbours))
    return made


def _to(pair: TrainingPair, device: torch.device) -> TrainingPair:
    source, target, *answers = pair
    return TrainingPair(source.to(device), target.to(device), *(answer.to(device) for answer in answers))


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect SIGTERM and the first Ctrl-C, so that the step in hand is finished and saved."""
    received: list[int] = []

    def note(number: int, _: object) -> None:
        if number in received:
            raise KeyboardInterrupt
        received.append(number)

    previous = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
