"""``utopic bench ablation, attention, uncertainty``: one budget for all, nothing done twice."""

from __future__ import annotations

import json
import os
import signal
from functools import partial

import numpy as np
import pytest

from utopic_cli.benchmark import variants
from utopic_cli.benchmark.pair_metrics import MatchMeasures, OverlapMeasures, PoseMeasures
from utopic_cli.benchmark.variant_pairs import PairResult
from utopic_cli.model.utopic import Utopic
from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.training import trainer
from utopic_cli.training.checkpoint import read_checkpoint
from utopic_cli.training.run import export, total_pairs

TINY = """
[model]
patch_width = 8
channels = [8, 8, 16, 16]
adaptive_hidden = 8
kernel_rank = 8
neighbours = 6
feature_width = 16
descriptor_width = 8
transformer_width = 16
heads = 2
layers = 1
uncertainty_samples = 5
hypothesis = false
uncertainty_scheme = "sampled"
[schedule]
descriptor_pairs = 2
joint_pairs = 4
points = [60, 80]
last_points = [60, 80]
masking_from = 0.25
validation_pairs = 1
[pairs]
kinds = [0.0, 0.0, 1.0, 0.0]
surface_points = [150, 150]
"""


RECORD = {"of": 4, "stage": "joint", "elapsed_s": 2.0, "left_s": 0.0, "pairs_per_s": 2.0}
REAL_TRAIN = trainer.train


@pytest.fixture(scope="module")
def library():
    return procedural_shapes(np.random.default_rng(0), 10)


@pytest.fixture
def trained(monkeypatch, library, tmp_path):
    """Export untrained networks, and answer the test pairs by a formula; returns the folders trained."""
    folders = []

    def train(config, training, validation, out, *, progress, start_from=None, **options):
        assert set(training.splits) == {"train"} and set(validation.splits) == {"val"}
        folders.append(out.name)
        progress({**RECORD, "pairs": total_pairs(config.schedule)})
        model = Utopic(config.model)
        if start_from is not None:
            model.load_state_dict(start_from)
        out.mkdir(exist_ok=True)
        card = {"pairs_seen": total_pairs(config.schedule), "wall_clock_s": 90.0}
        return export(model, {**card, "runs": [{"training": config.as_dict()}]}, out)

    monkeypatch.setattr("utopic_cli.training.trainer.train", train)
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress: library)
    monkeypatch.setattr("utopic_cli.benchmark.variant_pairs.measure_variant", answers)
    (tmp_path / "tiny.toml").write_text(TINY)
    return folders


def answers(weights, protocol, shapes, data, pairs, **options):
    assert protocol.name == "modelnet" and set(shapes.splits) == {"val"}
    pose = PoseMeasures(2.0, 0.02, (2.0, 0.0, 0.0), (0.02, 0.0, 0.0), True)
    return [
        PairResult(
            number,
            "a",
            MatchMeasures(0.25, 0.5),
            OverlapMeasures(0.75, 1.0, 1.0, 0.5),
            dict.fromkeys(("svd", "auto", "floor"), pose),
        )
        for number in range(pairs)
    ]


@pytest.fixture
def bench(cli, trained, tmp_path):
    """Call a table on the tiny settings with the budget of the tests."""
    common = ("--out", tmp_path / "out", "--config", tmp_path / "tiny.toml", "--device", "cpu", "--pairs", 3)
    return lambda table, *more: cli("bench", table, *common, *more)


@pytest.fixture
def short(monkeypatch):
    """Leave three rows of one table."""
    monkeypatch.setitem(variants.TABLES, "attention", variants.TABLES["attention"][2:])


def names(table):
    return [row.variant for row in variants.TABLES[table]]


