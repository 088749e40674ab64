from __future__ import annotations

import json

import numpy as np
import pytest

from utopic_cli.benchmark import synthetic
from utopic_cli.benchmark.curves import CurveProtocol, SweepProtocol
from utopic_cli.benchmark.protocols import CropProtocol, RangeProtocol
from utopic_cli.benchmark.scans import Report as ScansReport
from utopic_cli.benchmark.speed_report import SpeedReport
from utopic_cli.synthesis.shapes import pack


@pytest.fixture
def protocol_run(monkeypatch):
    calls = []

    def run(protocol, shapes, data, **options):
        calls.append({"protocol": protocol, "data": data, **options})
        settings = {
            "protocol": protocol.settings(), "data": data, "split": "val", "shapes": 1,
            "pairs": options["pairs"], "seed": options["seed"],
        }  # fmt: skip
        kind = synthetic.CurveReport if "levels" in settings["protocol"] else synthetic.Report
        return kind(settings, protocol.groups, ())

    monkeypatch.setattr(synthetic, "run", run)
    monkeypatch.setattr(
        "utopic_cli.synthesis.packing.open_shapes",
        lambda data, progress: pack([(np.eye(3), np.array([[0, 1, 2]]))], ["a"], ["val"], ["one"]),
    )
    return calls


@pytest.mark.parametrize(
    ("arguments", "protocol"),
    [
        (["overlap-sweep"], SweepProtocol()),
        (
            ["overlap-sweep", "--sampling", "independent"],
            SweepProtocol(sampling="independent", rotations="uniform"),
        ),
        *([[name], CurveProtocol(name=name)] for name in ("noise", "density", "outliers", "rotation")),
        (["modelnet"], CropProtocol("modelnet", 0.7, "shared", "euler45")),
        (["modelonet"], CropProtocol("modelonet", 0.5, "shared", "euler45")),
        (["range-scans"], RangeProtocol()),
    ],
)
def test_each_protocol_writes_its_files(cli, protocol_run, tmp_path, arguments, protocol):
    files = {name: tmp_path / f"r.{name}" for name in ("json", "html")}
    result = cli(
        "bench", *arguments, "--pairs", 4, "--seed", 9, "--data", "shapes", "--workers", 2, "--points", 500,
        "--device", "cpu", "--json", files["json"], "--html", files["html"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    (call,) = protocol_run
    assert call["protocol"] == protocol
    assert (call["data"], call["pairs"], call["seed"], call["workers"], call["points"]) == (
        "shapes",
        4,
        9,
        2,
        500,
    )
    assert json.loads(files["json"].read_text())["protocol"]["name"] == protocol.name
    page = files["html"].read_text()
    assert page.startswith("<!doctype html>") and "<svg" in page and protocol.name in page
    assert protocol.name in result.stdout


@pytest.mark.parametrize("name", ["overlap-sweep", "noise", "density", "outliers", "rotation"])
def test_what_the_curves_cant_use(cli, protocol_run, tmp_path, monkeypatch, name):
    (tmp_path / "r.html").write_text("precious")
    assert cli("bench", name, "--html", tmp_path / "r.html").exit_code == 5
    result = cli("bench", name, "--baselines", "magic")
    assert result.exit_code == 2 and "'magic'" in result.stderr
    monkeypatch.undo()
    result = cli("bench", name, "--data", tmp_path / "nothing")
    assert result.exit_code == 4 and "nothing" in result.stderr and len(result.stderr.splitlines()) == 1
    assert not protocol_run and (tmp_path / "r.html").read_text() == "precious"


def test_scans_write_a_page_too(cli, monkeypatch, tmp_path):
    monkeypatch.setattr(
        "utopic_cli.benchmark.scans.run",
        lambda directory, **asked: ScansReport({"directory": "a<b", "poses": 3, "seed": 0}, ()),
    )
    result = cli("bench", "scans", tmp_path, "--html", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    assert "<svg" in (tmp_path / "r.html").read_text() and "a&lt;b" in (tmp_path / "r.html").read_text()


def test_speed_hands_its_options_on(cli, protocol_run, monkeypatch, tmp_path):
    calls = []

    def run(shapes, *asked):
        calls.append(asked[:-1])
        settings = {
            "weights": "utopic", "weights_sha256": "0" * 64, "data": "shapes", "split": "val", "shapes": 1,
            "pairs": 2, "seed": 4, "points": [60],
        }  # fmt: skip
        return SpeedReport(settings, ())

    monkeypatch.setattr("utopic_cli.benchmark.speed.run", run)
    asked = (
        "--data",
        "shapes",
        "--pairs",
        2,
        "--points",
        "60, 90",
        "--batches",
        "1,2,8",
        "--baselines",
        "open3d-ransac",
        "--seed",
        4,
    )
    result = cli("bench", "speed", *asked, "--device", "cpu", "--html", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    assert calls == [("shapes", 2, 4, "utopic", [60, 90], [1, 2, 8], ["open3d-ransac"], "cpu")]
    assert "<svg" in (tmp_path / "r.html").read_text() and "Whole alignments" in result.stdout
    for option in ("--points", "--batches"):
        result = cli("bench", "speed", option, "60,many")
        assert result.exit_code == 2 and f"{option} 60,many" in result.stderr
