from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tests.multiway.stubs import make_stub
from utopic_cli.config import AlignOptions
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway import batch as room
from utopic_cli.multiway import trial
from utopic_cli.multiway.batch import run_batch
from utopic_cli.multiway.plan import BatchRequest


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Six small scans of two objects, and the batch of a stub that knows the answers."""
    monkeypatch.setattr(trial, "VIEWS", 3)
    monkeypatch.setattr(trial, "POINTS", 300)
    monkeypatch.setattr(trial, "_DENSE", 20_000)
    monkeypatch.setattr(trial, "_RESOLUTION", 32)
    monkeypatch.setattr(room, "_weights", lambda options: {"name": "stub", "sha256": "stub"})
    known = trial.make_scans(tmp_path / "scans", 6, np.random.default_rng(0))
    truth = {
        f"{name}.ply": {"world": one.T_thing_scan.tolist(), "object": one.thing}
        for name, one in known.items()
    }
    (tmp_path / "scans" / "truth.json").write_text(json.dumps(truth))
    outcome = run_batch(BatchRequest((tmp_path / "scans",), tmp_path / "out"), make_task=partial(make_stub))
    return tmp_path / "scans", known, outcome


def test_simulated_scans_lie_on_their_object_and_are_named_in_no_order(made):
    folder, known, _ = made
    assert sorted(known) == [f"scan-{i:05d}" for i in range(6)]
    things = [known[name].thing for name in sorted(known)]
    assert sorted(things) == [0, 0, 0, 1, 1, 1] and things not in ([0, 0, 0, 1, 1, 1], [0, 1] * 3)
    for name, one in known.items():
        points = read_scan(folder / f"{name}.ply").cloud.points
        there = points @ one.T_thing_scan[:3, :3].T + one.T_thing_scan[:3, 3]
        assert np.linalg.norm(there, axis=1).max() < 1.1  # the objects have radius 1


def test_a_right_batch_scores_well_and_a_wrong_one_does_not(made):
    _, known, outcome = made
    row = trial.score(outcome, known, 12.0)
    assert (row.scans, row.objects, row.pairs, row.all_pairs, row.placed) == (6, 2, 15, 15, 6)
    assert row.exact and row.wrong_joins == row.wrong_pairs == 0
    assert 0 < row.worst_deg < 1 and 0 < row.worst_percent < 1
    first, second = (next(name for name in known if known[name].thing == thing) for thing in (0, 1))
    swapped = {**known, first: known[second], second: known[first]}
    row = trial.score(outcome, swapped, 12.0)
    assert not row.exact and row.wrong_joins == 2 and row.wrong_pairs == 4
    turned = known[first].T_thing_scan @ np.diag([-1.0, -1.0, 1.0, 1.0])
    row = trial.score(outcome, {**known, first: replace(known[first], T_thing_scan=turned)}, 12.0)
    assert row.exact and row.wrong_pairs == 2 and row.worst_deg > 179


def test_rows_are_kept_with_what_they_were_measured_with(made):
    _, known, outcome = made
    row = trial.score(outcome, known, 12.0)
    content = json.loads(trial.to_json([row], AlignOptions(), 2, 7))
    assert content["rows"][0]["exact"] and content["rows"][0]["seconds"] == 12.0
    assert (content["workers"], content["seed"], content["options"]["weights"]) == (2, 7, "utopic")


def test_the_command_asks_for_numbers_and_prints_a_row_each(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from utopic_cli.cli import app

    asked = []
    row = trial.TrialRow(30, 3, 120, 435, 99.0, None, True, 30, 0, 0, 0.2, 0.1)

    def run_trials(counts, options, **more):
        asked.append((counts, options.points, more["workers"]))
        return [replace(row, scans=count) for count in counts]

    monkeypatch.setattr(trial, "run_trials", run_trials)
    out = tmp_path / "out.json"
    arguments = ["bench", "batch", "--scans", "10,31", "--workers", "2", "--points", "99", "--json", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert asked == [([10, 31], 99, 2)]
    assert "31" in result.stdout and result.stdout.count("exact") == 2 and "28%" in result.stdout
    assert [entry["scans"] for entry in json.loads(out.read_text())["rows"]] == [10, 31]
    for wrong in ("x", "1", "10,,30", "10;30"):
        result = CliRunner().invoke(app, ["bench", "batch", "--scans", wrong])
        assert result.exit_code == 2 and "give numbers of scans" in result.stderr
