from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from utopic_cli.commands.console import Console
from utopic_cli.commands.training_view import TrainingView, clock, describe
from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.training.config import read_training_config
from utopic_cli.training.pace import InterruptedRun

RECORD = {
    "pairs": 8,
    "of": 100,
    "stage": "joint",
    "elapsed_s": 90.0,
    "left_s": 3700.0,
    "rate": 0.001,
    "pairs_per_s": 3.2,
    "waiting": 0.125,
    "overlap": 0.5,
}


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
        options["progress"](RECORD)
        options["progress"]({**RECORD, "pairs": 10, "hit_rate": 0.25})
        options["progress"]({**RECORD, "pairs": 12, "hit_rate": 0.375})
        out.mkdir(exist_ok=True)
        (out / "curves.html").write_text("")
        return out / "utopic.safetensors"

    monkeypatch.setattr("utopic_cli.training.trainer.train", train)
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress: library)
    return calls


def test_options_reach_the_trainer(cli, trainer, tmp_path):
    out = tmp_path / "run"
    result = cli("train", "--out", out, "--minutes", 2, "--resume", "--device", "cpu", "--config", "paper")
    assert result.exit_code == 0, result.output
    (call,) = trainer
    assert call["config"] == read_training_config("paper")
    assert (call["minutes"], call["resume"], call["out"], str(call["device"])) == (2.0, True, out, "cpu")
    assert len(call["train"]) == 9 and len(call["val"]) == 1


def test_the_hint_to_calibrate_names_the_run_s_own_shapes(cli, trainer, tmp_path):
    result = cli("train", "--data", tmp_path / "my shapes", "--out", tmp_path / "run")
    weights = tmp_path / "run" / "utopic.safetensors"
    assert f"utopic calibrate {weights} --data '{tmp_path}/my shapes'" in result.stderr


def test_where_there_is_no_terminal_each_record_is_a_plain_line(cli, trainer, tmp_path):
    out = tmp_path / "run"
    result = cli("train", "--out", out)
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    common = "joint, 1:30, about 1:01:40 left, pairs/s 3.2, waiting for pairs 12.5 %"
    assert f"8/100 pairs, {common}, overlap 0.5" in lines
    assert f"10/100 pairs, {common}, overlap 0.5, hit rate 25.0 %" in lines
    assert f"12/100 pairs, {common}, overlap 0.5, hit rate 37.5 % ▲12.5" in lines
    assert lines[-5:] == [
        "12 pairs seen; hit rate 37.5 % (at first 25.0 %)",
        f"wrote {out}/utopic.safetensors; use it: utopic align SOURCE TARGET --weights "
        f"{out}/utopic.safetensors",
        f"so that it chooses well among poses: utopic teach {out}/utopic.safetensors",
        f"so that its answers can be trusted: utopic calibrate {out}/utopic.safetensors",
        f"curves: {out}/curves.html",
    ]
    assert "\x1b" not in result.stderr


def test_an_interrupted_run_says_what_it_saved(cli, trainer, tmp_path, monkeypatch):
    def stop(config, training_shapes, validation_shapes, out, **options):
        raise InterruptedRun(out / "utopic.safetensors")

    monkeypatch.setattr("utopic_cli.training.trainer.train", stop)
    out = tmp_path / "run"
    result = cli("train", "--out", out)
    assert result.exit_code == 130
    assert result.stderr.splitlines()[-2:] == [
        f"saved {out}/checkpoint.pt and exported {out}/utopic.safetensors; go on: the same with --resume",
        "utopic: interrupted",
    ]


def test_quiet_says_nothing(cli, trainer, tmp_path):
    assert cli("train", "--out", tmp_path / "run", "--quiet").stderr == ""


