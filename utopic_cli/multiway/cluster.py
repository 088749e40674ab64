"""Jobs on the machines of a Dask cluster: each of its threads runs one process like those of ``workers``.

The scheduler hands out jobs and gives those of a machine that is lost to another. The processes are
ours, so that a crash or a hang costs its pair only, there as here, and scans are read once in each.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

from distributed import Client, Future, KilledWorker, Worker, WorkerPlugin, get_worker, rpc

from utopic_cli.errors import InputError
from utopic_cli.multiway.workers import START_LIMIT_S, Outcome, Task, Workers

REACHED_WITHIN_S = 5.0
"""A scheduler that does not answer by then is not there."""

LOOK_AROUND_S = 5.0
"""How often to see whether scheduler and workers are still there while no job ends."""

IDLE_S = 300.0
"""A Dask worker ends our processes after this long without a job: the batch may have been killed."""


class Station(WorkerPlugin):
    """What one Dask worker keeps for one batch: a process for each of its threads that is at work."""

    def __init__(self, make_task: Callable[[], Task], timeout_s: float, threads: int) -> None:
        """Prepare; see ``Workers``."""
        self._prepared = (make_task, 1, timeout_s, threads)

    def setup(self, worker: Worker) -> None:
        """Begin on a Dask worker."""
        # A nanny starts workers as daemons, which may have no processes; ours follow their parent anyway.
        multiprocessing.current_process().daemon = False
        self._lock = threading.Lock()
        self._idle: list[Workers] = []
        self._busy: list[Workers] = []
        self._timer: threading.Timer | None = None

    def teardown(self, worker: Worker) -> None:
        """End all processes, those at work too."""
        with self._lock:
            for busy in self._busy:
                busy.kill()
        self._dismiss()

    def do(self, job: Any) -> Outcome:
        """Do a job in a process that is free, or in a new one."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            workers = self._idle.pop() if self._idle else Workers(*self._prepared)
            self._busy.append(workers)
        try:
            ((_, outcome),) = workers.run([job])
        finally:
            with self._lock:
                self._busy.remove(workers)
                self._idle.append(workers)
                if not self._busy:
                    self._timer = threading.Timer(IDLE_S, self._dismiss)
                    self._timer.daemon = True
                    self._timer.start()
        return outcome

    def _dismiss(self) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            for workers in self._idle:
                workers.close()
            self._idle.clear()


class Cluster:
    """The threads of an existing Dask cluster as ``Workers``; used as a context manager.

    All machines must see the scans and the weights under the same paths, and have the same version of
    this package: what differs is found by the hashes of the files, and said.
    """

    def __init__(self, address: str, make_task: Callable[[], Task], timeout_s: float, threads: int) -> None:
        """Prepare.

        Args:
            address: of the scheduler, like ``tcp://host:8786``.
            make_task: see ``Workers``.
            timeout_s: seconds a job may take, without the start of its process.
            threads: CPU threads of each process.
        """
        self._address = address
        self._station = Station(partial(_made_in, os.getcwd(), make_task), timeout_s, threads)
        self._name = f"utopic-{uuid.uuid4().hex}"
        self._futures: list[Future] = []

    def __enter__(self) -> Cluster:
        """Reach the scheduler, and make its workers ready.

        Raises:
            InputError: there is no scheduler, or its workers lack this package.
        """
        self._log_level = logging.getLogger("distributed").level
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is raised
        try:
            # A client would wait for ever for something else that listens there and says nothing.
            with ThreadPoolExecutor(1) as thread:  # for there may be an event loop in this one
                thread.submit(asyncio.run, _greet(self._address)).result()
            self._client = Client(self._address, timeout=REACHED_WITHIN_S, set_as_default=False)
        except (OSError, ValueError, TypeError, asyncio.TimeoutError) as error:
            logging.getLogger("distributed").setLevel(self._log_level)
            raise InputError(
                f"{self._address}: no Dask scheduler answers there ({_line(error)}); "
                "check the address, or start one with 'dask scheduler'"
            ) from None
        try:
            self._client.register_plugin(self._station, name=self._name)
        except Exception as error:  # whatever a worker met when it loaded our code
            self.close()
            raise InputError(
                f"{self._address}: its workers can't run this ({type(error).__name__}: {_line(error)}); "
                "install the same utopic-cli[cluster] there"
            ) from None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the cluster; what is at work there ends with its process."""
        if self._client.status == "running":
            with suppress(Exception):
                self._client.cancel(self._futures, force=True)
                self._client.unregister_worker_plugin(self._name)
        self._client.close(timeout=REACHED_WITHIN_S)
        logging.getLogger("distributed").setLevel(self._log_level)

    def run(self, jobs: Sequence[Any]) -> Iterator[tuple[int, Outcome]]:
        """Do jobs; yields (index of the job, outcome) as they end, in any order.

        Raises:
            InputError: the scheduler is lost, or has no workers.
        """
        self._futures = self._client.map(partial(_do, self._name), jobs, pure=False, key=self._name)
        number = {future.key: i for i, future in enumerate(self._futures)}
        ended: SimpleQueue[Future] = SimpleQueue()
        for future in self._futures:
            future.add_done_callback(ended.put)
        idle_s = 0.0
        for _ in jobs:
            while True:
                try:
                    future = ended.get(timeout=LOOK_AROUND_S)
                    break
                except Empty:
                    idle_s = 0.0 if self._manned() else idle_s + LOOK_AROUND_S
                if idle_s >= START_LIMIT_S:
                    raise InputError(
                        f"{self._address}: the scheduler has had no workers for {START_LIMIT_S:.0f} s; "
                        "start some with 'dask worker' and go on with --resume"
                    )
            yield number[future.key], self._outcome(future)

    def _manned(self) -> bool:
        """Tell whether there is any worker."""
        try:
            if self._client.status == "running":
                return bool(self._client.nthreads())
        except (OSError, ValueError):
            pass
        raise self._lost()

    def _outcome(self, future: Future) -> Outcome:
        if future.cancelled() or self._client.status != "running":
            raise self._lost()
        try:
            outcome: Outcome = future.result()
        except KilledWorker:
            return Outcome(None, "several workers of the cluster were lost while at it", False, 0.0)
        except Exception as error:
            if self._client.status != "running":
                raise self._lost() from None
            return Outcome(None, f"unexpected {type(error).__name__}: {_line(error)}", False, 0.0)
        future.release()  # the scheduler need not keep what is written here
        return outcome

    def _lost(self) -> InputError:
        return InputError(
            f"{self._address}: the scheduler is lost; what is done stays: go on with --resume when it is back"
        )


async def _greet(address: str) -> None:
    """Make sure that a scheduler answers soon."""
    async with rpc(address) as scheduler:
        identity = await asyncio.wait_for(scheduler.identity(), REACHED_WITHIN_S)
    if identity.get("type") != "Scheduler":
        raise ValueError(f"it is a {identity.get('type')}")


def _do(name: str, job: Any) -> Outcome:
    """Do a job on the Dask worker that this runs on."""
    station = get_worker().plugins[name]
    assert isinstance(station, Station)
    return station.do(job)


def _made_in(folder: str, make_task: Callable[[], Task]) -> Task:
    """Make a task where relative paths mean what they mean to the batch, if the folder is there too."""
    with suppress(OSError):
        os.chdir(folder)
    return make_task()


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
