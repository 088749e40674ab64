from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from utopic_cli.commands import console
from utopic_cli.commands.console import Console, complete_weights


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


@pytest.fixture
def terminal(monkeypatch):
    """A console that takes stderr for a terminal of a given width."""

    def make(width, **variables):
        for name, value in {"TERM": "xterm-256color", "COLUMNS": str(width), **variables}.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("FORCE_COLOR", "1")  # what rich takes for a terminal
        return Console()

    return make


LONG = "a reason that is far too long for one line of a narrow terminal, so that it has to be folded"


@pytest.mark.parametrize("width", [60, 80, 120])
def test_on_a_terminal_facts_are_folded_into_a_column(terminal, capsys, width):
    terminal(width, NO_COLOR="1").fact("because", LONG)
    lines = re.sub("\\x1b\\[[0-9;]*m", "", capsys.readouterr().err).rstrip().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    assert lines[0].startswith("  because  a reason")
    assert all(line.startswith(" " * 11) for line in lines[1:])
    assert len(lines) == (1 if width == 120 else 2)
    assert " ".join(line[11:].strip() for line in lines) == LONG


def test_in_a_pipe_facts_are_one_plain_line(capsys):
    console = Console()
    console.headline("a -> b:", "aligned", True)
    console.fact("because", LONG)
    console.files([Path("out/T.txt"), Path("out/r.json"), Path("T.npy")])
    assert capsys.readouterr().err.splitlines() == [
        "a -> b: aligned",
        f"  because  {LONG}",
        f"  wrote    out{os.sep}: T.txt, r.json",
        "  wrote    T.npy",
    ]


def test_colours_come_with_a_terminal_and_go_with_no_color(terminal, capsys):
    terminal(80).headline("a -> b:", "aligned", True)
    assert "\x1b[1;32m" in capsys.readouterr().err
    terminal(80).headline("a -> b:", "aligned, but", False)
    assert "\x1b[1;33m" in capsys.readouterr().err
    terminal(80, NO_COLOR="1").headline("a -> b:", "aligned", True)
    assert not re.search("\\x1b\\[[0-9;]*3[0-9]", capsys.readouterr().err)


def test_what_counts_gets_a_bar(terminal, capsys):
    with terminal(80).progress() as progress:
        progress("3/4, about 0:10 left: a--b")
        time.sleep(0.3)
    shown = capsys.readouterr().err
    assert "3/4, about 0:10 left: a--b" in shown
    assert "━" * (3 * console.BAR_WIDTH // 4) in shown


def complete(line, folder):
    """Return what bash would be offered for a line."""
    words = line.split(" ")
    environment = {
        "_UTOPIC_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
    }
    process = subprocess.run(
        [sys.executable, "-c", "from utopic_cli.cli import main; main()"],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )
    return process.stdout.split()


def test_a_shell_completes_protocols_weights_and_choices(tmp_path):
    assert complete("utopic bench range", tmp_path) == ["range-scans"]
    assert {"modelnet", "overlap-sweep", "speed", "confidence"} <= set(complete("utopic bench ", tmp_path))
    assert {"align", "batch", "apply", "bench"} <= set(complete("utopic ", tmp_path))
    assert complete("utopic align a.ply b.ply --weights u", tmp_path) == ["utopic"]
    assert complete("utopic bench modelnet --weights ut", tmp_path) == ["utopic"]
    assert complete("utopic align a b --colormap b", tmp_path) == ["blue-red"]
    (tmp_path / "mine.safetensors").touch()
    (tmp_path / "mine.json").touch()
    (tmp_path / "more").mkdir()
    assert complete_weights(f"{tmp_path}/m") == [f"{tmp_path}/mine.safetensors", f"{tmp_path}/more/"]


def test_completion_is_quick():
    code = "import sys; from utopic_cli.commands.console import complete_weights as c; c('u'); "
    code += "print([name for name in ('torch', 'numpy') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.stdout == "[]\n"


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
