from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from utopic_cli.commands.train import describe, load_library
from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.training.config import read_training_config


@pytest.fixture(scope="module")
def library():
    return procedural_shapes(np.random.default_rng(0), 10)


@pytest.fixture
def trainer(monkeypatch, library):
    calls = []

    def train(config, training_shapes, validation_shapes, out, **options):
        calls.append(
            {"config": config, "train": training_shapes, "val": validation_shapes, "out": out, **options}
        )
        options["progress"]({"pairs": 8, "of": 100, "stage": "joint", "elapsed_s": 90.0, "loss": 0.5})
        return out / "utopic.safetensors"

    monkeypatch.setattr("utopic_cli.training.trainer.train", train)
    monkeypatch.setattr(
        "utopic_cli.synthesis.shapes.procedural_shapes", lambda rng, count, resolution: library
    )
    return calls


def test_options_reach_the_trainer(cli, trainer, tmp_path):
    out = tmp_path / "run"
    result = cli("train", "--out", out, "--minutes", 2, "--resume", "--device", "cpu", "--config", "paper")
    assert result.exit_code == 0, result.output
    (call,) = trainer
    assert call["config"] == read_training_config("paper")
    assert (call["minutes"], call["resume"], call["out"], str(call["device"])) == (2.0, True, out, "cpu")
    assert len(call["train"]) == 9 and len(call["val"]) == 1
    assert "8/100 pairs, joint, 1.5 min, loss 0.5" in result.stderr
    assert str(out / "utopic.safetensors") in result.stderr


@pytest.mark.parametrize("name", ["checkpoint.pt", "utopic.safetensors", "utopic.json"])
def test_a_run_that_is_there_is_not_overwritten(cli, trainer, tmp_path, name):
    (tmp_path / name).write_bytes(b"hours of work")
    result = cli("train", "--out", tmp_path)
    assert result.exit_code == 5
    assert "--resume" in result.stderr
    assert not trainer
    assert cli("train", "--out", tmp_path, "--resume").exit_code == 0


@pytest.mark.parametrize("content", ["[model\n", "[model]\nheads = 'many'\n", "[model]\nhaeds = 4\n"])
def test_a_configuration_that_cant_be_used_exits_4(cli, trainer, tmp_path, content):
    (tmp_path / "c.toml").write_text(content)
    result = cli("train", "--out", tmp_path / "run", "--config", tmp_path / "c.toml")
    assert result.exit_code == 4
    assert len(result.stderr.splitlines()) == 1
    assert "c.toml" in result.stderr


def test_shapes_that_are_not_there_exit_4(cli, trainer, tmp_path):
    assert cli("train", "--out", tmp_path / "run", "--data", tmp_path / "nothing").exit_code == 4


def test_procedural_shapes_are_the_same_every_time(monkeypatch):
    monkeypatch.setattr("utopic_cli.commands.train.PROCEDURAL_SHAPES", 3)
    first, second = load_library("procedural"), load_library("procedural")
    assert (first.vertices == second.vertices).all()


@pytest.mark.parametrize("place", ["file", "file/run", "file/deeper/run"])
def test_out_must_be_a_folder(cli, trainer, tmp_path, place):
    (tmp_path / "file").write_text("")
    result = cli("train", "--out", Path(tmp_path, place))
    assert result.exit_code == 5, result.output
    assert len(result.stderr.splitlines()) == 1
    assert not trainer


def test_a_record_is_one_line():
    record = {"pairs": 1, "of": 2, "stage": "descriptor", "elapsed_s": 6.0, "pairs_per_s": 3.21}
    assert describe(record) == "1/2 pairs, descriptor, 0.1 min, pairs_per_s 3.21"
