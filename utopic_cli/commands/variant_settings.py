"""What the variants of an experiment share: the settings they are changes of, and what each may cost."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.variants import Changes, together
from utopic_cli.errors import InputError, UsageError
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training import trainer
from utopic_cli.training.config import Schedule, TrainingConfig, training_config_from

if TYPE_CHECKING:
    import torch

PACE_SHARE, PACE_MINUTES = 0.1, 1.0
"""The pace is measured for this share of the budget, and no longer than this."""

STOPPED_EARLY = 10.0
"""A measurement with so many seconds left was asked to end by a signal."""


@dataclass(frozen=True)
class Budget:
    """What each variant may cost.

    Attributes:
        pairs: shown to each variant.
        descriptor_pairs: shown before, once for all.
        minutes: that were asked for; None where pairs were.
        pairs_per_s: the pace that turned minutes into pairs; None likewise.
    """

    pairs: int = 0
    descriptor_pairs: int = 0
    minutes: float | None = None
    pairs_per_s: float | None = None


def base_config(config: TrainingConfig, seed: int) -> TrainingConfig:
    """Return the settings that variants are changes of.

    Raises:
        InputError: they lack a part that a variant is to leave out.
    """
    model, loss = config.model, config.loss
    parts = {
        "model.overlap": model.overlap,
        "model.uncertainty_scheme = 'sampled'": model.uncertainty_scheme == "sampled",
        "model.positional_scheme = 'geometric'": model.positional_scheme == "geometric",
        "loss.overlap": loss.overlap > 0,
        "loss.completion": loss.completion > 0,
        "loss.uncertainty": loss.uncertainty > 0,
        "schedule.masking_from below 1": config.schedule.masking_from < 1.0,
        "schedule.joint_pairs": config.schedule.joint_pairs > 0,
    }
    missing = [name for name, there in parts.items() if not there]
    if missing:
        raise InputError(
            f"variants leave out parts of a full network, and the configuration has no {', '.join(missing)}"
        )
    return replace(config, schedule=replace(config.schedule, seed=seed))


def changed_config(base: TrainingConfig, *changes: Changes) -> TrainingConfig:
    """Return settings with some changed, the later ones winning."""
    values = base.as_dict()
    for section, keys in together(*changes).items():
        values[section] = {**values[section], **keys}
    return training_config_from(values, "the variant")


def within_budget(base: TrainingConfig, pairs: int) -> TrainingConfig:
    """Return settings whose joint stage has so many pairs, the stage before in proportion."""
    schedule = base.schedule
    descriptor = _whole_steps(pairs * schedule.descriptor_pairs / schedule.joint_pairs, schedule)
    return replace(
        base,
        schedule=replace(
            schedule,
            joint_pairs=pairs,
            descriptor_pairs=descriptor if schedule.descriptor_pairs else 0,
        ),
    )


def budget_of_pairs(base: TrainingConfig, pairs: int) -> Budget:
    """Return the budget of so many pairs.

    Raises:
        UsageError: they don't fill whole steps.
    """
    batch = base.schedule.batch
    if pairs < 1 or pairs % batch:
        raise UsageError(f"--train-pairs {pairs}: give a multiple of {batch}, the pairs of a step")
    return Budget(pairs, within_budget(base, pairs).schedule.descriptor_pairs)


def budget_of_minutes(
    base: TrainingConfig,
    minutes: float,
    shapes: ShapeLibrary,
    device: torch.device,
    workers: int,
) -> Budget:
    """Measure the pace of the full network for a short while, and return how many pairs fill the minutes.

    Every variant then gets so many pairs, however long it takes: that a machine is busy now and then
    would decide between them otherwise.
    """
    config = changed_config(base, {"schedule": {"descriptor_pairs": 0, "validation_pairs": 1}})
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="utopic-pace-") as folder:
        trainer.train(
            config,
            shapes.select("train"),
            shapes.select("val"),
            Path(folder),
            minutes=min(PACE_SHARE * minutes, PACE_MINUTES),
            device=device,
            workers=workers,
            progress=records.append,
        )
    last = records[-1]
    if last.get("left_s", 0.0) > STOPPED_EARLY:
        raise KeyboardInterrupt
    pace = last["pairs"] / max(last["elapsed_s"], 0.1)
    pairs = _whole_steps(60.0 * minutes * pace, base.schedule)
    return Budget(pairs, within_budget(base, pairs).schedule.descriptor_pairs, minutes, round(pace, 3))


def _whole_steps(pairs: float, schedule: Schedule) -> int:
    return max(1, round(pairs / schedule.batch)) * schedule.batch
