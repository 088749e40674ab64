"""The training loop: two stages, read top to bottom."""

from __future__ import annotations

import json
import logging
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from utopic_cli.errors import InputError, UtopicError
from utopic_cli.io.output import write_together
from utopic_cli.model.utopic import Utopic
from utopic_cli.model.weights import pack_weights
from utopic_cli.synthesis.pairs import PairSettings, random_pair
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training.checkpoint import read_checkpoint, write_checkpoint
from utopic_cli.training.config import Schedule, TrainingConfig, training_config_from
from utopic_cli.training.data import PairKeys, SynthesisedPairs, pair_loader, sample_pair, to_training_pair
from utopic_cli.training.network import TrainingNetwork, TrainingPair, total_loss
from utopic_cli.training.validation import validate

log = logging.getLogger(__name__)

Progress = Callable[[dict[str, Any]], None]
VALIDATION_SEED = 900_001
FAST = (
    "matching.gain",
    "matching.bias",
    "matching.skip_gain",
    "quantification.evidence.weight",
    "overlap_head.mass_gain",
    "overlap_head.mean_gain",
)
"""Parameters whose rate is multiplied by the schedule's ``matching_rate``."""


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
    start_from: dict[str, torch.Tensor] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Train, checkpoint, and export the averaged weights.

    Args:
        config: settings of the run; when resuming, they must equal the checkpoint's.
        training_shapes: shapes to make pairs of.
        validation_shapes: held-out shapes.
        out: folder of the run: ``checkpoint.pt``, ``log.jsonl``, ``utopic.safetensors`` + card.
        resume: go on from ``out/checkpoint.pt``.
        minutes: stop, with a checkpoint and an export, after this long.
        device: where to train; the CPU if None.
        workers: processes that make pairs.
        start_from: weights of the inference network to start from.
        progress: called with every log record.

    Returns:
        Path of the exported weights.

    Raises:
        InputError: nothing to resume, or other settings than the checkpoint's.
        DivergedError: the loss became NaN or infinite.
    """
    device = device or torch.device("cpu")
    schedule = config.schedule
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(schedule.seed)  # initial weights only; every later draw has its own generator
    network = TrainingNetwork(
        config.model, config.loss.correspondence_radius, config.loss.completion_points
    ).to(device)
    if start_from is not None:
        try:
            network.inference.load_state_dict(start_from)
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"the weights to start from have another architecture: {reason}") from error
    optimiser = _optimiser(network, schedule)
    average = {name: value.detach().clone() for name, value in network.inference.state_dict().items()}
    done, elapsed = 0, 0.0
    checkpoint = out / "checkpoint.pt"
    if resume:
        state = read_checkpoint(checkpoint)
        if training_config_from(state["config"], str(checkpoint)) != config:
            raise InputError(f"{checkpoint}: made with other settings; use the same --config to resume")
        network.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        average = {name: value.to(device) for name, value in state["average"].items()}
        done, elapsed = state["pairs"], state["elapsed_s"]

    def save() -> None:
        write_checkpoint(
            checkpoint,
            {
                "config": config.as_dict(),
                "model": network.state_dict(),
                "optimiser": optimiser.state_dict(),
                "average": average,
                "pairs": done,
                "elapsed_s": elapsed + time.monotonic() - started,
            },
        )

    settings = PairSettings()
    held_out = _validation_pairs(validation_shapes, settings, config)
    pairs = SynthesisedPairs(training_shapes, settings, schedule.seed, config.model.neighbours)
    keys = PairKeys(
        done, total_pairs(schedule), schedule.repeats, lambda sample: _points_of(sample, schedule)
    )
    weights = config.loss.weights()
    # On CPUs without matrix units bfloat16 costs half as much again, so only GPUs get it.
    reduced = schedule.bfloat16 and device.type == "cuda"
    started = last_validated = last_logged = time.monotonic()
    last_saved = -math.inf  # the first checkpoint comes with the first record
    sums: dict[str, float] = {}
    since_log = 0
    measured: dict[str, float] = {}
    with _terminated() as stop, open(out / "log.jsonl", "a", encoding="utf-8") as journal:
        for pair in pair_loader(pairs, keys, workers):
            network.train()
            joint = done >= schedule.descriptor_pairs
            with torch.autocast(device.type, torch.bfloat16, enabled=reduced):
                terms = _losses(network, _to(pair, device), done, joint, config)
                loss = total_loss(terms, weights) if joint else terms["descriptor"]
            if not bool(torch.isfinite(loss)):
                raise DivergedError(
                    f"{out}: the loss is {loss.item()} at pair {done}; the last good checkpoint is "
                    f"{checkpoint}. Lower the learning rate in the configuration"
                )
            (loss / schedule.batch).backward()
            done, since_log = done + 1, since_log + 1
            for name, term in terms.items():
                sums[name] = sums.get(name, 0.0) + float(term.detach())
            if done % schedule.batch:
                continue  # stop, save and report between steps only: no gradient is ever lost
            _step(network, optimiser, schedule, done)
            _update_average(average, network.inference, schedule.average, done // schedule.batch)
            now = time.monotonic()
            out_of_time = minutes is not None and now - started > 60 * minutes
            last = out_of_time or stop() or done == total_pairs(schedule)
            if last or now - last_logged > 20.0:
                record: dict[str, Any] = {
                    "pairs": done,
                    "of": total_pairs(schedule),
                    "stage": "joint" if joint else "descriptor",
                    "elapsed_s": round(elapsed + now - started, 1),
                    "pairs_per_s": round(since_log / max(now - last_logged, 1e-9), 2),
                    **{name: round(value / since_log, 4) for name, value in sums.items()},
                }
                if last or now - last_saved > schedule.checkpoint_seconds:
                    save()
                    last_saved = time.monotonic()
                if last or now - last_validated > schedule.validation_seconds:
                    measured = validate(_averaged(config, average), held_out, schedule.seed)
                    record.update({name: round(value, 4) for name, value in measured.items()})
                    last_validated = time.monotonic()
                journal.write(json.dumps(record) + "\n")
                journal.flush()
                if progress is not None:
                    progress(record)
                sums, since_log, last_logged = {}, 0, time.monotonic()
            if last:
                break
    card = {
        "pairs_seen": done,
        "wall_clock_s": round(elapsed + time.monotonic() - started, 1),
        "training": config.as_dict(),
        "data": {"shapes": len(training_shapes), "sets": sorted(set(training_shapes.sets.tolist()))},
        "validation": measured or validate(_averaged(config, average), held_out, schedule.seed),
    }
    return export(_averaged(config, average), card, out)


def export(model: Utopic, card: dict[str, Any], out: Path) -> Path:
    """Write weights and card to a folder, both or neither."""
    blob, text = pack_weights(model, card)
    path = out / "utopic.safetensors"
    write_together({path.with_suffix(".json"): text, path: blob}, overwrite=True)
    return path


def total_pairs(schedule: Schedule) -> int:
    """Return how many pairs a run sees."""
    return schedule.descriptor_pairs + schedule.joint_pairs


def learning_rate(schedule: Schedule, pairs: int) -> float:
    """Cosine from the stage's highest rate to a twentieth of it, after a short warm-up."""
    joint = pairs >= schedule.descriptor_pairs
    start = schedule.descriptor_pairs if joint else 0
    length = schedule.joint_pairs if joint else schedule.descriptor_pairs
    highest = schedule.joint_rate if joint else schedule.descriptor_rate
    share = min((pairs - start) / max(length, 1), 1.0)
    warm = min((pairs - start + 1) / min(200, max(length, 1)), 1.0)
    return highest * warm * (0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * share)))


