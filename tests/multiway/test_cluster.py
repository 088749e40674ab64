from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from tests.multiway.stubs import make_stub, write_scans
from tests.multiway.test_workers import make_work
from utopic_cli import __version__
from utopic_cli.bridge import load_network
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.multiway import batch as room
from utopic_cli.multiway.batch import run_batch
from utopic_cli.multiway.journal import fingerprint
from utopic_cli.multiway.plan import BatchRequest
from utopic_cli.multiway.tasks import make_worker
from utopic_cli.multiway.workers import NotNow

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")


@pytest.fixture(autouse=True)
def light(monkeypatch):
    """No network: its weights' hash is all that a batch itself needs of it."""
    monkeypatch.setattr(
        room, "weights_of", lambda options: {"name": "stub", "sha256": "stub", "card": "stub"}
    )


class Dask:
    """A scheduler and workers on this machine, each in a process of its own."""

    def __init__(self, folder):
        self._folder = folder
        self._environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
        self._processes = []
        place = folder / "scheduler.json"
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", place
        )
        while not (place.exists() and place.read_text().endswith("}")):
            assert self.scheduler.poll() is None
            time.sleep(0.05)
        self.address = json.loads(place.read_text())["address"]

    def worker(self, *options):
        return self._start("worker", self.address, "--nthreads", "1", "--no-dashboard", *options)

    def _start(self, *arguments):
        command = [sys.executable, "-m", "dask", *map(str, arguments)]
        log = (self._folder / "dask.log").open("ab")
        process = subprocess.Popen(
            command, env=self._environment, cwd=self._folder, stdout=log, stderr=log, start_new_session=True
        )
        log.close()
        self._processes.append(process)
        return process

    def close(self):
        for process in self._processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def dask(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "dask").mkdir()
    cluster = Dask(tmp_path / "dask")
    yield cluster
    cluster.close()


def records(folder):
    """What the pairs' records say, without the time each took."""
    found = {path.name: json.loads(path.read_text()) for path in folder.glob("pairs/*.json")}
    return {name: {**record, "seconds": None} for name, record in found.items()}


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_midway_gives_what_one_machine_gives(dask, tmp_path, monkeypatch):
    """A nanny would start the killed worker anew: one of the two has none, so that it stays away."""
    names = ["s0", "s1", "s2", "s3", "s4", "crash", "hang"]
    write_scans(tmp_path / "scans", [f"{name}.ply" for name in names])
    pairs = [f"{a},{b}" for i, a in enumerate(names[:5]) for b in names[:i]] + ["crash,s0", "hang,s1"]
    (tmp_path / "pairs.csv").write_text("\n".join(pairs))
    monkeypatch.chdir(tmp_path)  # the paths are relative, and the workers were started elsewhere
    log = tmp_path / "log"
    lost = dask.worker("--no-nanny")
    dask.worker()
    here = BatchRequest((Path("scans"),), Path("here"), "pairs.csv", timeout_s=5.0, workers=2)
    run_batch(here, make_task=partial(make_stub))
    killed = threading.Event()

    def kill_midway():
        while len(list(Path("there").glob("pairs/*.json"))) < 3:
            time.sleep(0.02)
        lost.kill()
        killed.set()

    threading.Thread(target=kill_midway, daemon=True).start()
    there = BatchRequest((Path("scans"),), Path("there"), "pairs.csv", timeout_s=5.0, cluster=dask.address)
    outcome = run_batch(there, make_task=partial(make_stub, str(log), True, 0.3))
    assert killed.is_set() and lost.wait(5) == -signal.SIGKILL
    assert len(outcome.model.pairs) == 12 and outcome.exit_code == 6
    ours, theirs = records(Path("here")), records(Path("there"))
    failed = {name for name, record in theirs.items() if record["status"] == "failed"}
    assert failed == {"crash--s0.json", "hang--s1.json"}
    assert theirs == ours
    assert (tmp_path / "there" / "poses.json").read_bytes() == (tmp_path / "here" / "poses.json").read_bytes()
    tried = Counter(log.read_text().split())
    # Once more: the pair that was at work there, and one that was done but not yet handed over.
    assert len(tried) == 12 and max(tried.values()) <= 2 and tried.total() <= 14


