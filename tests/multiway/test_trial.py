from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tests.multiway.stubs import make_stub
from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError
from utopic_cli.geometry.rigid import apply, invert, relative_rotation_error_deg
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway import batch as room
from utopic_cli.multiway import drawn, simulated, trial
from utopic_cli.multiway.batch import run_batch
from utopic_cli.multiway.plan import BatchRequest


def small(monkeypatch):
    monkeypatch.setattr(simulated, "VIEWS", 3)
    monkeypatch.setattr(simulated, "POINTS", 300)
    monkeypatch.setattr(simulated, "_DENSE", 20_000)
    monkeypatch.setattr(simulated, "_RESOLUTION", 32)


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Six small scans of two objects, and the batch of a stub that knows the answers."""
    small(monkeypatch)
    monkeypatch.setattr(room, "weights_of", lambda options: {"name": "stub", "sha256": "stub"})
    known = simulated.make_scans(tmp_path / "scans", 6, np.random.default_rng(0))
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
    content = json.loads(trial.to_json([row], trial.measured_with(AlignOptions(), 2, 7)))
    assert content["rows"][0]["exact"] and content["rows"][0]["scan_s"] == 12.0
    assert content["rows"][0]["work_s"] == 6 * 12.0 + 15 * row.pair_s
    assert 0.0 <= row.own_s < outcome.seconds
    assert (content["workers"], content["seed"], content["options"]["weights"]) == (2, 7, "utopic")
    assert (content["weights_name"], len(content["weights_sha256"])) == ("utopic", 64)


def test_overlap_is_that_of_the_surfaces_and_none_between_objects(made):
    folder, known, _ = made
    scans = {name: read_scan(folder / f"{name}.ply").cloud.points for name in known}
    first, *others = (name for name in known if known[name].thing == 0)
    stranger = next(name for name in known if known[name].thing == 1)

    def overlap(a, b):
        return simulated.overlap_ratio((scans[a], scans[b]), (known[a], known[b]))

    assert overlap(first, first) == 1.0
    assert all(0.0 < overlap(first, other) < 0.9 for other in others)  # 120 degrees on
    assert overlap(first, stranger) == 0.0


def test_drawn_answers_are_wrong_by_what_the_registered_ones_were(made):
    """An answer right, one half a turn off and one of two objects; the draw finds each again elsewhere."""
    folder, known, outcome = made
    answers = drawn.answers_of(outcome, known)
    same = [one for one in answers if one["same"]]
    assert (len(answers), len(same)) == (15, 6)
    for one in same:  # the stub turns by 0.2 degrees about the scan's origin
        assert relative_rotation_error_deg(np.array(one["errors"][0]), np.eye(4)) < 0.5
    names = [next(name for name in known if known[name].thing == thing) for thing in (0, 1)]
    names.append(next(name for name in known if known[name].thing == 0 and name != names[0]))
    scans = {name: read_scan(folder / f"{name}.ply") for name in names}

    def drawing(source, target, answers):
        both = (known[source], known[target])
        report = drawn.draw((scans[source], scans[target]), both, answers, np.random.default_rng(0))
        return np.array(report["T_target_source"]), report

    right = invert(known[names[2]].T_thing_scan) @ known[names[0]].T_thing_scan
    found, report = drawing(names[0], names[2], answers)
    assert relative_rotation_error_deg(found, right) < 0.5 and report["trusted"]
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    found, _ = drawing(names[0], names[2], [{**same[0], "errors": [half_turn.tolist()]}])
    assert relative_rotation_error_deg(found, right) == pytest.approx(180.0, abs=1e-4)
    middle = scans[names[0]].cloud.points.mean(axis=0)
    assert np.allclose(apply(found, middle), apply(right, middle))
    _, report = drawing(names[0], names[1], answers)
    assert not report["trusted"] and report["confidence"] == 0.2


@pytest.mark.slow
def test_a_trial_is_kept_and_gone_on_with_and_further_sizes_are_drawn(tmp_path, monkeypatch):
    """Six scans of two objects, answered by a stub; nine more drawn from that, by the worker itself."""
    small(monkeypatch)
    home = tmp_path / "6-scans-seed-0"
    truth = {
        f"{name}.ply": {"world": one.T_thing_scan.tolist(), "object": one.thing}
        for name, one in simulated.simulated(home, 6, 0).items()
    }
    (home / "scans" / "truth.json").write_text(json.dumps(truth))
    options = AlignOptions(device="cpu", threads=1)

    def run():
        return trial.run_trials(
            [6], options, drawn=[9], folder=tmp_path, make_task=partial(make_stub, str(tmp_path / "log"))
        )

    registered, further = run()
    assert (registered.scans, registered.drawn, registered.pairs, registered.exact) == (6, False, 15, True)
    assert (further.scans, further.drawn, further.pairs) == (9, True, 36)
    assert further.pair_s == registered.pair_s and further.placed == 9
    assert len((tmp_path / "log").read_text().split()) == 15
    assert [replace(row, own_s=0.0, own_mb=0.0, worker_mb=0.0) for row in run()] == [
        replace(row, own_s=0.0, own_mb=0.0, worker_mb=0.0) for row in (registered, further)
    ]
    assert len((tmp_path / "log").read_text().split()) == 15  # all of it was there
    with pytest.raises(UsageError, match="--scans 20"):
        monkeypatch.setattr(trial, "answers_of", lambda *both: [])
        run()


def test_the_command_asks_for_numbers_and_prints_a_row_each(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from utopic_cli.cli import app

    asked = []
    row = trial.TrialRow(30, 3, False, 120, 435, 1.0, 3.0, 2.0, None, None, True, 30, 0, 0, 0.2, 0.1)

    def run_trials(counts, options, **more):
        asked.append((counts, options.points, more["workers"], more["drawn"], more["folder"]))
        rows = [replace(row, scans=count) for count in counts]
        return rows + [replace(row, scans=count, drawn=True) for count in more["drawn"]]

    monkeypatch.setattr(trial, "run_trials", run_trials)
    out, page = tmp_path / "out.json", tmp_path / "out.html"
    arguments = ["bench", "batch", "--scans", "10,31", "--drawn", "300", "--workers", "2", "--points", "99"]
    result = CliRunner().invoke(
        app, [*arguments, "--keep", str(tmp_path), "--json", str(out), "--html", str(page)]
    )
    assert result.exit_code == 0, result.output
    assert asked == [([10, 31], 99, 2, [300], tmp_path)]
    assert "31" in result.stdout and result.stdout.count("exact") == 3 and "28%" in result.stdout
    assert "~660 s" in result.stdout and " 391 s" in result.stdout
    content = json.loads(out.read_text())
    assert [entry["scans"] for entry in content["rows"]] == [10, 31, 300]
    title = f"weights utopic (sha256 {content['weights_sha256'][:12]})"
    assert title in result.stdout and page.read_text().count(title) == 3  # head, heading, table
    assert page.read_text().count("<svg") == 2
    for wrong in ("x", "1", "10,,30", "10;30"):
        for option in ("--scans", "--drawn"):
            result = CliRunner().invoke(app, ["bench", "batch", option, wrong])
            assert result.exit_code == 2 and "give numbers of scans" in result.stderr
