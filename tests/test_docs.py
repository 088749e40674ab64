"""The documentation is sound: its programs run, its options exist, its links lead somewhere.

``test_docs_commands.py`` runs the commands.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from tests.command_line import all_commands
from tests.documentation import PAGES, ROOT, fences
from tests.test_docs_commands import furnish
from utopic_cli.cli import app

# Programs that the text names with options of their own.
FOREIGN = ("dask ",)


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with stand-ins for the files that the documentation speaks of."""
    folder = tmp_path_factory.mktemp("workshop")
    furnish(folder)
    return folder


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(text, id=f"{page.relative_to(ROOT).as_posix()} {number}")
        for page in PAGES
        for number, (language, text) in enumerate(fences(page))
        if language == "python"
    ],
)
def test_the_programs_run(program: str, workshop: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workshop)
    exec(compile(program, "program", "exec"), {})


def test_the_json_is_sound() -> None:
    for page in PAGES:
        for language, text in fences(page):
            if language == "json":
                json.loads(text)


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
