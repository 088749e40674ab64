"""The head of the variance, fitted by itself: to what is matched wrongly, and nothing else changes."""

from __future__ import annotations

import dataclasses
from copy import deepcopy

import pytest
import torch

from tests.model.conftest import SMALL
from tests.training.conftest import SCHEDULE
from utopic_cli.config import ModelConfig
from utopic_cli.model.utopic import Utopic
from utopic_cli.model.weights import load_weights
from utopic_cli.training import trainer
from utopic_cli.training.checkpoint import read_checkpoint
from utopic_cli.training.config import TrainingConfig
from utopic_cli.training.network import TrainingNetwork
from utopic_cli.training.validation import fixed_pairs
from utopic_cli.training.variance import fit_variance

CONFIG = TrainingConfig(
    model=ModelConfig(**SMALL, uncertainty_scheme="matched", hypothesis=True),
    schedule=dataclasses.replace(SCHEDULE, descriptor_pairs=2, joint_pairs=2, variance_pairs=3),
)
HEAD = (
    "quantification.log_variance.weight",
    "quantification.log_variance.bias",
    "quantification.evidence.weight",
)


@pytest.fixture(scope="module")
def pairs(shapes):
    return list(fixed_pairs(shapes, CONFIG, 5, 4))


def reliability(network, pairs):
    """The loss of the runs, by the network's own way through them."""
    total = 0.0
    for pair in pairs:
        for present in (0.0, 1.0):
            shown = pair._replace(
                hypothesis=pair.gt_T_target_source, hypothesis_present=torch.tensor([present])
            )
            with torch.no_grad():
                terms = network.eval().joint_stage(shown, torch.Generator().manual_seed(0), False, False)
            total += float(terms["reliability"])
    return total / (2 * len(pairs))


def test_the_loss_of_the_runs_falls_and_only_the_head_changes(pairs):
    torch.manual_seed(3)
    network = TrainingNetwork(CONFIG.model)
    known = deepcopy(network.inference.state_dict())
    loss = reliability(network, pairs)
    before, after = fit_variance(network.inference, pairs)
    assert after < before - 0.02
    assert reliability(network, pairs) < loss - 0.5 * (before - after)
    for name, value in network.inference.state_dict().items():
        assert torch.equal(value, known[name]) == (name not in HEAD), name
    evidence = "quantification.evidence.weight"  # whose first row is the mean's
    assert torch.equal(network.inference.state_dict()[evidence][0], known[evidence][0])


def test_it_needs_a_head_of_its_own(pairs):
    with pytest.raises(ValueError, match="head of its own"):
        fit_variance(Utopic(ModelConfig(**{**SMALL, "uncertainty_scheme": "sampled"})), pairs)


def test_a_run_that_reaches_its_end_fits_it(shapes, tmp_path):
    path = trainer.train(CONFIG, shapes, shapes, tmp_path, workers=0)
    model, card = load_weights(str(path))
    average = read_checkpoint(tmp_path / "checkpoint.pt")["average"]
    for name, value in model.state_dict().items():
        assert torch.equal(value, average[name].half().float()) == (name not in HEAD), name
    assert (
        card["uncertainty"]["pairs"] == 3 and card["uncertainty"]["loss"][1] < card["uncertainty"]["loss"][0]
    )
    plain = dataclasses.replace(CONFIG, schedule=dataclasses.replace(CONFIG.schedule, variance_pairs=0))
    path = trainer.train(plain, shapes, shapes, tmp_path / "plain", workers=0)
    assert "uncertainty" not in load_weights(str(path))[1]
    path = trainer.train(CONFIG, shapes, shapes, tmp_path / "early", workers=0, minutes=0.0)
    assert "uncertainty" not in load_weights(str(path))[1]
