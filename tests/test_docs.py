"""Every command and program in the documentation does what it says there, or at least would be understood.

A command in a fenced block is run as it stands; some in a smaller form, by the table SMALLER; some are
only parsed, by the table PARSED; those that are no ``utopic`` have a check of their own in OTHERS. One
that is in no table is run, and so a new one that can't be run here fails until it is put into one.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from tests.command_line import all_commands, parse
from utopic_cli.cli import app
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.synthesis.demo_object import demo_pair

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    [*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "weights" / "README.md"]
)

# What is run in a smaller form: a part of the command, and what stands in its place.
SMALLER = {
    "utopic batch scans/ --out-dir model": "utopic batch scans/ --out-dir model --points 256 --workers 1",
}

# What takes minutes, or data that are not in this repository: its options are checked, no more.
# Training, calibration and every protocol are run, small, by the tests of their own rooms.
PARSED = (
    "utopic train",
    "utopic calibrate",
    "utopic bench",
    "utopic align a.ply b.ply --weights runs/mine/utopic.safetensors",
)


# Programs that the text names with options of their own.
FOREIGN = ("dask ",)

SHOWN = "utopic align demo/source.ply demo/target.ply --out-dir result"


def _make_knows(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def _pip_takes(command: str) -> None:
    """All but the network and the installing, which ``test_wheel.py`` does."""
    offline = ["--dry-run", "--no-deps", "--no-index", "--no-build-isolation"]
    done = subprocess.run(
        [sys.executable, "-m", *shlex.split(command), *offline],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert done.returncode == 0 and "Would install utopic-cli" in done.stdout, done.stderr


PIP = "pip install -c constraints.txt ."


# Commands that are not ours, and how they are checked.
OTHERS = {
    "make demo": lambda: _make_knows("demo"),
    "make test": lambda: _make_knows("test"),
    PIP: lambda: _pip_takes(PIP),
    "torchrun --nproc-per-node 2 -m utopic_cli train --out runs/two": lambda: parse(
        "utopic train --out runs/two"
    ),
    # Run, and its output compared, by a test of its own.
    SHOWN: lambda: None,
}


def fences(page: Path) -> Iterator[tuple[str, str]]:
    """Yield the language and the text of every fenced block of a page."""
    for found in re.finditer(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S):
        yield found[1], found[2]


def commands() -> list[Any]:
    """Return every command of every fenced block without a language, with the page it stands on."""
    found = []
    for page in PAGES:
        for language, text in fences(page):
            assert language in ("", "text", "python", "toml", "json"), (
                f"{page}: say in test_docs.py what {language} is"
            )
            lines = text.replace("\\\n", " ").splitlines() if not language else []
            for line in lines:
                command = " ".join(re.sub(r"(^|\s)#.*", "", line).split())
                if command:
                    found.append(pytest.param(command, id=f"{page.relative_to(ROOT)}: {command}"))
    return found


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with stand-ins for the files that the documentation speaks of."""
    folder = tmp_path_factory.mktemp("workshop")
    pair = demo_pair(np.random.default_rng(0))
    for name in ("demo", "scans"):
        (folder / name).mkdir()
    for cloud, names in (
        (pair.source, ("a.ply", "in.ply", "demo/source.ply", "scans/one.ply")),
        (pair.target, ("b.ply", "demo/target.ply", "scans/two.ply")),
    ):
        points = cloud.points[::4]
        for name in names:
            (folder / name).write_bytes(scalar_cloud_ply(points, np.zeros(points.shape, np.uint8), {}))
    np.savetxt(folder / "T.txt", pair.gt_T_target_source)
    return folder


@pytest.fixture
def here(workshop: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(workshop)
    return workshop


@pytest.mark.parametrize("command", commands())
def test_every_command_is_understood_and_works(command: str, here: Path) -> None:
    if command in OTHERS:
        OTHERS[command]()
        return
    parse(command)
    if command.startswith(PARSED):
        return
    smaller = command
    for part, instead in SMALLER.items():
        smaller = smaller.replace(part, instead)
    if "--overwrite" not in smaller and any(word in smaller for word in ("-o ", "--out-dir")):
        smaller += " --overwrite"  # the same files are written by several commands
    result = CliRunner().invoke(app, shlex.split(smaller)[1:])
    assert result.exit_code == 0, result.output


def test_the_tables_name_nothing_that_is_gone() -> None:
    said = [one.values[0] for one in commands()]
    for part in (*SMALLER, *PARSED, *OTHERS):
        assert any(command.startswith(part) for command in said), f"{part}: in no fenced block"


def test_the_programs_run(here: Path) -> None:
    programs = [(page, text) for page in PAGES for language, text in fences(page) if language == "python"]
    assert programs
    for page, text in programs:
        exec(compile(text, str(page), "exec"), {})


def test_the_json_is_sound() -> None:
    for page in PAGES:
        for language, text in fences(page):
            if language == "json":
                json.loads(text)


def test_the_output_in_the_readme_is_that_of_its_command(here: Path) -> None:
    """But for the numbers, which are those of the whole demo."""
    blocks = list(fences(ROOT / "README.md"))
    place = next(i for i, (_, text) in enumerate(blocks) if text.strip() == SHOWN)
    shown = blocks[place + 1][1]
    result = CliRunner().invoke(app, [*shlex.split(SHOWN)[1:], "--overwrite"])
    said = [line for line in result.stderr.splitlines() if not line.startswith("  at work: ")]
    assert [_without_numbers(line) for line in said] == [
        _without_numbers(line) for line in shown.splitlines()
    ]


def _without_numbers(line: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "#", line.replace("\\", "/").replace("over ", ""))


OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


def _running_text(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_named_alone_are_those_of_some_command(page: Path) -> None:
    known = {option for _, command in all_commands() for option in _options(command)}
    for code in re.findall(r"`([^`]+)`", _running_text(page)):
        if not code.startswith(("utopic ", *FOREIGN)):
            unknown = set(OPTION.findall(code)) - known
            assert not unknown, f"{page.name}: `{code}`"


def _options(command: Any) -> set[str]:
    return {option for one in command.params for option in (*one.opts, *one.secondary_opts)} | {"--help"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_named_in_the_text_exist(page: Path) -> None:
    text = _running_text(page)
    for found in re.finditer(r"`utopic ([^`]+)`", text):
        words = found[1].split()
        parser: Any = typer.main.get_command(app)
        while words and hasattr(parser, "commands"):
            if words[0] == "PROTOCOL" or words[0].startswith("-"):
                break
            assert words[0] in parser.commands, f"{page.name}: `utopic {found[1]}`"
            parser = parser.commands[words.pop(0)]
        known = _options(parser)
        for option in OPTION.findall(" ".join(words)):
            assert option in known, f"{page.name}: `utopic {found[1]}` has no {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_picture_can_be_made_anew() -> None:
    """The command that CONTRIBUTING.md gives for it."""
    done = subprocess.run(
        [sys.executable, "-m", "utopic_cli.benchmark.picture", "--help"],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=ROOT,
    )
    assert done.returncode == 0 and "--overwrite" in done.stdout
