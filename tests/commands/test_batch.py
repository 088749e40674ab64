"""``utopic batch`` at the command line; the room itself is tested in tests/multiway."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.multiway.stubs import make_stub, random_motion, write_scans
from utopic_cli.geometry.rigid import invert, relative_rotation_error_deg
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.multiway import batch as room

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def stubbed(monkeypatch):
    """No network: the stub knows the answers."""
    run = room.run_batch
    seen = []

    def run_stubbed(asked, **told):
        seen.append(asked)
        return run(asked, **told, make_task=make_stub)

    monkeypatch.setattr(room, "weights_of", lambda options: {"name": "stub", "sha256": "stub"})
    monkeypatch.setattr(room, "run_batch", run_stubbed)
    return seen


def test_a_folder_becomes_one_group(cli, stubbed, tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply", "c[1].ply"])
    out = tmp_path / "out"
    options = ["--merge", "--html", "--workers", 2, "--seed", 3, "--points", 80, "--timeout", 50]
    options += ["--max-rotation", 60]
    result = cli("batch", tmp_path / "scans", "--out-dir", out, *options)
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    assert "3 of 3 scans placed, in one group" in result.stderr
    assert "3 scans: a, b, c[1]" in result.stderr
    assert "3 tried: 3 used" in result.stderr
    made = {path.name for path in out.iterdir()}
    assert made == {
        *(
            "poses.json",
            "poses.txt",
            "poses.csv",
            "summary.csv",
            "merged.ply",
            "report.html",
            "pairs",
            "scans",
        )
    }
    (asked,) = stubbed
    assert (asked.workers, asked.timeout_s, asked.options.seed, asked.options.points) == (2, 50.0, 3, 80)
    assert (asked.options.threads, asked.options.max_rotation) == (1, 60.0)


def test_parts_and_nothing_have_exit_codes_of_their_own(cli, stubbed, tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply", "c.ply"])
    (tmp_path / "scans" / "d.ply").write_text("no scan")
    result = cli("batch", tmp_path / "scans", "--out-dir", tmp_path / "out")
    assert result.exit_code == 6
    assert "left out d: " in result.stderr and "d.ply" in result.stderr
    write_scans(tmp_path / "two", ["a.ply", "b.ply"], objects=2)
    result = cli("batch", tmp_path / "two", "--out-dir", tmp_path / "none", "-q")
    assert result.exit_code == 7
    assert result.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["scans", "--out-dir", "out", "--pairs", "x"], 2, "--pairs x: choose auto, all, sequential"),
        (["scans", "--out-dir", "out", "--merge-voxel", "1"], 2, "--merge-voxel needs --merge"),
        (["scans", "-o", "out"], 2, "No such option: -o; did you mean --out-dir?"),
        (["scans", "--out-dir", "scans"], 2, "choose another --out-dir"),
        (["scans", "--out-dir", "out", "--resume", "--overwrite"], 2, "choose one"),
        (["scans", "--out-dir", "out", "--cluster", "tcp://x:1", "--workers", "2"], 2, "choose one"),
        (["scans", "--out-dir", "out", "--cluster", "nonsense"], 4, "nonsense: no Dask scheduler answers"),
        (["nowhere", "--out-dir", "out"], 4, "no such file or folder"),
        (["scans/a.ply", "--out-dir", "out"], 4, "only one scan given; a batch needs at least two"),
        (["scans", "--out-dir", "out", "--pairs", "none.csv"], 4, "none.csv: no such file"),
        (["scans", "--out-dir", "no/such/out"], 5, "the folder no/such does not exist"),
        (["scans", "--out-dir", "scans/a.ply"], 5, "is a file; name a folder"),
    ],
)
def test_mistakes_are_told_in_one_line_before_any_work(
    cli, stubbed, tmp_path, monkeypatch, arguments, code, said
):
    monkeypatch.chdir(tmp_path)
    if "--cluster" in arguments:
        pytest.importorskip("distributed")
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    result = cli("batch", *arguments)
    assert result.exit_code == code
    assert said in result.stderr and len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_bad_inputs_are_named_with_their_exit_codes(cli, stubbed, tmp_path):
    """Equal stems, copies, files given twice, odd names, files that are no scans, lists that are wrong."""
    write_scans(tmp_path / "scans", ["a b.ply", "[c].ply"])
    write_scans(tmp_path / "more", ["a b.ply"], seed=1)
    truths = [json.loads((tmp_path / name / "truth.json").read_text()) for name in ("scans", "more")]
    (tmp_path / "scans" / "copy.ply").write_bytes((tmp_path / "scans" / "[c].ply").read_bytes())
    listed = tmp_path / "pairs.csv"
    listed.write_text("source,target\na b,[c]\n[c],d\n")
    inputs = (tmp_path / "scans", tmp_path / "more", tmp_path / "scans" / "a b.ply")
    result = cli("batch", *inputs, "--out-dir", tmp_path / "out", "--pairs", listed)
    assert result.exit_code == 4 and "pairs.csv: line 3 names 'd'" in result.stderr
    assert truths[0].keys() > truths[1].keys() and not (tmp_path / "out").exists()
    result = cli("batch", *inputs, "--out-dir", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    for said in (
        "copy.ply: is a copy of [c]; it gets the same place",
        "a b.ply: is given twice; it is used once",
        "more/a b.ply: is called a b.ply here",
        "4 of 4 scans placed, in one group",
    ):
        assert said in " ".join(result.stderr.split())
    for name in ("x.ply", "y.ply"):
        (tmp_path / "more" / name).write_text("nothing")
    junk = [tmp_path / "more" / name for name in ("x.ply", "y.ply")]
    result = cli("batch", *junk, "--out-dir", tmp_path / "none")
    assert result.exit_code == 4 and "none of 2 scans can be read: " in result.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_told_in_one_line_and_nothing_of_a_file_is_left(cli, stubbed, tmp_path, monkeypatch):
    """The pairs are done; the merged cloud no longer fits."""
    from utopic_cli.io import output

    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    create = output._create

    def full(path):
        if path.parent == tmp_path / "out":
            os.close(create(path))
            return os.open("/dev/full", os.O_WRONLY)
        return create(path)

    monkeypatch.setattr(output, "_create", full)
    out = tmp_path / "out"
    result = cli("batch", tmp_path / "scans", "--out-dir", out, "--merge")
    assert result.exit_code == 5
    assert "merged.ply" in result.stderr and "the disk is full" in result.stderr
    assert sorted(path.name for path in out.iterdir()) == ["pairs", "scans"]
    monkeypatch.undo()


def test_a_dry_run_prints_the_plan_and_writes_nothing(cli, stubbed, tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply", "c.ply"])
    (tmp_path / "scans" / "d.ply").write_bytes((tmp_path / "scans" / "a.ply").read_bytes())
    result = cli("batch", tmp_path / "scans", "--out-dir", tmp_path / "out", "--dry-run", "--workers", 3)
    assert result.exit_code == 0
    assert "copy of a" in result.stdout
    assert [line for line in result.stdout.splitlines() if line.startswith("pair ")] == [
        *("pair  b--a", "pair  c--a", "pair  c--b")
    ]
    assert "3 pairs of 3 scans, 3 at a time" in result.stdout
    assert not (tmp_path / "out").exists() and not stubbed


SCRIPT = """
import os
from functools import partial
from tests.multiway.stubs import make_stub
from utopic_cli.multiway import batch as room
run = room.run_batch
room.weights_of = lambda options: {"name": "stub", "sha256": "stub"}
room.run_batch = lambda asked, **told: run(
    asked, **told, make_task=partial(make_stub, "", True, float(os.environ["PAUSE"]))
)
from utopic_cli.cli import main
if __name__ == "__main__":
    main()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize(("how", "scans", "times"), [(signal.SIGINT, 4, 1), (signal.SIGKILL, 14, 2)])