def test_the_three_tables_share_a_folder_and_what_they_have_in_common(bench, trained, tmp_path):
    seen: set[str] = set()
    for table in variants.TABLES:
        trained.clear()
        result = bench(
            table, "--train-pairs", 4, *(["--resume"] if seen else []),
            "--json", tmp_path / f"{table}.json", "--html", tmp_path / f"{table}.html",
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        new = [name for name in names(table) if name not in seen]
        assert trained == (new if seen else ["descriptors", *new])
        seen.update(new)
        content = json.loads((tmp_path / f"{table}.json").read_text())
        assert [row["pairs_seen"] for row in content["summary"]] == [4] * len(names(table))
        assert content["budget"] == {"pairs": 4, "descriptor_pairs": 2, "minutes": None, "pairs_per_s": None}
        assert "budget: 4 pairs each" in result.stdout and "(quoted)" in result.stdout
        assert "within noise" in result.stdout
        assert f"{table}, variant 1 of {len(names(table))}" in result.stderr
        assert (tmp_path / f"{table}.html").read_text().startswith("<!doctype html>")

    cards = {name: json.loads((tmp_path / "out" / name / "utopic.json").read_text()) for name in seen}
    schemes = {name: card["model"]["uncertainty_scheme"] for name, card in cards.items()}
    assert (
        schemes["predicted-u"] == "predicted" and schemes["no-u"] == "none" and schemes["full"] == "sampled"
    )
    assert cards["no-masking"]["runs"][0]["training"]["schedule"]["masking_from"] == 1.0
    assert cards["no-u"]["runs"][0]["training"]["loss"]["uncertainty"] == 0.0
    assert cards["no-o-c-u-g"]["model"]["overlap"] is False
    seeds = {name: card["runs"][0]["training"]["schedule"]["seed"] for name, card in cards.items()}
    assert seeds.pop("full-again") == seeds["full"] + 1 and len(set(seeds.values())) == 1
    assert len(cards) == 11


def test_answers_are_kept_for_as_many_pairs(bench, trained, short, monkeypatch):
    assert bench("attention", "--train-pairs", 4).exit_code == 0
    asked = []
    monkeypatch.setattr(
        "utopic_cli.benchmark.variant_pairs.measure_variant",
        lambda *a, **o: asked.append(a[4]) or answers(*a, **o),
    )
    assert bench("attention", "--resume", "--pairs", 2).exit_code == 0 and asked == []
    assert bench("attention", "--resume", "--pairs", 4).exit_code == 0 and asked == [4] * 3


def test_killed_between_variants_it_goes_on_with_the_next(bench, trained, short, monkeypatch):
    def broken(weights, *a, **o):
        if weights.parent.name == "full":
            raise KeyboardInterrupt
        return answers(weights, *a, **o)

    with monkeypatch.context() as patch:
        patch.setattr("utopic_cli.benchmark.variant_pairs.measure_variant", broken)
        assert bench("attention", "--train-pairs", 4).exit_code == 130
    assert trained == ["descriptors", "learned", "full"]
    assert bench("attention", "--resume").exit_code == 0
    assert trained == ["descriptors", "learned", "full", "full-again"]


def test_stopped_within_a_variant_it_goes_on_from_its_checkpoint(
    bench, trained, short, monkeypatch, tmp_path
):
    stopping = [True]

    def train(config, training, validation, out, *, progress, **options):
        def show(record):
            progress(record)
            if stopping and out.name == "learned" and record["pairs"] == 0:
                os.kill(os.getpid(), signal.SIGTERM)

        options = {**options, "workers": 0, "progress": show}
        return REAL_TRAIN(config, training, validation, out, **options)

    def one_is_enough(*a, **o):
        raise KeyboardInterrupt

    monkeypatch.setattr("utopic_cli.training.trainer.train", train)
    monkeypatch.setattr("utopic_cli.benchmark.variant_pairs.measure_variant", one_is_enough)
    out = tmp_path / "out"
    assert bench("attention", "--train-pairs", 4).exit_code == 130
    assert read_checkpoint(out / "learned" / "checkpoint.pt")["pairs"] == 2
    stopping.clear()
    assert bench("attention", "--resume").exit_code == 130
    resumed = json.loads((out / "learned" / "utopic.json").read_text())
    assert resumed["pairs_seen"] == 4
    # The same as if nothing had happened.
    assert bench("attention", "--train-pairs", 4, "--out", tmp_path / "whole").exit_code == 130
    whole = json.loads((tmp_path / "whole" / "learned" / "utopic.json").read_text())
    assert whole["sha256"] == resumed["sha256"]


def test_minutes_become_pairs_that_are_the_same_for_all(bench, trained, short, tmp_path):
    result = bench("attention", "--minutes", 0.5, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "r.json").read_text())
    # Four pairs in two seconds, so 60 in half a minute; the stage before has half as many.
    assert content["budget"] == {"pairs": 60, "descriptor_pairs": 30, "minutes": 0.5, "pairs_per_s": 2.0}
    assert {row["pairs_seen"] for row in content["summary"]} == {60}
    assert "about 0.5 minutes at the 2.00 pairs/s" in " ".join(result.stdout.split())
    trained.clear()
    assert bench("attention", "--minutes", 0.5, "--resume").exit_code == 0 and trained == []
    other = bench("attention", "--minutes", 3, "--resume")
    assert other.exit_code == 4 and "budget.minutes: 0.5, now 3" in other.stderr and trained == []


