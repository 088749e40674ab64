"""Independent tasks in processes of one thread each, so that their number changes no result."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from utopic_cli.threads import threads_of_children

Result = TypeVar("Result")


def each(
    make_task: Callable[[], Callable[[int], Result]],
    count: int,
    workers: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Result]:
    """Call a task with 0 to ``count - 1`` in processes of their own.

    Threads change the order of sums and so the last bits; every process, even an only one, is
    started anew with one thread, so the results are the same for any number of workers.

    Args:
        make_task: called once in every process; what it returns is called with the numbers. It is
            sent there, so it must be a function of a module, or a ``partial`` of one.
        count: of numbers.
        workers: processes, at least 1.
        progress: called with (done, of).

    Returns:
        The results in the order of the numbers.

    Raises:
        Exception: what a task raised first.
        RuntimeError: a process died (most often for want of memory).
    """
    results: dict[int, Result] = {}
    waiting = iter(range(count))
    processes: list[BaseProcess] = []
    pipes: list[Connection] = []
    try:
        context = multiprocessing.get_context("spawn")
        with threads_of_children(1):
            for _ in range(min(workers, count)):
                mine, theirs = context.Pipe()
                # No daemon: those may not have processes of their own, which some methods need.
                process: BaseProcess = context.Process(target=_serve, args=(theirs, make_task))
                process.start()
                theirs.close()  # so that the end of the process is the end of the pipe
                processes.append(process)
                pipes.append(mine)
                _send(mine, next(waiting))
        if progress is not None:
            progress(0, count)
        while len(results) < count:
            for pipe in wait(pipes):
                assert isinstance(pipe, Connection)
                number, result = _receive(pipe)
                results[number] = result
                if progress is not None:
                    progress(len(results), count)
                with suppress(StopIteration):
                    _send(pipe, next(waiting))
    finally:
        for pipe in pipes:
            pipe.close()
        for process in processes:
            process.terminate()
            process.join()
    return [results[number] for number in range(count)]


DIED = "a worker process died; was there memory enough? Try fewer --workers"


def _send(pipe: Connection, number: int) -> None:
    try:
        pipe.send(number)
    except OSError as error:
        raise RuntimeError(DIED) from error


def _receive(pipe: Connection) -> tuple[int, Any]:
    try:
        number, result, error, where = pipe.recv()
    except (EOFError, OSError) as broken:
        raise RuntimeError(DIED) from broken
    if error is not None:
        raise error from RuntimeError(where)  # the traceback there, for --debug
    return number, result


def _serve(pipe: Connection, make_task: Callable[[], Callable[[int], Any]]) -> None:
    """Answer numbers until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent ends the others
    try:
        task = make_task()
        while True:
            number = pipe.recv()
            pipe.send((number, task(number), None, None))
    except EOFError:
        return
    except Exception as error:
        pipe.send((-1, None, error, traceback.format_exc()))
