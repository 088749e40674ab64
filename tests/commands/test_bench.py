from __future__ import annotations

import json

import numpy as np
import pytest

from utopic_cli.benchmark import synthetic
from utopic_cli.benchmark.protocols import CropProtocol, RangeProtocol, RoomProtocol
from utopic_cli.benchmark.scans import Report
from utopic_cli.commands.bench import PANELS
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
        (["detail"], CropProtocol("detail", 0.7, "shared", "euler45", 5000, 0.0)),
        (["detail", "--relief"], CropProtocol("detail", 0.7, "shared", "euler45", 5000, 0.04)),
        (["scanobjectnn"], CropProtocol("scanobjectnn", 0.7, "shared", "euler45")),
        (["range-scans"], RangeProtocol()),
        (["rooms"], RoomProtocol()),
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
    data = "scanobjectnn:shapes" if protocol.name == "scanobjectnn" else "shapes"
    assert (call["data"], call["pairs"], call["seed"], call["workers"], call["points"], call["device"]) == (
        data, 4, 9, 2, 500, "cpu",
    )  # fmt: skip
    assert (call["weights"], call["baselines"]) == (["utopic", "b.safetensors"], [])
    assert json.loads((tmp_path / "r.json").read_text())["protocol"]["name"] == protocol.name
    assert protocol.name in result.stdout


def test_bundled_weights_are_measured_if_none_are_named(cli, synthetic_run):
    assert cli("bench", "range-scans").exit_code == 0
    assert (synthetic_run[0]["weights"], synthetic_run[0]["data"]) == (["utopic"], "procedural")


def test_built_in_shapes_get_relief_for_detail_unless_told_not_to(cli, synthetic_run):
    assert cli("bench", "detail").exit_code == 0
    assert cli("bench", "detail", "--no-relief").exit_code == 0
    assert [call["protocol"].relief for call in synthetic_run] == [0.04, 0.0]


def test_scanobjectnn_without_its_file(cli, tmp_path):
    assert cli("bench", "scanobjectnn").exit_code == 2
    result = cli("bench", "scanobjectnn", "--data", tmp_path)
    assert result.exit_code == 4 and len(result.stderr.splitlines()) == 1
    assert "no test_objectdataset.h5" in result.stderr and "hkust-vgd" in result.stderr


def test_modelnet40_without_its_files(cli, tmp_path):
    result = cli("bench", "modelnet", "--data", f"modelnet40:{tmp_path}")
    assert result.exit_code == 4 and len(result.stderr.splitlines()) == 1
    assert "ply_data_test*.h5" in result.stderr and "modelnet40_ply_hdf5_2048.zip" in result.stderr


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"source": "gone.ply", "target": "b.ply"}, "pairs[0]: its source 'gone.ply' is not a file"),
        (
            {"source": "a.ply", "target": "b.ply", "T_target_source": np.diag([2.0, 2, 2, 1]).tolist()},
            "pairs[0] (a.ply -> b.ply): T_target_source is no rigid transformation",
        ),
    ],
    ids=["missing scan", "scaled"],
)
def test_an_answer_that_cant_be_used_exits_4_and_is_named(cli, scans, entry, words):
    folder = scans[0].parent
    (folder / "gt.json").write_text(json.dumps({"pairs": [entry]}))
    result = cli("bench", "scans", folder)
    assert result.exit_code == 4 and len(result.stderr.splitlines()) == 1
    assert f"{folder / 'gt.json'}: {words}" in result.stderr


def test_every_protocol_has_its_place_in_the_help(cli):
    said = cli("bench", "--help").stdout
    for title, members in PANELS.items():
        assert title in said
        assert all(name in said for name in members)


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
