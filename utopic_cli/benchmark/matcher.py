"""What finds correspondences, behind one small interface; the solve is the same for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from utopic_cli.benchmark.baselines import load_open3d
from utopic_cli.benchmark.fpfh import Fpfh
from utopic_cli.bridge import NetworkView, load_network, predict
from utopic_cli.errors import UsageError
from utopic_cli.model.utopic import Utopic
from utopic_cli.preprocess import PreparedPair

BASELINES = ("fpfh",)


class Matcher(Protocol):
    """Anything that says which sampled points of a pair belong together."""

    @property
    def name(self) -> str:
        """What the tables call it."""
        ...

    @property
    def tells_overlap(self) -> bool:
        """Whether its overlap per point means anything."""
        ...

    @property
    def looks_again(self) -> bool:
        """Whether its view changes when it is shown a transformation."""
        ...

    def settings(self) -> dict[str, Any]:
        """Return everything needed to repeat it, JSON-ready."""
        ...

    def look(self, prepared: PreparedPair, hypothesis: np.ndarray | None = None) -> NetworkView:
        """Say what it sees, shown a (4, 4) transformation of the normalised clouds or none."""
        ...


@dataclass(frozen=True)
class Network:
    """A trained network.

    Attributes:
        name: what the tables call it.
        model: the network on its device.
        card: its weights' card.
        seed: seed of its overlap samples.
        tells_overlap: whether it has overlap heads.
    """

    name: str
    model: Utopic
    card: dict[str, Any]
    seed: int
    tells_overlap: bool = True

    @property
    def looks_again(self) -> bool:
        """Whether it accepts a transformation under test."""
        return self.model.config.hypothesis

    def settings(self) -> dict[str, Any]:
        """Return name and hash of the weights."""
        return {
            "weights": self.card["name"],
            "weights_sha256": self.card["sha256"],
            "parameters": sum(parameter.numel() for parameter in self.model.parameters()),
            "device": str(next(self.model.parameters()).device),
        }

    def look(self, prepared: PreparedPair, hypothesis: np.ndarray | None = None) -> NetworkView:
        """Run the network."""
        return predict(self.model, prepared, self.seed, hypothesis)


def load_matchers(
    weights: Sequence[str], baselines: Sequence[str], seed: int, device: str
) -> tuple[Matcher, ...]:
    """Load what is to be measured, the networks first.

    Args:
        weights: bundled names or paths; a weights file whose name is taken is called by its path.
        baselines: names; ``fpfh`` is known.
        seed: of the networks' overlap samples.
        device: auto, cpu, cuda or mps.

    Raises:
        InputError: weights or device can't be used.
        UsageError: nothing to measure, an unknown baseline (the known ones are listed), or no Open3D.
    """
    check_baselines(baselines)
    if not weights and not baselines:
        raise UsageError("nothing to measure: name weights or a baseline")
    found: list[Matcher] = []
    for one in dict.fromkeys(weights):
        model, card = load_network(one, device)
        taken = {matcher.name for matcher in found}
        name = one if card["name"] in taken else card["name"]
        found.append(Network(name, model, card, seed, model.config.overlap))
    found += [Fpfh() for _ in dict.fromkeys(baselines)]
    return tuple(found)


def check_baselines(names: Sequence[str]) -> None:
    """Make sure, before any work, that baselines are known and can run.

    Raises:
        UsageError: see ``load_matchers``.
    """
    for name in names:
        if name not in BASELINES:
            raise UsageError(f"unknown baseline {name!r}; this protocol knows: {', '.join(BASELINES)}")
    if names:
        load_open3d()