def test_a_signal_while_the_pace_is_measured_ends_the_command(bench, trained, monkeypatch, tmp_path):
    monkeypatch.setitem(RECORD, "left_s", 30.0)
    assert bench("attention", "--minutes", 10).exit_code == 130
    assert len(trained) == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ((), "no budget"),
        (("--minutes", 1, "--train-pairs", 4), "give one"),
        (("--minutes", 0), "--minutes 0"),
        (("--train-pairs", 3), "a multiple of 2"),
        (("--train-pairs", 4, "--pairs", 1), "--pairs"),
        (("--train-pairs", 4, "--epochs", 3), "--epochs"),
    ],
)
def test_options_that_make_no_sense_exit_2(bench, trained, tmp_path, more, said):
    result = bench("ablation", *more)
    assert result.exit_code == 2 and said in result.stderr.splitlines()[-1]
    assert not trained and not (tmp_path / "out").exists()


def test_folders_that_cant_be_used(bench, trained, tmp_path):
    out = tmp_path / "out"
    refused = partial(bench, "ablation", "--train-pairs", 4)
    result = refused("--resume")
    assert result.exit_code == 4 and "no experiment to resume" in result.stderr
    out.write_text("")
    assert refused().exit_code == 5
    out.unlink()
    out.mkdir()
    (out / "thesis.doc").write_text("years of work")
    result = refused()
    assert result.exit_code == 5 and "thesis.doc" in result.stderr
    for content in ("{", "[]", '{"budget": 1}', '{"budget": {"pairs": -2}, "config": {}, "shapes": {}}'):
        (out / "experiment.json").write_text(content)
        result = refused("--resume")
        assert result.exit_code == 4 and "experiment.json" in result.stderr, content
        assert len([line for line in result.stderr.splitlines() if "error" in line]) == 1
    result = refused()
    assert result.exit_code == 5 and "--resume" in result.stderr
    assert not trained


def test_another_experiment_is_not_gone_on_with(bench, trained, short, tmp_path):
    assert bench("attention", "--train-pairs", 4).exit_code == 0
    trained.clear()
    for more, said in (
        (("--seed", 5), "config.schedule.seed: 0, now 5"),
        (("--train-pairs", 8), "budget.pairs: 4, now 8"),
        (("--data", "elsewhere"), "data: procedural, now elsewhere"),
    ):
        result = bench("attention", "--resume", *more)
        assert result.exit_code == 4 and said in result.stderr, result.stderr
    card = tmp_path / "out" / "learned" / "utopic.json"
    content = json.loads(card.read_text())
    content["runs"][0]["training"]["loss"]["overlap"] = 9.0
    card.write_text(json.dumps(content))
    result = bench("attention", "--resume")
    assert result.exit_code == 4 and "loss.overlap: 9.0, now 1.0" in result.stderr
    assert not trained


def test_variants_need_a_full_network(bench, trained, tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY + "\n[loss]\ncompletion = 0.0\n")
    result = bench("ablation", "--train-pairs", 4)
    assert result.exit_code == 4 and "loss.completion" in result.stderr and not trained


def test_outputs_are_checked_before_any_work(bench, trained, tmp_path):
    (tmp_path / "r.json").write_text("precious")
    result = bench("ablation", "--train-pairs", 4, "--json", tmp_path / "r.json")
    assert result.exit_code == 5 and not trained
