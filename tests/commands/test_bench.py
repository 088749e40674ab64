from __future__ import annotations

import json

import numpy as np
import pytest

from utopic_cli.benchmark import synthetic
from utopic_cli.benchmark.protocols import CropProtocol, RangeProtocol
from utopic_cli.benchmark.scans import Report
from utopic_cli.config import AlignOptions
from utopic_cli.synthesis.shapes import pack


@pytest.fixture
def protocol(monkeypatch):
    calls = []

    def run(directory, **options):
        calls.append({"directory": directory, **options})
        options["progress"](0, 1, "utopic: a -> b")
        return Report({"directory": str(directory), "poses": options["poses"], "seed": options["seed"]}, ())

    monkeypatch.setattr("utopic_cli.benchmark.scans.run", run)
    return calls


def test_options_reach_the_protocol_and_its_report_the_file(cli, protocol, tmp_path):
    result = cli(
        "bench", "scans", tmp_path, "--pairs", 4, "--poses", 2, "--seed", 9, "--min-overlap", 0.3,
        "--baselines", "open3d-ransac, open3d-fgr", "--json", tmp_path / "r.json", "--threads", 1,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    (call,) = protocol
    assert call["baselines"] == ["open3d-ransac", "open3d-fgr"]
    assert (call["pairs"], call["poses"], call["seed"], call["min_overlap"]) == (4, 2, 9, 0.3)
    assert call["options"] == AlignOptions(threads=1, seed=9)
    assert json.loads((tmp_path / "r.json").read_text())["seed"] == 9
    assert "overlap" in result.stdout


def test_an_output_that_cant_be_written_exits_5_before_any_work(cli, protocol, tmp_path):
    assert cli("bench", "scans", tmp_path, "--json", tmp_path / "none" / "r.json").exit_code == 5
    (tmp_path / "r.json").write_text("precious")
    assert cli("bench", "scans", tmp_path, "--json", tmp_path / "r.json").exit_code == 5
    assert not protocol


def test_a_folder_without_known_answers_exits_4(cli, tmp_path):
    result = cli("bench", "scans", tmp_path)
    assert result.exit_code == 4
    assert "gt.json" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_an_unknown_baseline_exits_2(cli, tmp_path):
    result = cli("bench", "scans", tmp_path, "--baselines", "magic")
    assert result.exit_code == 2
    assert "open3d-ransac" in result.stderr


@pytest.fixture
def synthetic_run(monkeypatch):
    calls = []

    def run(protocol, shapes, data, **options):
        calls.append({"protocol": protocol, "data": data, **options})
        options["progress"](0, options["pairs"], protocol.name)
        settings = {
            "protocol": protocol.settings(), "data": data, "split": "val", "shapes": 1,
            "pairs": options["pairs"], "seed": options["seed"],
        }  # fmt: skip
        return synthetic.Report(settings, protocol.groups, ())

    monkeypatch.setattr("utopic_cli.benchmark.synthetic.run", run)
    monkeypatch.setattr(
        "utopic_cli.synthesis.packing.open_shapes",
        lambda data, progress: pack([(np.eye(3), np.array([[0, 1, 2]]))], ["a"], ["val"], ["one"]),
    )
    return calls


@pytest.mark.parametrize(
    ("arguments", "protocol"),
    [
        (["modelnet"], CropProtocol("modelnet", 0.7, "shared", "euler45")),
        (["modelonet"], CropProtocol("modelonet", 0.5, "shared", "euler45")),
        (["modelnet", "--sampling", "independent"], CropProtocol("modelnet", 0.7, "independent", "uniform")),
        (["modelnet", "--rotations", "uniform"], CropProtocol("modelnet", 0.7, "shared", "uniform")),
        (["range-scans"], RangeProtocol()),
    ],
)
def test_each_protocol_is_a_command(cli, synthetic_run, tmp_path, arguments, protocol):
    result = cli(
        "bench", *arguments, "--pairs", 4, "--weights", "utopic", "--weights", "b.safetensors", "--seed", 9,
        "--data", "shapes", "--workers", 2, "--points", 500, "--device", "cpu", "--json", tmp_path / "r.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    (call,) = synthetic_run
    assert call["protocol"] == protocol
    assert (call["data"], call["pairs"], call["seed"], call["workers"], call["points"], call["device"]) == (
        "shapes", 4, 9, 2, 500, "cpu",
    )  # fmt: skip
    assert (call["weights"], call["baselines"]) == (["utopic", "b.safetensors"], [])
    assert json.loads((tmp_path / "r.json").read_text())["protocol"]["name"] == protocol.name
    assert protocol.name in result.stdout


def test_bundled_weights_are_measured_if_none_are_named(cli, synthetic_run):
    assert cli("bench", "range-scans").exit_code == 0
    assert (synthetic_run[0]["weights"], synthetic_run[0]["data"]) == (["utopic"], "procedural")


@pytest.mark.parametrize("name", ["modelnet", "modelonet", "range-scans"])
def test_what_synthetic_protocols_cant_use(cli, synthetic_run, tmp_path, monkeypatch, name):
    (tmp_path / "r.json").write_text("precious")
    assert cli("bench", name, "--json", tmp_path / "r.json").exit_code == 5
    result = cli("bench", name, "--baselines", "fpfh,magic")
    assert result.exit_code == 2 and "'magic'" in result.stderr and "fpfh" in result.stderr
    monkeypatch.undo()
    result = cli("bench", name, "--data", tmp_path / "nothing")
    assert result.exit_code == 4 and "nothing" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not synthetic_run


def test_shapes_without_any_held_out_exit_4(cli, tmp_path, monkeypatch):
    library = pack([(np.eye(3), np.array([[0, 1, 2]]))], ["a"], ["train"], ["one"])
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress: library)
    result = cli("bench", "modelnet")
    assert result.exit_code == 4 and "no 'val' shapes" in result.stderr
