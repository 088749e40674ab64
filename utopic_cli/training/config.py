"""Settings of a training run, read from TOML; ``configs`` has those that ship in the package."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from utopic_cli.config import ModelConfig, from_dict, to_dict
from utopic_cli.errors import InputError
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.training.network import LossWeights

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

OPTIMISERS = ("adamw", "sgd")


@dataclass(frozen=True)
class Schedule:
    """How long, how fast, on what.

    Attributes:
        descriptor_pairs: pairs of the first stage (the extractor alone).
        joint_pairs: pairs of the second stage (the whole network).
        repeats: how often each synthesised pair is shown.
        batch: pairs per step; their gradients are averaged.
        points: fewest and most points per cloud, drawn anew for every pair.
        last_points: the same for the last fifth of the joint stage.
        optimiser: ``adamw`` or ``sgd`` (Nesterov momentum 0.9).
        descriptor_rate: highest learning rate of the first stage.
        joint_rate: highest learning rate of the second stage.
        rate_steps: shares of each stage after which the rate is multiplied by 0.2 (the paper's);
            none: a cosine.
        matching_rate: factor on the rate of gains and biases (``optimisation.FAST``).
        weight_decay: decoupled weight decay.
        clip: largest gradient norm.
        variance_pairs: pairs to which the head of the variance is fitted at the end; 0 leaves it.
        masking_from: share of the joint stage after which random masking starts.
        average: decay of the running average of the weights, which is what is exported.
        bfloat16: on a GPU, run the network in bfloat16 (losses and Sinkhorn stay float32).
        checkpoint_seconds: time between checkpoints.
        validation_pairs: pairs held out for validation.
        validation_seconds: time between validations.
        seed: seed of everything random.
    """

    descriptor_pairs: int = 8000
    joint_pairs: int = 12000
    variance_pairs: int = 0
    repeats: int = 2
    batch: int = 2
    points: tuple[int, ...] = (400, 900)
    last_points: tuple[int, ...] = (700, 1024)
    optimiser: str = "adamw"
    descriptor_rate: float = 2.5e-3
    joint_rate: float = 8e-4
    rate_steps: tuple[float, ...] = ()
    matching_rate: float = 20.0
    weight_decay: float = 1e-4
    clip: float = 1.0
    masking_from: float = 0.67
    average: float = 0.995
    bfloat16: bool = True
    checkpoint_seconds: float = 180.0
    validation_pairs: int = 32
    validation_seconds: float = 600.0
    seed: int = 1

    def __post_init__(self) -> None:
        """Refuse a schedule that can't be run.

        Raises:
            InputError: an unknown optimiser, a size below 1, a range of points that is none, pairs
                that don't fill whole steps, or fewer than none for the variance.
        """
        if self.optimiser not in OPTIMISERS:
            raise InputError(f"optimiser is {self.optimiser!r}; choose {', '.join(OPTIMISERS)}")
        for name in ("repeats", "batch"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("points", "last_points"):
            limits = getattr(self, name)
            if len(limits) != 2 or not 50 <= limits[0] <= limits[1]:
                raise InputError(f"{name} is {list(limits)}; give the fewest (50 or more) and the most")
        for name in ("descriptor_pairs", "joint_pairs"):
            if getattr(self, name) < 0 or getattr(self, name) % self.batch:
                raise InputError(f"{name} is {getattr(self, name)}; give a multiple of batch {self.batch}")
        if self.variance_pairs < 0:
            raise InputError(f"variance_pairs is {self.variance_pairs}; it must be at least 0")


@dataclass(frozen=True)
class LossSettings:
    """Weights of the loss terms, and what counts as a correspondence.

    ``correspondence_radius`` 0 gives soft correspondences for scans that share no points; a
    positive one gives the paper's mutual nearest neighbours within that radius (the larger
    cloud has radius 1). ``completion_points`` is the size of the coarse completion; the fine
    one has four times as many.
    """

    descriptor: float = 0.5
    registration: float = 1.0
    coarse: float = 0.5
    overlap: float = 1.0
    uncertainty: float = 1.0
    reliability: float = 0.5
    completion: float = 0.1
    completion_points: int = 128
    correspondence_radius: float = 0.0

    def weights(self) -> LossWeights:
        """Return the weights by term."""
        return LossWeights(**{name: getattr(self, name) for name in LossWeights._fields})


@dataclass(frozen=True)
class TrainingConfig:
    """One training run: the network, the losses, the schedule, and the pairs it learns from."""

    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossSettings = field(default_factory=LossSettings)
    schedule: Schedule = field(default_factory=Schedule)
    pairs: PairSettings = field(default_factory=PairSettings)

    def __post_init__(self) -> None:
        """Refuse to fit a head that the network has not, before training rather than after.

        Raises:
            InputError: ``variance_pairs`` with another scheme than ``matched``, or without hypotheses.
        """
        model = self.model
        if self.schedule.variance_pairs and not (model.uncertainty_scheme == "matched" and model.hypothesis):
            raise InputError(
                'variance_pairs needs uncertainty_scheme "matched" and hypothesis true; set it to 0'
            )

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain data."""
        return {section: to_dict(getattr(self, section)) for section in SECTIONS}


SECTIONS: dict[str, type] = {
    "model": ModelConfig,
    "loss": LossSettings,
    "schedule": Schedule,
    "pairs": PairSettings,
}
"""The sections of a configuration, and of a TOML file."""


def training_config_from(values: dict[str, Any], where: str) -> TrainingConfig:
    """Build a configuration from sections of plain data.

    Raises:
        InputError: an unknown section or key (the known ones are listed), a wrong type, or values
            that don't go together.
    """
    unknown = sorted(set(values) - set(SECTIONS))
    if unknown:
        raise InputError(f"{where}: unknown section {', '.join(unknown)}; known: {', '.join(SECTIONS)}")
    built: dict[str, Any] = {
        name: from_dict(kind, values.get(name, {}), f"{where} [{name}]") for name, kind in SECTIONS.items()
    }
    try:
        return TrainingConfig(**built)
    except InputError as error:  # sections that don't go together
        raise InputError(f"{where}: {error}") from error


def read_training_config(name_or_path: str) -> TrainingConfig:
    """Read a configuration that ships with the package by name, or any TOML file by path.

    Raises:
        InputError: no such file or name, no valid TOML, or unknown keys.
    """
    folder = Path(__file__).parent / "configs"
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = folder / f"{name_or_path}.toml"
        if not path.is_file():
            shipped = ", ".join(sorted(file.stem for file in folder.glob("*.toml")))
            raise InputError(
                f"{name_or_path}: no configuration of that name (there are: {shipped}; or give a .toml file)"
            )
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML ({error})") from error
    return training_config_from(values, str(path))
