"""The folder of an experiment with variants: what it is, and the runs in it, each done once."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from utopic_cli.benchmark.variants import CONTROL, FULL, VARIANTS, Changes
from utopic_cli.commands.console import Console
from utopic_cli.commands.training_view import TrainingView
from utopic_cli.commands.variant_settings import Budget, changed_config
from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.output import check_writable, write_atomically
from utopic_cli.model.weights import load_weights, read_card
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training import trainer
from utopic_cli.training.checkpoint import describe_difference
from utopic_cli.training.config import TrainingConfig
from utopic_cli.training.run import total_pairs
from utopic_cli.training.start import common_start

if TYPE_CHECKING:
    import torch

EXPERIMENT = "experiment.json"
WEIGHTS = "utopic.safetensors"
DESCRIPTORS = "descriptors"
SCHEMA_VERSION = 1


def folder_of_experiment(out: Path, resume: bool) -> dict[str, Any] | None:
    """Check, before any work, the folder of an experiment.

    Returns:
        What its ``experiment.json`` says if it is to be gone on with; None for a new one.

    Raises:
        OutputError: it is no folder, can't be written, or holds anything when a new one is asked for.
        InputError: there is nothing to resume, or not of this kind.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is not a folder; name another place")
    there = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    check_writable([there / EXPERIMENT], overwrite=True)
    path = out / EXPERIMENT
    if resume:
        return _read(path)
    if path.exists():
        raise OutputError(f"{out}: holds an experiment already; go on with --resume, or name another folder")
    held = next(iter(sorted(out.iterdir())), None) if out.exists() else None
    if held is not None:
        raise OutputError(f"{out}: holds other files already ({held.name}); name a new or an empty folder")
    return None


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: no experiment to resume here; run without --resume to start one")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: can't be read as an experiment ({error})") from error
    if not isinstance(content, dict) or not all(
        isinstance(content.get(name), dict) for name in ("budget", "config", "shapes")
    ):
        raise InputError(f"{path}: not an experiment with variants; name its folder, or start a new one")
    return content


@dataclass(frozen=True)
class Experiment:
    """Variants of one network under one budget, in one folder; several tables may share it.

    Attributes:
        folder: holds ``experiment.json`` and a folder for each run.
        base: settings of the full network, its schedule already that of the budget.
        budget: what each variant may cost.
        data: what the shapes are called.
        shapes: to make pairs of.
        device: where to train.
        workers: processes that make pairs.
        console: told how far it is.
    """

    folder: Path
    base: TrainingConfig
    budget: Budget
    data: str
    shapes: ShapeLibrary
    device: torch.device
    workers: int
    console: Console

    def as_dict(self) -> dict[str, Any]:
        """Return what makes it this experiment and no other, JSON-ready."""
        splits = self.shapes.splits.tolist()
        return {
            "schema_version": SCHEMA_VERSION,
            "data": self.data,
            "shapes": {split: splits.count(split) for split in sorted(set(splits))},
            "budget": vars(self.budget).copy(),
            "config": self.base.as_dict(),
        }

    def write(self) -> None:
        """Write ``experiment.json``."""
        self.folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(self.as_dict(), indent=2, allow_nan=False) + "\n"
        write_atomically(self.folder / EXPERIMENT, text.encode("utf-8"), overwrite=True)

    def check_same(self, before: Mapping[str, Any]) -> None:
        """Make sure that the folder holds this very experiment.

        Raises:
            InputError: it is another one; says in what.
        """
        changed = describe_difference(before, self.as_dict())
        if changed:
            raise InputError(
                f"{self.folder / EXPERIMENT}: another experiment ({changed}); use the same options "
                "to resume, or name another folder"
            )

    def config(self, variant: str) -> TrainingConfig:
        """Return the settings of a variant's run."""
        stage: Changes = {"schedule": {"descriptor_pairs": 0}}
        if variant == CONTROL:
            stage = {"schedule": {"descriptor_pairs": 0, "seed": self.base.schedule.seed + 1}}
        return changed_config(self.base, stage, VARIANTS[FULL if variant == CONTROL else variant])

    def train(self, variant: str) -> Path:
        """Train a variant, or go on with it; nothing is done if it is finished.

        Returns:
            Path of its weights.
        """
        config = self.config(variant)
        shared = {}
        if self.budget.descriptor_pairs:
            first = changed_config(self.base, {"schedule": {"joint_pairs": 0}})
            descriptors = load_weights(str(self._run(DESCRIPTORS, first, None)))[0].state_dict()
            shared = {name: value for name, value in descriptors.items() if name.startswith("extractor.")}
        start = common_start(config.model, self.base.model, config.schedule.seed, shared)
        return self._run(variant, config, start)

    def _run(self, name: str, config: TrainingConfig, start: dict[str, torch.Tensor] | None) -> Path:
        out = self.folder / name
        weights = out / WEIGHTS
        total = total_pairs(config.schedule)
        if weights.is_file() and self._seen(weights, config) >= total:
            return weights
        self.console.line(f"training {name} on {total:,} pairs")
        with TrainingView(self.console) as view:
            trainer.train(
                config,
                self.shapes.select("train"),
                self.shapes.select("val"),
                out,
                resume=(out / "checkpoint.pt").is_file(),
                device=self.device,
                workers=self.workers,
                start_from=start,
                progress=view.show,
            )
        if self._seen(weights, config) < total:  # asked to end by a signal: saved, but not done
            raise KeyboardInterrupt
        return weights

    @staticmethod
    def _seen(weights: Path, config: TrainingConfig) -> int:
        """Return how many pairs a run has seen.

        Raises:
            InputError: it was made with other settings, or its card can't be read.
        """
        card = read_card(weights)
        runs = card.get("runs") or [{}]
        changed = describe_difference(runs[-1].get("training", {}), config.as_dict())
        if changed:
            raise InputError(f"{weights}: made with other settings ({changed}); name another folder")
        return int(card.get("pairs_seen", 0))


def known_budget(content: Mapping[str, Any], where: Path) -> Budget:
    """Return the budget of an experiment that is gone on with.

    Raises:
        InputError: it holds no such thing.
    """
    try:
        budget = Budget(**content["budget"])
        if not (isinstance(budget.pairs, int) and budget.pairs > 0):
            raise ValueError(f"pairs is {budget.pairs!r}")
    except (TypeError, ValueError) as error:
        raise InputError(f"{where / EXPERIMENT}: its budget can't be used ({error})") from error
    return budget
