from __future__ import annotations

import csv
import json
import os
import re
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.multiway.stubs import make_stub, write_scans
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, OutputError, UsageError
from utopic_cli.geometry.rigid import invert, relative_rotation_error_deg
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway import batch as room
from utopic_cli.multiway.batch import run_batch
from utopic_cli.multiway.lock import locked
from utopic_cli.multiway.plan import BatchRequest, plan_batch


@pytest.fixture(autouse=True)
def light(monkeypatch):
    """No network: its weights' hash is all that a batch itself needs of it."""
    monkeypatch.setattr(
        room, "weights_of", lambda options: {"name": options.weights, "sha256": options.weights}
    )


def request(tmp_path, **kwargs):
    return BatchRequest((tmp_path / "scans",), tmp_path / "out", **kwargs)


def run(tmp_path, log="", calibrated=True, **kwargs):
    return run_batch(request(tmp_path, **kwargs), make_task=partial(make_stub, str(log), calibrated))


def poses(tmp_path):
    return json.loads((tmp_path / "out" / "poses.json").read_text())


def test_scans_of_one_object_come_into_one_frame(tmp_path):
    worlds = write_scans(tmp_path / "scans", [f"s{i}.ply" for i in range(5)])
    outcome = run(tmp_path, merge=True, page=True, workers=2)
    assert outcome.exit_code == 0
    content = poses(tmp_path)
    assert [group["scans"] for group in content["groups"]] == [["s0", "s1", "s2", "s3", "s4"]]
    assert content["groups"][0]["world_frame_of"] == "s0"
    assert content["left_out"] == [] and len(content["pairs"]) == 10
    for entry in content["scans"]:
        known = invert(worlds["s0.ply"]) @ worlds[entry["scan"] + ".ply"]
        assert relative_rotation_error_deg(np.array(entry["T_world_scan"]), known) < 0.5
    out = tmp_path / "out"
    kitti = np.loadtxt(out / "poses.txt")
    assert kitti.shape == (5, 12)
    assert (kitti[3].reshape(3, 4) == np.array(content["scans"][3]["T_world_scan"])[:3]).all()
    rows = list(csv.DictReader((out / "poses.csv").open()))
    assert [row["scan"] for row in rows] == ["s0", "s1", "s2", "s3", "s4"]
    assert float(rows[2]["m03"]) == content["scans"][2]["T_world_scan"][0][3] == float(rows[2]["tx"])
    summary = list(csv.DictReader((out / "summary.csv").open()))
    assert [row["kind"] for row in summary].count("pair") == 10
    assert (out / "pairs" / "s1--s0.json").is_file()
    page = (out / "report.html").read_text()
    assert "5 of 5 scans placed, in one group" in page and "<svg" in page
    merged = read_scan(out / "merged.ply").cloud.points
    assert len(merged) == 1000
    assert np.linalg.norm(merged[:200] - merged[800:], axis=1).max() < 0.1  # the same points, nearly
    assert not (out / ".utopic-batch.lock").exists()


def test_mixed_objects_and_a_lone_scan_become_groups(tmp_path):
    write_scans(tmp_path / "scans", [f"{i}.ply" for i in range(7)], objects=2)
    write_scans(tmp_path / "more", ["z.ply"], seed=9)
    (tmp_path / "scans" / "z.ply").write_bytes((tmp_path / "more" / "z.ply").read_bytes())
    truth = json.loads((tmp_path / "scans" / "truth.json").read_text())
    truth["z.ply"] = {"world": np.eye(4).tolist(), "object": 7}
    (tmp_path / "scans" / "truth.json").write_text(json.dumps(truth))
    outcome = run(tmp_path, merge=True)
    assert outcome.exit_code == 6
    content = poses(tmp_path)
    assert [group["scans"] for group in content["groups"]] == [["0", "2", "4", "6"], ["1", "3", "5"]]
    assert [entry["scan"] for entry in content["left_out"]] == ["z"]
    reason = content["left_out"][0]["reason"]
    assert "connects with no other scan (7 pairs: 7 unconfirmed); best z--" in reason
    assert re.search(r": confidence 0\.\d\d, overlap \d+%; scan more in between, or look at it", reason)
    assert reason.endswith(".ply") and f"utopic align {tmp_path / 'scans' / 'z.ply'} " in reason
    assert len(read_scan(tmp_path / "out" / "merged-2.ply").cloud) == 600
    assert len((tmp_path / "out" / "poses.txt").read_text().splitlines()) == 4