def _losses(
    network: TrainingNetwork, pair: TrainingPair, done: int, joint: bool, config: TrainingConfig
) -> dict[str, torch.Tensor]:
    if not joint:
        return network.descriptor_stage(pair)
    schedule = config.schedule
    generator = torch.Generator().manual_seed(schedule.seed * 1_000_003 + done)
    share = (done - schedule.descriptor_pairs) / max(schedule.joint_pairs, 1)
    return network.joint_stage(
        pair, generator, masking=share >= schedule.masking_from, completion=config.loss.completion > 0
    )


def _points_of(sample: int, schedule: Schedule) -> tuple[int, int]:
    late = sample >= schedule.descriptor_pairs + 0.8 * schedule.joint_pairs
    fewest, most = schedule.last_points if late else schedule.points
    return fewest, most


def _optimiser(network: TrainingNetwork, schedule: Schedule) -> torch.optim.Optimizer:
    """Build the optimiser; the few numbers that weigh whole kinds of evidence learn faster than the rest."""
    fast: list[torch.nn.Parameter] = []
    normal: list[torch.nn.Parameter] = []
    for name, parameter in network.named_parameters():
        is_fast = name.endswith(FAST)
        (fast if is_fast else normal).append(parameter)
    groups = [
        {"params": normal, "factor": 1.0, "weight_decay": schedule.weight_decay},
        {"params": fast, "factor": schedule.matching_rate, "weight_decay": 0.0},
    ]
    if schedule.optimiser == "sgd":
        return torch.optim.SGD(groups, lr=schedule.joint_rate, momentum=0.9, nesterov=True)
    return torch.optim.AdamW(groups, lr=schedule.joint_rate, betas=(0.9, 0.98))


def _step(network: TrainingNetwork, optimiser: torch.optim.Optimizer, schedule: Schedule, done: int) -> None:
    rate = learning_rate(schedule, done)
    for group in optimiser.param_groups:
        group["lr"] = rate * group["factor"]
    torch.nn.utils.clip_grad_norm_(network.parameters(), schedule.clip)
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)


@torch.no_grad()
def _update_average(average: dict[str, torch.Tensor], model: Utopic, decay: float, step: int) -> None:
    """Move the running average of the weights; early steps count more, so it is never stale."""
    decay = min(decay, step / (step + 10.0))
    for name, value in model.state_dict().items():
        if value.is_floating_point():
            average[name].lerp_(value, 1.0 - decay)
        else:
            average[name].copy_(value)


def _averaged(config: TrainingConfig, average: dict[str, torch.Tensor]) -> Utopic:
    model = Utopic(config.model)
    model.load_state_dict(average)
    return model.eval()


def _validation_pairs(
    shapes: ShapeLibrary, settings: PairSettings, config: TrainingConfig
) -> list[TrainingPair]:
    made = []
    for number in range(config.schedule.validation_pairs):
        rng = np.random.default_rng([VALIDATION_SEED, number])
        pair = random_pair(shapes, rng, settings)
        made.append(to_training_pair(sample_pair(pair, 768, rng), config.model.neighbours))
    return made


def _to(pair: TrainingPair, device: torch.device) -> TrainingPair:
    source, target, *answers = pair
    return TrainingPair(source.to(device), target.to(device), *(answer.to(device) for answer in answers))


@contextmanager
def _terminated() -> Iterator[Callable[[], bool]]:
    """Turn SIGTERM into a question the loop asks, so that the step in hand is finished and saved."""
    asked = []
    previous = signal.signal(signal.SIGTERM, lambda *_: asked.append(True))
    try:
        yield lambda: bool(asked)
    finally:
        signal.signal(signal.SIGTERM, previous)
