"""A run of training: its state, as new or as a checkpoint left it, and what it leaves behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from utopic_cli.errors import InputError
from utopic_cli.io.output import write_together
from utopic_cli.model.utopic import Utopic
from utopic_cli.model.weights import pack_weights
from utopic_cli.training.checkpoint import describe_difference, read_checkpoint, write_checkpoint
from utopic_cli.training.config import Schedule, TrainingConfig, training_config_from
from utopic_cli.training.network import TrainingNetwork
from utopic_cli.training.optimisation import RunningAverage, make_optimiser

RANDOM, THE_RUN_BEFORE = "random weights", "the run before"


@dataclass
class Run:
    """The state of a run: what a checkpoint holds.

    Attributes:
        config: its settings.
        device: where it trains.
        out: its folder.
        network: being trained.
        optimiser: with its state.
        average: running average of the weights, which is what gets exported.
        done: pairs seen.
        elapsed: seconds trained, over all sessions.
        start: what it began with.
        before: the runs that the weights it began with come from, as of ``record``, oldest first.
    """

    config: TrainingConfig
    device: torch.device
    out: Path
    network: TrainingNetwork
    optimiser: torch.optim.Optimizer
    average: RunningAverage
    done: int = 0
    elapsed: float = 0.0
    start: str = RANDOM
    before: list[dict[str, Any]] = field(default_factory=list)

    @property
    def checkpoint(self) -> Path:
        """Where the checkpoint is kept."""
        return self.out / "checkpoint.pt"

    def save(self) -> None:
        """Write the checkpoint; the old one stands until the new one is whole."""
        write_checkpoint(
            self.checkpoint,
            {
                "config": self.config.as_dict(),
                "model": self.network.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "average": self.average.weights,
                "pairs": self.done,
                "elapsed_s": self.elapsed,
                "start": self.start,
                "before": self.before,
            },
        )

    def record(self) -> dict[str, Any]:
        """Return what a card says of the weights' way here: this run and those before it, and their sums."""
        own = {
            "pairs": self.done,
            "wall_clock_s": round(self.elapsed, 1),
            "start": self.start,
            "training": self.config.as_dict(),
        }
        runs = [*self.before, own]
        return {
            "pairs_seen": sum(each["pairs"] for each in runs),
            "wall_clock_s": round(sum(each["wall_clock_s"] for each in runs), 1),
            "runs": runs,
        }


def start_run(
    config: TrainingConfig,
    device: torch.device,
    out: Path,
    resume: bool,
    start_from: dict[str, torch.Tensor] | None,
    before: Sequence[dict[str, Any]] = (),
) -> Run:
    """Build everything a run consists of, new or as a checkpoint left it.

    Args:
        config: its settings.
        device: where to train.
        out: its folder.
        resume: take up the checkpoint in it.
        start_from: weights of the inference network to start from.
        before: the runs that these come from, as of ``Run.record``.

    Raises:
        InputError: nothing to resume, other settings than the checkpoint's, or another architecture.
    """
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
    run = Run(
        config,
        device,
        out,
        network,
        make_optimiser(network, schedule),
        RunningAverage(network.inference, schedule.average),
        start=RANDOM if start_from is None else THE_RUN_BEFORE if before else "given weights",
        before=list(before),
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
        run.start, run.before = state.get("start", "unknown"), state.get("before", [])  # older
    return run


def export(model: Utopic, card: dict[str, Any], out: Path) -> Path:
    """Write weights and card to a folder, both or neither."""
    blob, text = pack_weights(model, card)
    path = out / "utopic.safetensors"
    write_together({path.with_suffix(".json"): text, path: blob}, overwrite=True)
    return path


def total_pairs(schedule: Schedule) -> int:
    """Return how many pairs a run sees."""
    return schedule.descriptor_pairs + schedule.joint_pairs
