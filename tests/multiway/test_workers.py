from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from functools import partial

import pytest

from utopic_cli.errors import InputError
from utopic_cli.multiway.workers import Workers
from utopic_cli.threads import threads_of_children


def work(job):
    if job == "crash":
        os._exit(3)
    if job == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if job == "hang":
        time.sleep(1000)
    if job == "rest":
        time.sleep(1.0)
    if job == "refuse":
        raise InputError("no good\nat all")
    if job == "bug":
        raise ValueError("oh")
    return {"job": job, "pid": os.getpid(), "threads": os.environ["OMP_NUM_THREADS"]}


def make_work(threads_seen=None):
    return work


def make_nothing():
    raise RuntimeError("can't begin")


def outcomes(jobs, count=2, timeout=30.0, make=make_work):
    with Workers(make, count, timeout, threads=3) as workers:
        return dict(workers.run(jobs))


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_what_crashes_costs_its_own_job_only():
    jobs = ["a", "crash", "b", "refuse", "killed", "bug", "c"]
    done = outcomes(jobs)
    assert sorted(done) == list(range(7))
    assert [done[i].result["job"] for i in (0, 2, 6)] == ["a", "b", "c"]
    assert "exit code 3" in done[1].problem and not done[1].lasting
    assert "SIGKILL" in done[4].problem and "memory" in done[4].problem
    assert done[3].problem == "no good at all" and done[3].lasting
    assert done[5].problem == "unexpected ValueError: oh" and not done[5].lasting
    pids = {done[i].result["pid"] for i in (0, 2, 6)}
    assert os.getpid() not in pids
    assert {done[i].result["threads"] for i in (0, 2, 6)} == {"3"}


def test_a_job_that_hangs_is_ended_and_the_others_go_on():
    begin = time.monotonic()
    done = outcomes(["hang", "a", "b"], timeout=2.0)
    assert time.monotonic() - begin < 30
    assert "longer than 2 s" in done[0].problem
    assert [done[i].result["job"] for i in (1, 2)] == ["a", "b"]


def test_processes_serve_many_jobs_and_several_runs():
    with Workers(partial(make_work, None), 1, 30.0) as workers:
        first = dict(workers.run(["a", "b"]))
        second = dict(workers.run(["c"]))
        assert list(workers.run([])) == []
    assert len({outcome.result["pid"] for outcome in [*first.values(), *second.values()]}) == 1


def test_a_task_that_can_not_be_made_fails_each_job():
    done = outcomes(["a", "b"], make=make_nothing, count=1)
    assert [done[i].problem for i in (0, 1)] == ["unexpected RuntimeError: can't begin"] * 2


def test_processes_end_with_the_block():
    with Workers(make_work, 1, 30.0) as workers:
        (_, outcome), *_ = workers.run(["a"])
    with pytest.raises(ProcessLookupError):
        os.kill(outcome.result["pid"], 0)


def test_threads_that_start_processes_at_once_leave_the_environment_as_it_was(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    inside = threading.Barrier(2, timeout=0.3)
    seen = []

    def start():
        with threads_of_children(1):
            seen.append(os.environ["OMP_NUM_THREADS"])
            with suppress(threading.BrokenBarrierError):  # two at once would meet here
                inside.wait()
                seen.append("met")

    threads = [threading.Thread(target=start) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == ["1", "1"]
    assert "OMP_NUM_THREADS" not in os.environ
