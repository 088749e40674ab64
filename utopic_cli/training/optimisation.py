"""How weights move: rates over a run, groups of parameters, steps, and the running average."""

from __future__ import annotations

import math

import torch

from utopic_cli.model.utopic import Utopic
from utopic_cli.training.config import Schedule
from utopic_cli.training.network import TrainingNetwork

FAST = (
    "matching.gain",
    "matching.bias",
    "matching.skip_gain",
    "quantification.evidence.weight",
    "overlap_head.mass_gain",
    "overlap_head.mean_gain",
)
"""Parameters whose rate is multiplied by the schedule's ``matching_rate``."""

WARM_UP = 200
"""Pairs over which the rate rises at the start of a stage."""

STEP_FACTOR = 0.2
"""What each of the schedule's ``rate_steps`` multiplies the rate with (the paper's)."""


def learning_rate(schedule: Schedule, pairs: int) -> float:
    """Return the rate after so many pairs: a short warm-up, then steps or a cosine to a twentieth."""
    joint = pairs >= schedule.descriptor_pairs
    start = schedule.descriptor_pairs if joint else 0
    length = schedule.joint_pairs if joint else schedule.descriptor_pairs
    highest = schedule.joint_rate if joint else schedule.descriptor_rate
    share = min((pairs - start) / max(length, 1), 1.0)
    warm = min((pairs - start + 1) / min(WARM_UP, max(length, 1)), 1.0)
    if schedule.rate_steps:
        return highest * warm * STEP_FACTOR ** sum(share >= step for step in schedule.rate_steps)
    return highest * warm * (0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * share)))


def make_optimiser(network: TrainingNetwork, schedule: Schedule) -> torch.optim.Optimizer:
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


def step(
    network: TrainingNetwork, optimiser: torch.optim.Optimizer, rate: float, clip: float
) -> torch.Tensor:
    """Clip the gradients to norm ``clip``, take a step at ``rate``; returns the norm there was."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group["factor"]
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)
    return norm


class RunningAverage:
    """Exponential running average of an inference network's weights: what validation and export use."""

    def __init__(self, model: Utopic, decay: float) -> None:
        """Start at the weights as they are."""
        self.decay = decay
        self.weights = {name: value.detach().clone() for name, value in model.state_dict().items()}

    @torch.no_grad()
    def update(self, model: Utopic, steps: int) -> None:
        """Move towards the weights after ``steps`` steps; early steps count more, so it is never stale."""
        decay = min(self.decay, steps / (steps + 10.0))
        for name, value in model.state_dict().items():
            if value.is_floating_point():
                self.weights[name].lerp_(value, 1.0 - decay)
            else:
                self.weights[name].copy_(value)

    def restore(self, weights: dict[str, torch.Tensor]) -> None:
        """Go on from saved averages."""
        for name, value in weights.items():
            self.weights[name].copy_(value)

    def network(self, model: Utopic) -> Utopic:
        """Return a copy of the network with the averaged weights, for evaluation on the CPU."""
        averaged = Utopic(model.config)
        averaged.load_state_dict(self.weights)
        return averaged.eval()
