"""Rules of the house that no single room can keep."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import utopic_cli
from tests.command_line import all_commands, parse

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


COMMANDS = list(all_commands())


@pytest.mark.parametrize(("path", "command"), COMMANDS, ids=[" ".join(path) for path, _ in COMMANDS])
def test_every_command_shows_an_example_that_works_and_stands_under_a_heading(path, command):
    found = re.findall(r"Example: \[bold\](.+?)\[/bold\]", command.help or "")
    assert len(found) == 1, "let its docstring end in 'Example: [bold]utopic ...[/bold]'"
    assert parse(found[0]) == path
    assert command.rich_help_panel, "give it a rich_help_panel"
    for option in command.params:
        assert option.help or option.name == "help", f"{option.name}: say what it does"


def test_the_workflow_runs_on_every_python_that_is_promised():
    yaml = pytest.importorskip("yaml")
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))["jobs"]
    matrix = jobs["test"]["strategy"]["matrix"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f">={matrix['python'][0]}" == project["requires-python"]
    assert len(matrix["python"]) == 4 and len(matrix["os"]) == 3
    steps = [step.get("run", "") for job in jobs.values() for step in job["steps"]]
    assert any("pytest" in step for step in steps) and any("cmp" in step for step in steps)
    assert all("-c constraints.txt" in step for step in steps if "pip install" in step and "pipx" not in step)


def test_the_citation_names_the_paper():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    yaml = pytest.importorskip("yaml")
    card = yaml.safe_load(text)
    assert card["cff-version"] == "1.2.0" and card["license"] == "Apache-2.0"
    assert "UTOPIC" in card["preferred-citation"]["title"] and len(card["preferred-citation"]["authors"]) == 8
