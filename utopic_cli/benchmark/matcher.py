"""What finds correspondences, behind one small interface; the solve is the same for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from utopic_cli.benchmark.fpfh import Fpfh
from utopic_cli.benchmark.open3d_methods import load_open3d
from utopic_cli.bridge import NetworkView, load_network, predict, weigh
from utopic_cli.model.utopic import Utopic
from utopic_cli.preprocess import PreparedPair

FEATURES = ("fpfh",)
"""Hand-made features that can take the network's place."""


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

    def look(self, prepared: PreparedPair) -> NetworkView:
        """Say what it sees at first."""
        ...

    def look_again(
        self, prepared: PreparedPair, first: NetworkView, hypothesis: np.ndarray, odds: float
    ) -> NetworkView:
        """Say what it sees once it is shown a transformation.

        Args:
            prepared: the pair.
            first: what it saw at first.
            hypothesis: (4, 4) between the normalised clouds.
            odds: log-odds that it is right.
        """
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

    def look(self, prepared: PreparedPair) -> NetworkView:
        """Run the network."""
        return predict(self.model, prepared, self.seed)

    def look_again(
        self, prepared: PreparedPair, first: NetworkView, hypothesis: np.ndarray, odds: float
    ) -> NetworkView:
        """Run it once more, and weigh what it sees."""
        return weigh(self.model, first, predict(self.model, prepared, self.seed, hypothesis), odds)


def load_matchers(
    weights: Sequence[str], features: Sequence[str], seed: int, device: str
) -> tuple[Matcher, ...]:
    """Load matchers, the networks first.

    Args:
        weights: bundled names or paths; a weights file whose name is taken is called by its path.
        features: names from ``FEATURES``.
        seed: of the networks' overlap samples.
        device: auto, cpu, cuda or mps.

    Raises:
        InputError: weights or device can't be used.
        UsageError: no Open3D.
    """
    if features:
        load_open3d()
    found: list[Matcher] = []
    for one in dict.fromkeys(weights):
        model, card = load_network(one, device)
        taken = {matcher.name for matcher in found}
        name = one if card["name"] in taken else card["name"]
        found.append(Network(name, model, card, seed, model.config.overlap))
    found += [Fpfh() for _ in dict.fromkeys(features)]
    return tuple(found)
