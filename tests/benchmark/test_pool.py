from __future__ import annotations

import multiprocessing
import os
from functools import partial

import pytest

from utopic_cli.benchmark.pool import each
from utopic_cli.errors import InputError


def times(factor, number):
    return factor * number, os.getpid(), os.environ["OMP_NUM_THREADS"]


def make_times(factor):
    return partial(times, factor)


def refuse(number):
    raise InputError(f"number {number} is no good")


def make_refusal():
    return refuse


def die(number):
    os._exit(9)


def make_death():
    return die


def test_results_come_in_order_from_other_processes_of_one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    seen = []
    results = each(partial(make_times, 3), 5, 2, lambda done, of: seen.append((done, of)))
    assert [value for value, _, _ in results] == [0, 3, 6, 9, 12]
    assert os.getpid() not in {process for _, process, _ in results}
    assert {threads for _, _, threads in results} == {"1"}
    assert seen == [(done, 5) for done in range(6)]
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_what_a_task_raises_is_raised_here():
    with pytest.raises(InputError, match="number 0 is no good") as raised:
        each(make_refusal, 3, 1)
    assert "in refuse" in str(raised.value.__cause__)  # where, for --debug


def test_a_dead_process_is_said_to_be_dead():
    with pytest.raises(RuntimeError, match="died"):
        each(make_death, 2, 1)


def square(number, answer):
    answer.put(number**2)


def ask_a_child(number):
    context = multiprocessing.get_context("spawn")
    answer = context.SimpleQueue()
    child = context.Process(target=square, args=(number, answer))
    child.start()
    found = answer.get()
    child.join()
    return found


def make_parents():
    return ask_a_child


def test_tasks_may_have_processes_of_their_own():
    assert each(make_parents, 2, 1) == [0, 1]
