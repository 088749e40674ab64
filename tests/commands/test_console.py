from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from utopic_cli.commands import console
from utopic_cli.commands.console import Console


@pytest.mark.parametrize(("seconds", "said"), [(1e6, ""), (0.0, "  at work: one\n  at work: two\n")])
def test_without_a_terminal_progress_is_a_line_now_and_then(monkeypatch, capsys, seconds, said):
    monkeypatch.setattr(console, "SECONDS_BETWEEN_LINES", seconds)
    with Console().progress() as progress:
        progress("one")
        progress("two")
    assert capsys.readouterr().err == said


def test_quiet_shows_no_progress(monkeypatch, capsys):
    monkeypatch.setattr(console, "SECONDS_BETWEEN_LINES", 0.0)
    with Console(quiet=True).progress() as progress:
        progress("one")
    assert capsys.readouterr().err == ""


WAITING = """
import signal, sys, time, utopic_cli.io.scan
# As from a terminal: a job in the background of a script inherits Ctrl-C as ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
from utopic_cli.cli import main
def wait(*_, **__):
    print("reading", flush=True)
    time.sleep(60)
utopic_cli.io.scan.read_scan = wait
sys.modules["utopic_cli.pipeline"] = sys
sys.argv = ["utopic", "align", "a.ply", "b.ply", "--out-dir", "out"]
main()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals are sent")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_with_130_one_line_and_nothing_left(tmp_path, number):
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "reading\n"
    time.sleep(0.1)
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said == "utopic: interrupted\n"
    assert list(tmp_path.iterdir()) == []
