"""Where variants of one network start: alike wherever they can be."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from utopic_cli.config import ModelConfig
from utopic_cli.model.utopic import Utopic


def common_start(
    variant: ModelConfig, full: ModelConfig, seed: int, trained: Mapping[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Return first weights of a variant that differ from the full network's only where they must.

    A part more or less shifts every later draw, so two variants built from one seed would differ everywhere.

    Args:
        variant: architecture of the variant.
        full: architecture of the network that it is a variant of.
        seed: of the full network's weights, and of what the variant alone has.
        trained: weights by name that are known better already; they win where their shapes fit.

    Returns:
        All tensors of the variant's inference network by name.
    """
    own, known = (_fresh(config, seed) for config in (variant, full))
    known.update(trained or {})
    return {
        name: known[name] if name in known and known[name].shape == value.shape else value
        for name, value in own.items()
    }


def _fresh(config: ModelConfig, seed: int) -> dict[str, Tensor]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return dict(Utopic(config).state_dict())