def test_crash_hang_refusal_and_bug_cost_their_pairs_only(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply", "c.ply", "d.ply", "crash.ply", "hang.ply"])
    outcome = run(tmp_path, workers=2, timeout_s=4.0, pairs="to-first")
    verdicts = {outcome.scans[pair.source].file.name: pair.verdict for pair in outcome.model.pairs}
    assert verdicts == {"b": "used", "c": "used", "d": "used", "crash": "failed", "hang": "failed"}
    assert [entry["scan"] for entry in poses(tmp_path)["left_out"]] == ["crash", "hang"]
    assert outcome.exit_code == 6
    record = json.loads((tmp_path / "out" / "pairs" / "hang--a.json").read_text())
    assert record["status"] == "failed" and "4 s" in record["problem"]


def test_bad_files_are_named_and_the_rest_is_done(tmp_path):
    scans = tmp_path / "scans"
    write_scans(scans, ["a.ply", "b.ply", "c.ply"])
    (scans / "broken.ply").write_bytes(b"ply\nnothing")
    (scans / "copy.ply").write_bytes((scans / "b.ply").read_bytes())
    (scans / "README.txt").write_text("These are scans of a thing.\n")
    outcome = run(tmp_path)
    assert outcome.exit_code == 6
    content = poses(tmp_path)
    assert [(entry["scan"], "broken.ply" in entry["reason"]) for entry in content["left_out"]] == [
        ("broken", True)
    ]
    rows = list(csv.DictReader((tmp_path / "out" / "summary.csv").open()))
    told = {row["name"]: row for row in rows}
    assert told["broken"]["status"] == "unreadable" and "broken.ply" in str(told["broken"])
    assert told["copy"]["status"] == "copy"
    passed = {Path(entry["file"]).name: entry["reason"] for entry in content["passed_over"]}
    assert passed == {"README.txt": "text without points", "truth.json": "no scan format"}
    places = {entry["scan"]: entry["T_world_scan"] for entry in content["scans"]}
    assert places["copy"] == places["b"] is not None
    (scans / "broken.ply").unlink()
    assert run(tmp_path, resume=True).exit_code == 0  # a README is no failed scan


def test_no_scan_that_can_be_read_is_an_input_error(tmp_path):
    (tmp_path / "scans").mkdir()
    for name in ("a.ply", "b.ply"):
        (tmp_path / "scans" / name).write_text(f"no scan {name}")
    with pytest.raises(InputError, match=r"none of 2 scans can be read: .*a\.ply"):
        run(tmp_path)


def test_nothing_aligned_is_said_by_the_exit_code(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    outcome = run(tmp_path, calibrated=False)
    assert outcome.exit_code == 7
    assert (tmp_path / "out" / "poses.txt").read_text() == ""
    assert "not trusted by itself" in outcome.model.pairs[0].reason


def test_resume_does_only_what_is_missing_and_gives_the_same(tmp_path):
    names = [f"s{i}.ply" for i in range(4)]
    write_scans(tmp_path / "scans", names)
    log = tmp_path / "log"
    run(tmp_path, log)
    first = (tmp_path / "out" / "poses.json").read_bytes()
    pairs = tmp_path / "out" / "pairs"
    (pairs / "s1--s0.json").unlink()
    (pairs / "s2--s0.json").write_text('{"status": "done", "fingerp')  # cut short
    record = json.loads((pairs / "s3--s0.json").read_text())
    (pairs / "s3--s0.json").write_text(json.dumps({**record, "fingerprint": "of other inputs"}))
    failed = json.loads((pairs / "s3--s2.json").read_text())
    (pairs / "s3--s2.json").write_text(json.dumps({**failed, "status": "failed"}))  # may go well now
    log.unlink()
    outcome = run(tmp_path, log, resume=True)
    assert sorted(log.read_text().split()) == ["s1--s0", "s2--s0", "s3--s0", "s3--s2"]
    assert outcome.resumed == 2
    assert (tmp_path / "out" / "poses.json").read_bytes() == first
    log.unlink()
    run(tmp_path, log, resume=True)
    assert not log.exists()


def test_other_bytes_options_or_weights_are_done_again(tmp_path):
    scans = tmp_path / "scans"
    write_scans(scans, ["a.ply", "b.ply", "c.ply"])
    log = tmp_path / "log"
    run(tmp_path, log)
    (scans / "c.ply").write_bytes((scans / "c.ply").read_bytes().replace(b"ply\n", b"ply\ncomment new\n", 1))
    for change, again in (
        ({}, ["c--a", "c--b"]),
        ({"options": AlignOptions(points=99, threads=1)}, ["b--a", "c--a", "c--b"]),
        ({"options": AlignOptions(points=99, threads=1, weights="others")}, ["b--a", "c--a", "c--b"]),
    ):
        log.unlink()
        run(tmp_path, log, resume=True, **change)
        assert sorted(log.read_text().split()) == again


def test_the_number_of_workers_changes_nothing(tmp_path):
    write_scans(tmp_path / "scans", [f"s{i}.ply" for i in range(4)])
    results = []
    for workers in (1, 3):
        run(tmp_path, workers=workers, overwrite=True)
        results.append((tmp_path / "out" / "poses.json").read_bytes())
    assert results[0] == results[1]


def test_an_earlier_batch_is_neither_mixed_nor_lost(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply", "c.ply"])
    run(tmp_path, merge=True)
    with pytest.raises(OutputError, match="--resume to go on with it or --overwrite"):
        run(tmp_path)
    (tmp_path / "scans" / "c.ply").unlink()
    run(tmp_path, overwrite=True)
    left = sorted(path.name for path in (tmp_path / "out").rglob("*.json"))
    assert left == ["a.json", "b--a.json", "b.json", "poses.json"]
    assert not (tmp_path / "out" / "merged.ply").exists()  # it was of other scans
    with pytest.raises(UsageError, match="choose one"):
        run(tmp_path, resume=True, overwrite=True)


def test_a_folder_at_work_is_refused(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out"), pytest.raises(OutputError, match="another batch is at work"):
        run(tmp_path)


def test_results_never_land_among_the_scans(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    with pytest.raises(UsageError, match="holds the scans"):
        run_batch(BatchRequest((tmp_path / "scans",), tmp_path / "scans"))
    assert sorted(path.name for path in (tmp_path / "scans").iterdir()) == ["a.ply", "b.ply", "truth.json"]


def test_a_disk_that_fills_up_ends_the_batch_with_what_is_done(tmp_path, monkeypatch):
    write_scans(tmp_path / "scans", [f"s{i}.ply" for i in range(4)])
    commit, left = room.Journal.commit, [6]

    def full(self, *args):
        left[0] -= 1
        if left[0] < 0:
            raise OutputError("out/pairs: the disk is full; free some space")
        return commit(self, *args)

    monkeypatch.setattr(room.Journal, "commit", full)
    with pytest.raises(OutputError, match="disk is full"):
        run(tmp_path)
    assert len(list((tmp_path / "out" / "pairs").glob("*.json"))) == 2
    monkeypatch.undo()
    monkeypatch.setattr(
        room, "weights_of", lambda options: {"name": options.weights, "sha256": options.weights}
    )
    assert run(tmp_path, resume=True).resumed == 2


def test_many_scans_are_not_all_tried_with_all(tmp_path):
    write_scans(tmp_path / "scans", [f"s{i}.ply" for i in range(16)], objects=2)
    outcome = run(tmp_path, workers=2)
    assert [len(group.T_world_scan) for group in outcome.model.groups] == [8, 8]
    assert len(outcome.model.pairs) < 110  # of 120
    assert outcome.exit_code == 6


def test_a_list_of_pairs_goes_by_names_and_copies_count_as_one(tmp_path):
    scans = tmp_path / "scans"
    write_scans(scans, ["a.ply", "b.ply", "c.ply"])
    (scans / "d.ply").write_bytes((scans / "a.ply").read_bytes())
    listed = tmp_path / "pairs.csv"
    listed.write_text(f"source,target\na,b\n# said\n\nc.ply,{scans / 'b.ply'}\nb,a\nd,b\nd,a\n")
    plan = plan_batch(request(tmp_path, pairs=str(listed)))
    assert plan.first == ((0, 1), (2, 1))
    for text, reason in (
        ("a,b\nb,x\n", "line 2 names 'x'"),
        ("a\n", "line 1 has no second"),
        ("a,a\n", "itself"),
    ):
        listed.write_text(text)
        with pytest.raises(InputError, match=reason):
            plan_batch(request(tmp_path, pairs=str(listed)))
    with pytest.raises(UsageError, match="sideways: choose auto, all"):
        plan_batch(request(tmp_path, pairs="sideways"))


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux only")
def test_odd_names_go_all_the_way(tmp_path):
    names = ["plain.ply", "two words.ply", "[b]*.ply", "emoji 🙂.ply", "a--b.ply", "<i>.ply"]
    write_scans(tmp_path / "scans", [*names, "caf\udce9.ply"])  # a byte that is no UTF-8
    outcome = run(tmp_path, merge=True, page=True)
    assert outcome.exit_code == 0
    content = poses(tmp_path)
    assert {entry["scan"] for entry in content["scans"]} == {
        *("plain", "two words", "[b]_", "emoji 🙂", "a-b", "_i_", "caf%E9")
    }
    assert os.fsencode(tmp_path / "scans") + b"/caf\xe9.ply" in (tmp_path / "out" / "poses.csv").read_bytes()
    assert (tmp_path / "out" / "pairs" / "two words--[b]_.json").exists() or (
        tmp_path / "out" / "pairs" / "[b]_--two words.json"
    ).exists()
    assert b"<i>" not in (tmp_path / "out" / "report.html").read_bytes()


def test_the_first_scan_is_the_first_that_can_be_read(tmp_path):
    write_scans(tmp_path / "scans", ["b.ply", "c.ply", "d.ply"])
    (tmp_path / "scans" / "a.ply").write_bytes(b"ply\nnothing")
    outcome = run(tmp_path, pairs="to-first")
    assert [entry["pair"] for entry in poses(tmp_path)["pairs"]] == ["c--b", "d--b"]
    assert outcome.exit_code == 6 and len(outcome.model.groups) == 1


def test_scans_where_results_go_are_refused_and_stay(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    listed = (tmp_path / "scans" / "a.ply", tmp_path / "scans" / "b.ply")
    for inputs, out in (
        ((tmp_path / "scans",), tmp_path),  # where descriptions of scans would be written
        (listed, tmp_path / "scans"),
    ):
        with pytest.raises(UsageError, match="lies where the results go"):
            run_batch(BatchRequest(inputs, out, overwrite=True))
    (tmp_path / "out" / "pairs").mkdir(parents=True)
    own = tmp_path / "out" / "pairs" / "mine.json"
    own.write_text("{}")
    run(tmp_path, overwrite=True)
    assert own.read_text() == "{}"  # only records are cleared


def test_what_was_out_of_reach_is_tried_again_and_leftovers_go(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply", "c.ply"])
    content = (tmp_path / "scans" / "c.ply").read_bytes()
    out = tmp_path / "out"
    run(tmp_path)
    whole = (out / "poses.json").read_bytes()
    record = json.loads((out / "scans" / "c.json").read_text())
    record.pop("description")
    (out / "scans" / "c.json").write_text(json.dumps({**record, "status": "refused", "problem": "away"}))
    (out / "pairs" / ".utopic-0123.tmp").write_bytes(content)
    (out / ".utopic-4567.tmp").write_bytes(content)
    assert run(tmp_path, resume=True).exit_code == 0
    assert (out / "poses.json").read_bytes() == whole
    assert not list(out.rglob(".utopic-*"))


def test_a_batch_begun_anew_is_not_whole_until_it_is(tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    run(tmp_path)
    for name in ("a.ply", "b.ply"):
        (tmp_path / "scans" / name).write_text("no scan any more")
    with pytest.raises(InputError, match="none of 2 scans"):
        run(tmp_path, overwrite=True)
    assert not (tmp_path / "out" / "poses.json").exists()


def test_a_file_name_that_several_scans_have_is_no_name(tmp_path):
    for seed, folder in enumerate(("one", "two")):
        write_scans(tmp_path / folder, ["a.ply", f"{folder}.ply"], seed=seed)
    listed = tmp_path / "pairs.csv"
    inputs = (tmp_path / "one", tmp_path / "two")
    for text, reason in (("a.ply,one\n", "several files"), ("a,b" + "c" * 200_000, "line 1 is no CSV")):
        listed.write_text(text)
        with pytest.raises(InputError, match=reason):
            plan_batch(BatchRequest(inputs, tmp_path / "out", pairs=str(listed)))
    listed.write_text(f"{tmp_path / 'two' / 'a.ply'},one\n")
    plan = plan_batch(BatchRequest(inputs, tmp_path / "out", pairs=str(listed)))
    assert [plan.scans.scans[i].path.parent.name for i in plan.first[0]] == ["two", "one"]
