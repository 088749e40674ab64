"""Rules of the house that no single room can keep."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import utopic_cli

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
HEAVY = ("torch", "open3d", "trimesh", "scipy", "numpy")


def run_python(*arguments, **kwargs):
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120, **kwargs
    )


def test_imports_go_down_only():
    script = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports())"
    result = run_python("-c", script)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]


@pytest.mark.parametrize("arguments", [["--help"], ["align", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments):
    script = (
        "import sys; from utopic_cli.cli import app\n"
        "try: app(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        f"print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    result = run_python("-c", script, *arguments)
    assert result.stderr.splitlines()[-1] == "[]"


def test_help_is_quick():
    resource = pytest.importorskip("resource", reason="process times are measured on Unix only")
    run_python("-m", "utopic_cli", "--help")  # compiled files are written once
    seconds = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert run_python("-m", "utopic_cli", "--help").returncode == 0
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    # About 0.25 s of processor time; importing torch alone takes more than a second.
    assert min(seconds) < 0.8


def test_the_version_is_written_once():
    pattern = re.compile(rf"(?<![\d.]){re.escape(utopic_cli.__version__)}(?![\d.])")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" not in project["project"]
    holders = {
        path.relative_to(ROOT).as_posix()
        for path in (*ROOT.glob("utopic_cli/**/*.py"), ROOT / "README.md", ROOT / "CITATION.cff")
        if pattern.search(path.read_text(encoding="utf-8"))
    }
    assert holders == {"utopic_cli/__init__.py"}


def test_the_convention_is_stated_where_people_look():
    convention = "p_target = T_target_source @ p_source"
    assert convention in (utopic_cli.__doc__ or "")
    assert convention in (ROOT / "README.md").read_text(encoding="utf-8")
    assert convention in run_python("-m", "utopic_cli", "--help").stdout
    assert convention in run_python("-m", "utopic_cli", "align", "--help").stdout


def test_constraints_pin_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [
        *project["dependencies"],
        *(one for extra in project["optional-dependencies"].values() for one in extra),
    ]
    wanted = {re.split(r"[^\w.-]", one)[0].lower().replace("_", "-") for one in named} - {"tomli"}
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in pins if "==" in line}
    assert wanted <= pinned
    assert not [line for line in pins if "+" in line], "a local version exists on some indexes only"


def test_usage_errors_exit_2_and_the_module_runs_like_the_command():
    result = run_python("-m", "utopic_cli", "align", "--no-such-option", env={**os.environ, "NO_COLOR": "1"})
    assert result.returncode == 2
    assert result.stderr.splitlines() == [
        "utopic: error: No such option: --no-such-option; see 'utopic align --help'"
    ]
