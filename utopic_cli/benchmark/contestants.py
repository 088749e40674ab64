"""Everything that one run on synthetic pairs measures side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from utopic_cli.benchmark.baselines import BASELINES, find_baselines
from utopic_cli.benchmark.matcher import FEATURES, Matcher, load_matchers
from utopic_cli.benchmark.method import Method
from utopic_cli.errors import UsageError

KNOWN = (*FEATURES, *BASELINES)


@dataclass(frozen=True)
class Contestants:
    """Who is asked for answers.

    Attributes:
        matchers: find correspondences, which go into our robust solve.
        methods: register clouds by themselves.
    """

    matchers: tuple[Matcher, ...] = ()
    methods: tuple[Method, ...] = ()

    def settings(self) -> dict[str, dict[str, Any]]:
        """Return everything needed to repeat each, by name, JSON-ready."""
        everybody: list[Matcher | Method] = [*self.matchers, *self.methods]
        return {one.name: one.settings() for one in everybody}


def load_contestants(weights: Sequence[str], baselines: Sequence[str], seed: int, device: str) -> Contestants:
    """Load what is to be measured.

    Args:
        weights: bundled names or paths; a weights file whose name is taken is called by its path.
        baselines: names from ``KNOWN``.
        seed: of the networks' overlap samples.
        device: of the networks: auto, cpu, cuda or mps.

    Raises:
        InputError: weights or device can't be used.
        UsageError: nothing to measure, or an unknown or unusable baseline.
    """
    check_baselines(baselines)
    if not weights and not baselines:
        raise UsageError("nothing to measure: name weights or a baseline")
    features = [name for name in baselines if name in FEATURES]
    methods = find_baselines([name for name in baselines if name in BASELINES])
    return Contestants(load_matchers(weights, features, seed, device), methods)


def check_baselines(names: Sequence[str]) -> None:
    """Make sure that baselines are known; whether they can run shows when they are loaded.

    Raises:
        UsageError: a name is not (the known ones are listed).
    """
    for name in names:
        if name not in KNOWN:
            raise UsageError(f"unknown baseline {name!r}; known: {', '.join(KNOWN)}")
