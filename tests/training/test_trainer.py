"""The loop: it learns, resumes exactly, exports what it trained, and stops on nonsense."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch

from tests.model.conftest import SMALL
from tests.training.conftest import SCHEDULE
from utopic_cli.config import ModelConfig
from utopic_cli.errors import InputError
from utopic_cli.model.weights import load_weights
from utopic_cli.synthesis.pairs import PairSettings, random_pair, surface_pair
from utopic_cli.training import network as losses_of
from utopic_cli.training import trainer
from utopic_cli.training.checkpoint import read_checkpoint, write_checkpoint
from utopic_cli.training.config import (
    Schedule,
    TrainingConfig,
    read_training_config,
    training_config_from,
)
from utopic_cli.training.data import (
    BLOCK,
    Batch,
    BatchOrder,
    SynthesisedPairs,
    batch_loader,
    sample_pair,
    to_training_pair,
)
from utopic_cli.training.network import TrainingNetwork, total_loss
from utopic_cli.training.optimisation import learning_rate
from utopic_cli.training.pace import InterruptedRun
from utopic_cli.training.run import total_pairs
from utopic_cli.training.validation import validation_pairs

CONFIG = TrainingConfig(model=ModelConfig(**SMALL), schedule=SCHEDULE)


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


def test_the_card_tells_all_runs_that_weights_come_from(shapes, tmp_path):
    first, first_card = load_weights(str(run(shapes, tmp_path / "first")))
    assert [each["start"] for each in first_card["runs"]] == ["random weights"]
    assert first_card["runs"][0]["training"] == CONFIG.as_dict()
    start = {"start_from": first.state_dict(), "before": first_card["runs"]}
    run(shapes, tmp_path / "second", minutes=0.0, **start)
    card = load_weights(str(run(shapes, tmp_path / "second", resume=True)))[1]  # what came before is kept
    assert card["pairs_seen"] == 16 and [each["pairs"] for each in card["runs"]] == [8, 8]
    assert card["runs"][0] == first_card["runs"][0] and card["runs"][1]["start"] == "the run before"
    assert card["wall_clock_s"] == pytest.approx(sum(each["wall_clock_s"] for each in card["runs"]), abs=0.11)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_the_step_in_hand(shapes, tmp_path, number):
    def interrupt(record):
        if record["pairs"] == 0:
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    if number == signal.SIGINT:
        with pytest.raises(InterruptedRun) as stop:
            run(shapes, tmp_path, progress=interrupt)
        assert stop.value.weights == tmp_path / "utopic.safetensors"
    else:
        run(shapes, tmp_path, progress=interrupt)
    assert signal.getsignal(number) == before
    assert read_checkpoint(tmp_path / "checkpoint.pt")["pairs"] == SCHEDULE.batch
    assert (tmp_path / "utopic.safetensors").is_file()


def test_workers_outlive_signals_to_the_whole_group(shapes):
    pairs = SynthesisedPairs(shapes, PairSettings(), 1, 6)
    batches = iter(batch_loader(pairs, BatchOrder(0, 40, 1, 1, lambda _: (60, 60)), workers=1))
    next(batches)
    (worker,) = multiprocessing.active_children()
    for number in (signal.SIGTERM, signal.SIGINT):
        os.kill(worker.pid, number)
    assert sum(1 for _ in batches) == 39
    worker.join(20)
    assert worker.exitcode == 0  # told to end, it does


def test_the_journal_starts_with_the_untrained_network(shapes, tmp_path):
    records = []
    run(shapes, tmp_path, minutes=0.0, progress=records.append)
    assert [record["pairs"] for record in records] == [0, SCHEDULE.batch]
    assert "hit_rate" in records[0] and "match_rate" not in records[0]  # only what the stage trains
    assert records[1]["left_s"] == 0 and 0 <= records[1]["waiting"] <= 1


def test_a_short_run_is_validated_on_fewer_pairs(shapes):
    config = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, validation_pairs=6))
    every, first, few = (validation_pairs(shapes, config, minutes) for minutes in (None, 0.9, 0.0))
    assert [len(pairs) for pairs in (every, first, few)] == [6, 5, 4]
    assert torch.equal(every[4].source.points, first[4].source.points)


def test_weights_of_another_architecture_are_refused(shapes, tmp_path):
    other = TrainingNetwork(ModelConfig(**{**SMALL, "feature_width": 24})).inference.state_dict()
    with pytest.raises(InputError, match=r"another architecture: .*: .*, now "):
        run(shapes, tmp_path, start_from=other)


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


def test_certainty_far_from_the_overlap_is_learnt_where_a_right_transformation_is_shown(shapes, monkeypatch):
    rng = np.random.default_rng(3)
    sample = sample_pair(random_pair(shapes, rng, PairSettings()), 80, rng)
    pair = to_training_pair(sample, CONFIG.model.neighbours)
    seen = []
    learn = losses_of.reliability_loss
    monkeypatch.setattr(losses_of, "reliability_loss", lambda *given: seen.append(given[-1]) or learn(*given))
    network = TrainingNetwork(CONFIG.model)
    right = pair.gt_T_target_source.clone()
    near, wrong = right.clone(), right.clone()
    near[:, :3, 3] += pair.source.spacing
    wrong[:, :3, 3] += 10.0 * pair.source.spacing
    for shown, present, expected in ((right, 1, 1), (near, 1, 1), (wrong, 1, 0), (right, 0, 0)):
        given = pair._replace(hypothesis=shown, hypothesis_present=torch.tensor([float(present)]))
        network.joint_stage(given, torch.Generator().manual_seed(0), masking=False, completion=False)
        assert [each.tolist() for each in seen[-2:]] == [[expected], [expected]]


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
    with pytest.raises(trainer.DivergedError, match="the loss is nan at step 1, pairs 2 to 3"):
        run(shapes, tmp_path, resume=True)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_resuming_needs_a_sound_checkpoint_of_the_same_settings(shapes, tmp_path):
    with pytest.raises(InputError, match="no checkpoint to resume from"):
        run(shapes, tmp_path, resume=True)
    run(shapes, tmp_path, minutes=0.0)
    other = dataclasses.replace(CONFIG, schedule=dataclasses.replace(SCHEDULE, joint_rate=0.5))
    with pytest.raises(
        InputError, match=r"made with other settings \(schedule.joint_rate: 0.0008, now 0.5\)"
    ):
        run(shapes, tmp_path, config=other, resume=True)
    (tmp_path / "checkpoint.pt").write_bytes(b"garbage")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        run(shapes, tmp_path, resume=True)


def test_a_checkpoint_that_does_not_say_where_it_began_is_resumed(shapes, tmp_path):
    run(shapes, tmp_path, minutes=0.0)
    state = read_checkpoint(tmp_path / "checkpoint.pt")
    del state["start"], state["before"]
    write_checkpoint(tmp_path / "checkpoint.pt", state)
    path = run(shapes, tmp_path, resume=True)
    assert read_checkpoint(tmp_path / "checkpoint.pt")["pairs"] == total_pairs(SCHEDULE)
    assert load_weights(str(path))[1]["runs"][-1]["start"] == "unknown"


def test_batches_depend_on_seed_and_number_alone(shapes):
    def points(seed, number):
        pairs = SynthesisedPairs(shapes, PairSettings(), seed, 6)
        return pairs[Batch(number, 2, 60, 80)].source.points

    assert torch.equal(points(1, 5), points(1, 5))
    assert points(1, 5).shape != points(1, 6).shape or not torch.equal(points(1, 5), points(1, 6))
    assert points(1, 5).shape != points(2, 5).shape or not torch.equal(points(1, 5), points(2, 5))


def test_a_pair_is_the_same_in_whatever_batch(shapes):
    pairs = SynthesisedPairs(shapes, PairSettings(), 1, 6)
    both, second = pairs[Batch(4, 2, 70, 70)], pairs[Batch(5, 1, 70, 70)]
    count = second.source.points.shape[1]
    assert torch.equal(both.source.points[1, :count], second.source.points[0])
    assert torch.equal(both.gt_T_target_source[1], second.gt_T_target_source[0])
    if both.source.valid is not None:
        assert both.source.valid[1].sum() == count


def test_each_pair_is_shown_as_often_as_asked_whatever_the_start():
    def batches(start, share=(0, 1)):
        return list(BatchOrder(start, 4 * BLOCK, 6, 2, lambda shown: (50, 50 + shown), share))

    everything = batches(0)
    numbers = [batch.first for batch in everything]
    block = list(range(0, 6 * BLOCK, 6))
    assert numbers == [*block, *block, *(n + 6 * BLOCK for n in block), *(n + 6 * BLOCK for n in block)]
    assert everything[: 2 * BLOCK][BLOCK:] == everything[:BLOCK]  # shown again with the same settings
    assert batches(37) == everything[37:]
    shares = [batches(0, (rank, 3)) for rank in range(3)]
    for whole, *parts in zip(everything, *shares, strict=True):  # every pair is in one share
        assert [batch.first for batch in parts] == [whole.first, whole.first + 2, whole.first + 4]
        assert all(batch.count == 2 and batch.most == whole.most for batch in parts)


def test_the_rate_warms_up_and_falls_in_each_stage():
    schedule = Schedule(descriptor_pairs=1000, joint_pairs=1000)
    rates = [learning_rate(schedule, pairs) for pairs in range(2000)]
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
        ("[optimizer]\nlr = 1", r"unknown section optimizer; known: model, loss, schedule, pairs"),
        ("[pairs]\nbands = 0.5", r"bands is 0.5; expected tuple"),
        ("[schedule]\nbatch = 'two'", r"batch is 'two'; expected int"),
        ("model = [", "not valid TOML"),
        ("[schedule]\noptimiser = 'adam'", "optimiser is 'adam'; choose adamw, sgd"),
        ("[schedule]\nbatch = 3", "descriptor_pairs is 8000; give a multiple of batch 3"),
        ("[schedule]\nvariance_pairs = -1", "variance_pairs is -1; it must be at least 0"),
        (
            "[model]\nhypothesis = false\n[schedule]\nvariance_pairs = 240",
            r"mine\.toml: variance_pairs needs .* hypothesis true; set it to 0",
        ),
        (
            '[model]\nuncertainty_scheme = "sampled"\n[schedule]\nvariance_pairs = 240',
            'variance_pairs needs uncertainty_scheme "matched"',
        ),
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


def test_a_configuration_survives_being_written_as_json():
    config = read_training_config("default")
    assert training_config_from(json.loads(json.dumps(config.as_dict())), "test") == config


def test_the_papers_rate_falls_in_steps():
    schedule = Schedule(descriptor_pairs=0, joint_pairs=1000, rate_steps=(0.6, 0.7), joint_rate=1e-3)
    rates = [learning_rate(schedule, pairs) for pairs in (300, 599, 600, 699, 700, 999)]
    assert rates == pytest.approx([1e-3, 1e-3, 2e-4, 2e-4, 4e-5, 4e-5])


def test_pairs_made_on_the_device_train_resume_and_repeat(shapes, tmp_path):
    run(shapes, tmp_path / "whole", synthesis="device")
    run(shapes, tmp_path / "parts", synthesis="device", minutes=0.0)
    run(shapes, tmp_path / "parts", synthesis="device", resume=True)
    whole, parts = (read_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    assert whole["pairs"] == 8
    for name, value in whole["model"].items():
        assert torch.equal(value, parts["model"][name]), name