def test_what_is_done_stays_when_a_batch_is_interrupted(tmp_path, how, scans, times):
    """Fourteen scans are more than are tried all with all: the killed batch chooses its pairs by rounds."""
    write_scans(tmp_path / "scans", [f"s{i}.ply" for i in range(scans)], objects=scans // 4 - 1 or 1)
    script = tmp_path / "stubbed.py"
    script.write_text(SCRIPT)
    out = tmp_path / "out"

    def start(folder, pause, *more):
        command = [sys.executable, script, "batch", tmp_path / "scans", "--out-dir", folder, "--workers", 1]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PAUSE": pause}
        return subprocess.Popen(
            [str(part) for part in (*command, *more)],
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    done = {}
    for attempt in range(times):
        process = start(out, "0.5", *(["--resume"] if attempt else []))
        before = len(done)
        while len(list(out.glob("pairs/*.json"))) < before + 2 and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(how)
        said = process.communicate(timeout=60)[1]
        assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL), said
        done = {path.name: path.stat().st_mtime_ns for path in out.glob("pairs/*.json")}
        assert before + 2 <= len(done) < before + 6
        assert not (out / "poses.json").exists()

    again = start(out, "0.0", "--resume")
    assert again.communicate(timeout=60)[1].count("were done before") == 1
    assert again.returncode == (0 if scans == 4 else 6)
    assert done.items() <= {path.name: path.stat().st_mtime_ns for path in out.glob("pairs/*.json")}.items()
    whole = start(tmp_path / "whole", "0.0")
    whole.communicate(timeout=60)
    for name in ("poses.json", "poses.txt", "poses.csv"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert not list(out.rglob(".utopic-*.tmp"))


def test_three_real_scans_become_one_model(cli, tmp_path, monkeypatch):
    """The whole way once, network and all: three views of the demo's dragon."""
    from utopic_cli.synthesis.demo_object import demo_mesh
    from utopic_cli.synthesis.scanner import range_scan
    from utopic_cli.synthesis.surface import sample_surface

    rng = np.random.default_rng(4)
    points, normals = sample_surface(*demo_mesh(64), 60_000, rng)[:2]
    worlds = {}
    (tmp_path / "scans").mkdir()
    for i, angle in enumerate((0.0, 0.35, 0.7)):
        view = range_scan(
            points, normals, np.array([np.cos(angle), np.sin(angle), 0.3]), rng, cell=0.03, count=4000
        )
        worlds[f"view{i}"] = world = random_motion(rng)
        moved = view.transformed(invert(world)).points
        colours = np.full(moved.shape, 90, np.uint8)
        (tmp_path / "scans" / f"view{i}.ply").write_bytes(scalar_cloud_ply(moved, colours, {}))
    out = tmp_path / "out"
    result = cli("batch", tmp_path / "scans", "--out-dir", out, "--workers", 1, "--points", 400, "--merge")
    assert result.exit_code == 0, result.output
    poses = json.loads((out / "poses.json").read_text())
    for entry in poses["scans"]:
        known = invert(worlds["view0"]) @ worlds[entry["scan"]]
        found = np.array(entry["T_world_scan"])
        assert relative_rotation_error_deg(found, known) < 2.0
    record = json.loads((out / "pairs" / "view1--view0.json").read_text())
    assert record["report"]["weights"]["name"] == "utopic"


def test_a_dry_run_says_what_an_earlier_batch_left(cli, stubbed, tmp_path):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    out = tmp_path / "out"
    (out / "pairs").mkdir(parents=True)
    (out / "pairs" / "b--a.json").write_text("{}")
    asked = ["batch", tmp_path / "scans", "--out-dir", out, "--dry-run"]
    result = cli(*asked)
    assert result.exit_code == 0 and "pair  b--a  recorded" in result.stdout
    assert "1 of its pairs recorded; pass --resume to go on with it or --overwrite" in result.stdout
    assert "used again" in cli(*asked, "--resume").stdout
    assert "replaced" in cli(*asked, "--overwrite").stdout


def test_files_that_are_no_scans_or_broken_are_said_at_the_start(cli, stubbed, tmp_path):
    """In a dry run as well; broken ones are left out with exit code 6, the others cost nothing."""
    scans = tmp_path / "scans"
    write_scans(scans, ["a.ply", "b.ply"])
    (scans / "README.txt").write_text("Scans of a thing.\n")
    asked = ["batch", scans, "--out-dir", tmp_path / "out"]
    line = "2 files are no scans and left out: text without points: 1 (README.txt); no scan format: 1"
    dry = cli(*asked, "--dry-run")
    assert [text.split()[0] for text in dry.stdout.splitlines()] == ["scan", "scan", "note", "pair", "1"]
    assert line in dry.stdout
    done = cli(*asked)
    assert done.exit_code == 0 and done.stderr.count("no scans and left out") == 1
    (scans / "cut.ply").write_bytes((scans / "a.ply").read_bytes()[:-5])
    (scans / "odd.txt").write_text("1,5 2,5 3,5\n" * 60)
    dry = cli(*asked, "--dry-run")
    told = [text for text in dry.stdout.splitlines() if text.startswith(("left out", "no scan"))]
    assert told[0].startswith(f"left out  {scans / 'cut.ply'}: its PLY header promises 200 vertex")
    assert told[1].startswith(f"no scan  {scans / 'odd.txt'}: has '1,5', a decimal comma")
    assert "1 pairs of 2 scans" in dry.stdout
    done = cli(*asked, "--overwrite")
    assert done.exit_code == 6
    said = done.stderr.splitlines()
    warned = [i for i, text in enumerate(said) if "warning" in text and "cut.ply: its PLY header" in text]
    (placed,) = (i for i, text in enumerate(said) if "2 of 3 scans placed" in text)
    assert warned and warned[0] < placed
    assert any("left out cut: " in text for text in said[placed:])


def test_what_we_made_is_no_scan(cli, fake, tmp_path) -> None:
    """The whole set of an alignment, and a merged model, beside the scans."""
    from utopic_cli.multiway.merge import write_merged
    from utopic_cli.multiway.scans import find_scans

    scans = tmp_path / "scans"
    write_scans(scans, ["a.ply", "b.ply"])
    (scans / "truth.json").unlink()
    done = cli("align", scans / "a.ply", scans / "b.ply", "--out-dir", scans, "-q")
    assert done.exit_code == 0, done.stderr
    files = dict(enumerate(find_scans([scans]).scans))
    for name in ("merged.ply", "merged-2.ply"):
        write_merged(scans / name, {0: np.eye(4), 1: np.eye(4)}, files, seed=0)
    told = {one.path.name: one.reason for one in find_scans([scans]).aside}
    assert told.pop("transformation.txt") == "poses, not points"
    assert {told.pop("report.html"), told.pop("report.json")} == {"no scan format"}
    made = ["aligned.ply", "merged-2.ply", "merged.ply"]
    made += [f"{side}_{field}.ply" for side in ("source", "target") for field in ("overlap", "uncertainty")]
    assert told == dict.fromkeys(sorted(made), "made by utopic")
    assert [scan.name for scan in find_scans([scans]).scans] == ["a", "b"]
    assert {one.path.name for one in find_scans([scans / "*.ply"]).aside} == set(told)
    named = find_scans([scans / "merged.ply", scans / "aligned.ply"])  # who names them wants them
    assert not named.aside and len(named.scans) == 2
