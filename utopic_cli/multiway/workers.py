"""Jobs in worker processes that may crash or hang: such a job is lost, and nothing else."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any

from utopic_cli.errors import InputError
from utopic_cli.threads import threads_of_children

Task = Callable[[Any], dict[str, Any]]
_Answer = tuple[dict[str, Any] | None, str | None, bool]  # result, problem, lasting


START_LIMIT_S = 300.0
"""A process that is not ready by then never will be; on a busy machine libraries take their time."""


class NotNow(Exception):
    """A job can't be done, but may be another time."""


@dataclass(frozen=True)
class Outcome:
    """What became of one job.

    Attributes:
        result: what the task returned, or None.
        problem: why there is no result, or None.
        lasting: whether trying again would end the same way: an input that can't be used would;
            a crash or a time limit need not.
        seconds: wall time.
    """

    result: dict[str, Any] | None
    problem: str | None
    lasting: bool
    seconds: float


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    job: int = -1
    since: float = 0.0
    ready: bool = False


class Workers:
    """A set of processes that serve jobs; used as a context manager.

    A process serves many jobs, so that the network is loaded and scans are read once; one that
    crashes or exceeds the time limit is replaced. Every process has ``threads`` threads and gets
    each job whole, so the results don't depend on how many there are.
    """

    def __init__(self, make_task: Callable[[], Task], count: int, timeout_s: float, threads: int = 1) -> None:
        """Prepare; processes start when there are jobs.

        Args:
            make_task: called once in every process; what it returns is called with each job. It
                is sent there, so it must be a function of a module, or a ``partial`` of one.
            count: most processes at a time.
            timeout_s: seconds a job may take, without the start of its process.
            threads: CPU threads of each process.
        """
        self._make_task = make_task
        self._count = count
        self._timeout_s = timeout_s
        self._threads = threads
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[_Worker] = []

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            self._end(worker)
        self._workers.clear()

    def kill(self) -> None:
        """End all processes at once, from another thread: jobs at work are lost."""
        for worker in list(self._workers):
            worker.process.kill()

    def run(self, jobs: Sequence[Any]) -> Iterator[tuple[int, Outcome]]:
        """Do jobs; yields (index of the job, outcome) as they end, in any order."""
        waiting = iter(range(len(jobs)))
        pending = len(jobs)
        idle = list(self._workers)
        while pending:
            while len(idle) + sum(w.job >= 0 for w in self._workers) < min(self._count, pending):
                idle.append(self._start())
            for worker in list(idle):
                index = next(waiting, None)
                if index is None:
                    break
                idle.remove(worker)
                worker.job, worker.since = index, time.monotonic()
                # A process that has died already is found out when its answer is read.
                with suppress(OSError):
                    worker.pipe.send(jobs[index])
            for worker in self._heard():
                outcome = self._outcome(worker)
                if outcome is None:
                    continue
                index, worker.job = worker.job, -1
                if worker in self._workers:
                    idle.append(worker)
                pending -= 1
                yield index, outcome

    def _heard(self) -> list[_Worker]:
        """Wait until a busy worker has answered, died or run out of time."""
        busy = [worker for worker in self._workers if worker.job >= 0]
        ends = [worker.since + (self._timeout_s if worker.ready else START_LIMIT_S) for worker in busy]
        answered = wait([worker.pipe for worker in busy], max(0.0, min(ends) - time.monotonic()))
        now = time.monotonic()
        return [worker for worker, end in zip(busy, ends) if worker.pipe in answered or now >= end]

    def _outcome(self, worker: _Worker) -> Outcome | None:
        """Return what became of a worker's job; None if it only said that it is ready."""
        seconds = time.monotonic() - worker.since
        if not worker.pipe.poll():
            self._workers.remove(worker)
            self._end(worker)
            if not worker.ready:
                return Outcome(None, "its process did not start; is the machine too busy?", False, seconds)
            return Outcome(None, f"took longer than {self._timeout_s:g} s and was ended", False, seconds)
        try:
            answer: _Answer | None = worker.pipe.recv()
            if answer is None:
                worker.ready, worker.since = True, time.monotonic()
                return None
            result, problem, lasting = answer
        except (EOFError, OSError):
            self._workers.remove(worker)
            self._end(worker)
            return Outcome(None, _obituary(worker.process.exitcode), False, seconds)
        return Outcome(result, problem, lasting, seconds)

    def _start(self) -> _Worker:
        mine, theirs = self._context.Pipe()
        process = self._context.Process(
            target=_serve, args=(theirs, self._make_task, os.getpid()), daemon=True
        )
        with threads_of_children(self._threads):
            process.start()
        theirs.close()  # so that the end of the process is the end of the pipe
        worker = _Worker(process, mine)
        self._workers.append(worker)
        return worker

    @staticmethod
    def _end(worker: _Worker) -> None:
        worker.pipe.close()
        worker.process.join(0.2)  # one that has died on its own keeps its exit code
        if worker.process.is_alive():
            worker.process.kill()
        worker.process.join()


def _obituary(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        with suppress(ValueError):
            name = signal.Signals(-exit_code).name
            hint = "; was there memory enough?" if name == "SIGKILL" else ""
            return f"its process was ended by {name}{hint}"
    return f"its process ended by itself (exit code {exit_code})"


def _serve(pipe: Connection, make_task: Callable[[], Task], parent: int) -> None:
    """Answer jobs until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent ends the others
    threading.Thread(target=_follow, args=(parent,), daemon=True).start()
    try:
        task, flaw = _made(make_task)
        pipe.send(None)  # ready
        while True:
            job = pipe.recv()
            try:
                if task is None:
                    raise flaw
                answer: _Answer = (task(job), None, False)
            except InputError as error:
                answer = (None, " ".join(str(error).splitlines()), True)
            except NotNow as error:
                answer = (None, " ".join(str(error).splitlines()), False)
            except MemoryError:
                answer = (None, "ran out of memory", False)
            except Exception as error:
                said = " ".join(str(error).splitlines())
                answer = (None, f"unexpected {type(error).__name__}: {said}", False)
            pipe.send(answer)
    except (EOFError, OSError):
        return


def _made(make_task: Callable[[], Task]) -> tuple[Task | None, Exception]:
    try:
        return make_task(), RuntimeError()
    except Exception as error:  # said of each job, for there may be nobody else to say it to
        return None, error


def _follow(parent: int) -> None:
    """End this process soon after its parent, even one that was killed while a job is at work."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