def test_a_scheduler_that_is_not_there_is_said_soon(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    from utopic_cli.multiway import cluster

    assert cluster.REACHED_WITHIN_S <= 5.0
    monkeypatch.setattr(cluster, "REACHED_WITHIN_S", 0.5)
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    with socket.socket() as other:  # is there, and never answers
        other.bind(("127.0.0.1", 0))
        other.listen()
        for address in ("tcp://127.0.0.1:1", f"tcp://127.0.0.1:{other.getsockname()[1]}", "nonsense"):
            begin = time.monotonic()
            with pytest.raises(InputError, match=f"{address}: no Dask scheduler answers there") as caught:
                run_batch(BatchRequest((tmp_path / "scans",), tmp_path / "out", cluster=address))
            assert "\n" not in str(caught.value)
            assert time.monotonic() - begin < 10


def test_without_dask_the_missing_part_is_named(tmp_path, monkeypatch):
    write_scans(tmp_path / "scans", ["a.ply", "b.ply"])
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "utopic_cli.multiway.cluster", raising=False)
    with pytest.raises(UsageError, match=r"pip install 'utopic-cli\[cluster\]'"):
        run_batch(BatchRequest((tmp_path / "scans",), tmp_path / "out", cluster="tcp://127.0.0.1:1"))


def test_processes_of_a_cluster_worker_serve_many_jobs_and_end_when_idle(monkeypatch):
    pytest.importorskip("distributed")
    from utopic_cli.multiway import cluster

    monkeypatch.setattr(cluster, "IDLE_S", 0.3)
    station = cluster.Station(make_work, 30.0, 1)
    station.setup(None)
    first = station.do("a").result
    assert station.do("b").result["pid"] == first["pid"]  # what it has read it still has
    with ThreadPoolExecutor(2) as threads:  # a worker with two threads has two processes
        both = [threads.submit(station.do, "rest") for _ in range(2)]
        pids = {future.result().result["pid"] for future in both}
    assert len(pids) == 2 and first["pid"] in pids
    until = time.monotonic() + 10
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < until:
        time.sleep(0.05)
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert station.do("c").result["pid"] not in pids
    with ThreadPoolExecutor(1) as threads:
        late = threads.submit(station.do, "hang")
        while not station._busy:
            time.sleep(0.01)
        time.sleep(0.3)
        station.teardown(None)
        assert "SIGKILL" in late.result(10).problem
    station.teardown(None)


def test_a_worker_with_another_program_or_other_weights_says_so():
    card = fingerprint(load_network("utopic", "cpu")[1])
    options = AlignOptions(device="cpu")
    assert callable(make_worker(options, __version__, card))
    with pytest.raises(NotNow, match=r"another version of utopic-cli .*; install the same there"):
        make_worker(options, "0.0.0", card)
    with pytest.raises(NotNow, match="another card of the weights"):
        make_worker(options, __version__, "0123456789abcdef")


@pytest.mark.slow
def test_a_scheduler_that_is_lost_ends_the_batch_with_what_is_done(dask, tmp_path):
    write_scans(tmp_path / "scans", [f"s{i}.ply" for i in range(5)])
    dask.worker("--no-nanny")
    asked = BatchRequest((tmp_path / "scans",), tmp_path / "out", cluster=dask.address)

    def kill_midway():
        while len(list(tmp_path.glob("out/pairs/*.json"))) < 2:
            time.sleep(0.02)
        dask.scheduler.kill()

    threading.Thread(target=kill_midway, daemon=True).start()
    with pytest.raises(InputError, match="the scheduler is lost; what is done stays"):
        run_batch(asked, make_task=partial(make_stub, "", True, 0.5))
    done = len(list(tmp_path.glob("out/pairs/*.json")))
    assert 2 <= done < 10
    again = BatchRequest((tmp_path / "scans",), tmp_path / "out", resume=True)
    assert run_batch(again, make_task=partial(make_stub)).resumed == done
