from __future__ import annotations

import json

import numpy as np
import pytest

from utopic_cli.benchmark import trust
from utopic_cli.benchmark.trust_report import Outcome
from utopic_cli.config import AlignOptions
from utopic_cli.synthesis.shapes import pack


@pytest.fixture
def protocol(monkeypatch):
    calls = []

    def run(data, pairs, seed, options, workers, progress):
        calls.append({"data": data, "pairs": pairs, "seed": seed, "options": options, "workers": workers})
        progress(0, 1, "confidence")
        settings = {
            "kinds": ["room"], "data": str(data), "seed": seed,
            "weights_name": "utopic", "weights_sha256": "0" * 64,
        }  # fmt: skip
        room = Outcome(0, "room", "room", 0.5, 10, 10, True, True, 0.95, True, (), 1.0, 0.01, 0.5)
        return trust.TrustReport(settings, (room,))

    monkeypatch.setattr(trust, "run", lambda shapes, *asked: run(*asked))
    monkeypatch.setattr(trust, "run_folder", run)
    monkeypatch.setattr(
        "utopic_cli.synthesis.packing.open_shapes",
        lambda data, progress: pack([(np.eye(3), np.array([[0, 1, 2]]))], ["a"], ["val"], ["one"]),
    )
    return calls


def test_options_reach_the_protocol_and_its_report_the_files(cli, protocol, tmp_path):
    result = cli(
        "bench", "confidence", "--data", "shapes", "--pairs", 7, "--seed", 3, "--workers", 2, "--points", 300,
        "--device", "cpu", "--json", tmp_path / "r.json", "--html", tmp_path / "r.html",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    (call,) = protocol
    assert (call["data"], call["pairs"], call["seed"], call["workers"]) == ("shapes", 7, 3, 2)
    assert call["options"] == AlignOptions(points=300, device="cpu", seed=3)
    assert json.loads((tmp_path / "r.json").read_text())["trials"][0]["kind"] == "room"
    assert "<svg" in (tmp_path / "r.html").read_text()
    assert "AUROC" in result.stdout and "room" in result.stdout


def test_a_folder_of_real_scans_takes_the_place_of_shapes(cli, protocol, tmp_path):
    assert cli("bench", "confidence", "--folder", tmp_path).exit_code == 0
    assert cli("bench", "confidence").exit_code == 0
    assert [(call["data"], call["pairs"]) for call in protocol] == [(tmp_path, None), ("procedural", 300)]


def test_files_that_exist_exit_5_before_any_work(cli, protocol, tmp_path):
    (tmp_path / "r.html").write_text("precious")
    assert cli("bench", "confidence", "--html", tmp_path / "r.html").exit_code == 5
    same = tmp_path / "r.json"
    assert cli("bench", "confidence", "--html", same, "--json", same).exit_code == 5
    assert not protocol and (tmp_path / "r.html").read_text() == "precious"
    assert cli("bench", "confidence", "--html", tmp_path / "r.html", "--overwrite").exit_code == 0


def test_shapes_without_any_held_out_exit_4(cli, monkeypatch):
    library = pack([(np.eye(3), np.array([[0, 1, 2]]))], ["a"], ["train"], ["one"])
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress: library)
    result = cli("bench", "confidence")
    assert result.exit_code == 4 and "no 'val' shapes" in result.stderr