def test_of_several_processes_one_speaks(cli, trainer, tmp_path, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    assert cli("train", "--out", tmp_path / "run").stderr == ""
    monkeypatch.setenv("RANK", "0")
    assert cli("train", "--out", tmp_path / "run").stderr != ""


class Terminal(io.StringIO):
    def isatty(self):
        return True


def shown(monkeypatch, columns=100, **environment):
    """Return what a terminal of that width gets when three records are shown."""
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    for name, value in {"TERM": "xterm-256color", "COLUMNS": str(columns), **environment}.items():
        monkeypatch.setenv(name, value)
    with TrainingView(Console()) as view:
        view.show({**RECORD, "hit_rate": 0.25})
        view.show({**RECORD, "pairs": 10, "hit_rate": 0.125, "match_rate": 0.5})
        view.show({**RECORD, "pairs": 50})
    return stream.getvalue()


def test_a_terminal_shows_the_last_record_and_the_last_validation(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    text = shown(monkeypatch)
    assert "\x1b[33m" in text and "▼12.5" in text  # worse than the one before
    plain = shown(monkeypatch, NO_COLOR="1")
    assert "\x1b[33m" not in plain and "▼12.5" in plain
    for part in ("joint stage", "50/100 pairs", "1:30, about 1:01:40 left", "3.2 pairs/s"):
        assert part in plain, part
    assert "overlap\N{NO-BREAK SPACE}0.5" in plain and "match\N{NO-BREAK SPACE}rate" in plain


@pytest.mark.parametrize("columns", [40, 60, 200])
def test_the_view_fits_the_terminal(monkeypatch, columns):
    import re

    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown(monkeypatch, columns, NO_COLOR="1"))
    assert max(len(line) for line in re.split(r"[\r\n]+", plain)) <= columns


@pytest.mark.parametrize("name", ["checkpoint.pt", "utopic.safetensors", "utopic.json"])
def test_a_run_that_is_there_is_not_overwritten(cli, trainer, tmp_path, name):
    (tmp_path / name).write_bytes(b"hours of work")
    result = cli("train", "--out", tmp_path)
    assert result.exit_code == 5
    assert "--resume" in result.stderr
    assert not trainer
    assert cli("train", "--out", tmp_path, "--resume").exit_code == 0


@pytest.mark.parametrize(
    "content", ["[model\n", "[model]\nheads = 'many'\n", "[model]\nhaeds = 4\n", "[model]\nheads = 3\n"]
)
def test_a_configuration_that_cant_be_used_exits_4(cli, trainer, tmp_path, content):
    (tmp_path / "c.toml").write_text(content)
    result = cli("train", "--out", tmp_path / "run", "--config", tmp_path / "c.toml")
    assert result.exit_code == 4
    assert len(result.stderr.splitlines()) == 1
    assert "c.toml" in result.stderr


@pytest.mark.parametrize("data", ["nothing", "empty", "modelnet40:nothing"])
def test_shapes_that_are_not_there_exit_4(cli, tmp_path, monkeypatch, data):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    result = cli("train", "--out", tmp_path / "run", "--data", data)
    assert result.exit_code == 4, result.output
    assert data.split(":")[-1] in result.stderr.splitlines()[-1]
    assert not (tmp_path / "run").exists()


def test_skipped_shapes_are_counted_and_named(cli, trainer, tmp_path, monkeypatch, library):
    skipped = replace(library, skipped=(("bad.ply", "it has no faces"),))
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress: skipped)
    result = cli("train", "--out", tmp_path / "run", "--data", tmp_path)
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.stderr.splitlines() if "warning" in line]
    assert line.startswith("utopic: warning: skipped 1 shape") and "bad.ply: it has no faces" in line
    again = cli("train", "--out", tmp_path / "run", "--data", tmp_path, "--resume").stderr
    assert "warning" not in again and "skipped 1 shape" in again.splitlines()


@pytest.mark.parametrize("place", ["file", "file/run", "file/deeper/run"])
def test_out_must_be_a_folder(cli, trainer, tmp_path, place):
    (tmp_path / "file").write_text("")
    result = cli("train", "--out", Path(tmp_path, place))
    assert result.exit_code == 5, result.output
    assert len(result.stderr.splitlines()) == 1
    assert not trainer


def test_a_record_is_one_line():
    record = {"pairs": 1, "of": 2, "stage": "descriptor", "elapsed_s": 6.0, "pairs_per_s": 3.21}
    assert describe(record) == "1/2 pairs, descriptor, 0:06, pairs/s 3.21"


def test_a_budget_that_ends_the_run_is_told_as_such():
    budget = {**RECORD, "of": 14500, "left_s": 12.0}
    assert "1:30, stops in 0:12, " in describe(budget)


def test_settings_that_ship_are_named_in_the_help(cli):
    text = " ".join(cli("train", "--help").stdout.replace("│", " ").split())
    assert "Settings: default, paper, variants, or a file" in text


def test_durations():
    assert [clock(seconds) for seconds in (-3, 59.6, 3599, 3600)] == ["0:00", "1:00", "59:59", "1:00:00"]


@pytest.mark.parametrize(
    ("before", "after", "arrow"), [(0.25, 0.5, " ▲25.0"), (0.5, 0.25, " ▼25.0"), (0.5, 0.50001, " unchanged")]
)
def test_the_change_of_a_validation_is_told(before, after, arrow):
    line = describe({**RECORD, "hit_rate": after}, {"hit_rate": before})
    assert line.endswith(f"hit rate {100 * after:.1f} %{arrow}")
