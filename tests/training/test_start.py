"""Variants start alike wherever they can."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.model.conftest import SMALL
from utopic_cli.config import ModelConfig
from utopic_cli.model.utopic import Utopic
from utopic_cli.training.start import common_start

FULL = ModelConfig(**SMALL)


@pytest.mark.parametrize("scheme", ["vanilla", "absolute", "learned", "geometric"])
def test_a_variant_differs_from_the_full_network_only_where_it_must(scheme):
    variant = replace(FULL, positional_scheme=scheme)
    full, start = common_start(FULL, FULL, 3), common_start(variant, FULL, 3)
    Utopic(variant).load_state_dict(start, strict=True)
    shared = [name for name in start if name in full]
    assert len(shared) > 0.9 * len(full)
    assert all(torch.equal(start[name], full[name]) for name in shared)
    assert any(not torch.equal(start[name], value) for name, value in common_start(variant, FULL, 4).items())


def test_what_was_trained_before_wins_where_it_fits():
    name = "extractor.descriptor.weight"
    trained = {
        name: torch.full_like(Utopic(FULL).state_dict()[name], 7.0),
        "overlap_head.linear.bias": torch.ones(9),
    }
    start = common_start(replace(FULL, positional_scheme="learned"), FULL, 3, trained)
    assert torch.equal(start[name], trained[name])
    assert start["overlap_head.linear.bias"].shape == (1,)


def test_no_global_draw_is_used_up():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    common_start(FULL, FULL, 3)
    assert torch.equal(torch.rand(3), expected)
