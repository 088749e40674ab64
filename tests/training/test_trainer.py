"""The loop: it learns, resumes exactly, exports what it trained, and stops on nonsense."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from tests.model.conftest import SMALL
from utopic_cli.config import ModelConfig
from utopic_cli.errors import InputError
from utopic_cli.model.weights import load_weights
from utopic_cli.synthesis.pairs import PairSettings, random_pair, surface_pair
from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.training import trainer
from utopic_cli.training.checkpoint import read_checkpoint
from utopic_cli.training.config import Schedule, TrainingConfig, read_training_config
from utopic_cli.training.data import (
    BLOCK,
    PairKeys,
    SynthesisedPairs,
    sample_pair,
    to_training_pair,
)
from utopic_cli.training.network import TrainingNetwork, total_loss

SCHEDULE = Schedule(
    descriptor_pairs=4,
    joint_pairs=4,
    points=(60, 80),
    last_points=(60, 80),
    bfloat16=False,
    validation_pairs=1,
    masking_from=0.5,
)
CONFIG = TrainingConfig(model=ModelConfig(**SMALL), schedule=SCHEDULE)


@pytest.fixture(scope="module")
def shapes():
    return procedural_shapes(np.random.default_rng(0), 10)


def run(shapes, out, config=CONFIG, **options):
    return trainer.train(config, shapes, shapes, out, workers=0, **options)


def test_resuming_equals_an_uninterrupted_run(shapes, tmp_path):
    run(shapes, tmp_path / "whole")
    run(shapes, tmp_path / "parts", minutes=0.0)  # stops after the first step
    interrupted = read_checkpoint(tmp_path / "parts" / "checkpoint.pt")
    assert interrupted["pairs"] == SCHEDULE.batch
    run(shapes, tmp_path / "parts", resume=True)
    whole, parts = (read_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    assert whole["pairs"] == parts["pairs"] == 8
    for name, value in whole["model"].items():
        assert torch.equal(value, parts["model"][name]), name
    for name, value in whole["average"].items():
        assert torch.equal(value, parts["average"][name]), name


def test_the_export_is_the_average_of_the_weights(shapes, tmp_path):
    path = run(shapes, tmp_path)
    model, card = load_weights(str(path))
    average = read_checkpoint(tmp_path / "checkpoint.pt")["average"]
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, average[name].half().float(), msg=name)
    assert card["pairs_seen"] == 8
    assert not any(name.startswith("completion") for name in model.state_dict())
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert records[-1]["pairs"] == 8 and 0 <= records[-1]["hit_rate"] <= 1


def test_one_pair_can_be_learnt_by_heart(shapes):
    torch.manual_seed(0)
    config = dataclasses.replace(CONFIG.model, descriptor_width=16, feature_width=32)
    rng = np.random.default_rng(3)
    pair = to_training_pair(sample_pair(random_pair(shapes, rng, PairSettings()), 80, rng), config.neighbours)
    network = TrainingNetwork(config)
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3)
    weights = CONFIG.loss.weights()
    losses = []
    for step in range(120):
        terms = network.joint_stage(pair, torch.Generator().manual_seed(step), masking=False, completion=True)
        assert set(terms) == set(weights._fields)
        loss = total_loss(terms, weights)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])


def test_the_papers_setting_takes_a_step(shapes):
    config = read_training_config("paper")
    network = TrainingNetwork(config.model, config.loss.correspondence_radius, config.loss.completion_points)
    rng = np.random.default_rng(0)
    shared = surface_pair(shapes.mesh(0), rng, sampling="shared", keep=0.7, count=200, noise=0.01, clip=0.05)
    pair = to_training_pair(sample_pair(shared, 200, rng), config.model.neighbours)
    assert pair.source.points.shape[1] == 140
    terms = network.joint_stage(pair, torch.Generator().manual_seed(0), masking=True, completion=True)
    total_loss(terms, config.loss.weights()).backward()
    # Parts the paper's loss does not reach: descriptors, their temperature, the skipped similarity.
    unreached = [name for name, value in network.named_parameters() if value.grad is None]
    assert all("descriptor" in name or "temperature" in name for name in unreached), unreached
    sizes = {name: sum(p.numel() for p in part.parameters()) for name, part in network.named_children()}
    assert 8e6 < sizes["inference"] < 10e6  # the paper's has 8.55 M


def test_a_loss_that_is_no_number_stops_the_run_and_keeps_the_checkpoint(shapes, tmp_path, monkeypatch):
    run(shapes, tmp_path, minutes=0.0)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    monkeypatch.setattr(
        trainer, "_losses", lambda *_: {"descriptor": torch.tensor(float("nan"), requires_grad=True)}
    )
    with pytest.raises(trainer.DivergedError, match="the loss is nan at pair 2"):
        run(shapes, tmp_path, resume=True)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_resuming_needs_a_sound_checkpoint_of_the_same_settings(shapes, tmp_path):
    with pytest.raises(InputError, match="no checkpoint to resume from"):
        run(shapes, tmp_path, resume=True)
    run(shapes, tmp_path, minutes=0.0)
    other = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, joint_rate=0.5))
    with pytest.raises(InputError, match="made with other settings"):
        run(shapes, tmp_path, config=other, resume=True)
    (tmp_path / "checkpoint.pt").write_bytes(b"garbage")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        run(shapes, tmp_path, resume=True)


def test_pairs_depend_on_seed_and_number_alone(shapes):
    def points(seed, number):
        pairs = SynthesisedPairs(shapes, PairSettings(), seed, 6)
        return pairs[(number, 60, 80)].source.points

    assert torch.equal(points(1, 5), points(1, 5))
    assert points(1, 5).shape != points(1, 6).shape or not torch.equal(points(1, 5), points(1, 6))
    assert points(1, 5).shape != points(2, 5).shape or not torch.equal(points(1, 5), points(2, 5))


def test_each_pair_is_shown_as_often_as_asked_whatever_the_start():
    def keys(start):
        return list(PairKeys(start, 4 * BLOCK, 2, lambda sample: (50, sample)))

    everything = keys(0)
    numbers = [number for number, _, _ in everything]
    assert numbers == [*range(BLOCK), *range(BLOCK), *range(BLOCK, 2 * BLOCK), *range(BLOCK, 2 * BLOCK)]
    assert everything[: 2 * BLOCK][BLOCK:] == everything[:BLOCK]  # shown again with the same settings
    assert keys(37) == everything[37:]


def test_the_rate_warms_up_and_falls_in_each_stage():
    schedule = Schedule(descriptor_pairs=1000, joint_pairs=1000)
    rates = [trainer.learning_rate(schedule, pairs) for pairs in range(2000)]
    assert rates[0] < 0.05 * schedule.descriptor_rate
    assert max(rates[:1000]) <= schedule.descriptor_rate and max(rates[1000:]) <= schedule.joint_rate
    assert rates[999] < 0.1 * schedule.descriptor_rate and rates[1999] < 0.1 * schedule.joint_rate
    assert rates[1250] > 0.8 * schedule.joint_rate


@pytest.mark.parametrize("name", ["default", "paper"])
def test_shipped_configurations_are_read(name):
    assert read_training_config(name).schedule.joint_pairs > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[model]\nwidth = 3", r"unknown key width; known keys: .*feature_width"),
        ("[optimizer]\nlr = 1", r"unknown section optimizer; known: model, loss, schedule"),
        ("[schedule]\nbatch = 'two'", r"batch is 'two'; expected int"),
        ("model = [", "not valid TOML"),
        ("[schedule]\noptimiser = 'adam'", "optimiser is 'adam'; choose adamw, sgd"),
        ("[schedule]\nbatch = 3", "descriptor_pairs is 8000; give a multiple of batch 3"),
        ("[schedule]\npoints = [900, 400]", r"points is \[900, 400\]; give the fewest"),
    ],
)
def test_a_configuration_that_makes_no_sense_is_explained(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_training_config(str(path))


def test_an_unknown_configuration_name_lists_those_there_are():
    with pytest.raises(InputError, match="there are: default, paper"):
        read_training_config("fast")
