from __future__ import annotations

import json

import pytest

from utopic_cli.benchmark.scans import Report
from utopic_cli.config import AlignOptions


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
