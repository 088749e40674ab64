"""The pages of the documentation: their fenced blocks, and the commands that stand in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    [*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "weights" / "README.md"]
)
LANGUAGES = ("", "text", "python", "toml", "json")

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)
_TABLE_OF_FILES = re.compile(r"^\| file \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", re.M)


@dataclass(frozen=True)
class Command:
    """A command as it stands on a page.

    Attributes:
        page: the page, relative to the repository.
        line: the whole command, without comments and continued lines.
        files: what the table below it says that it leaves in its folder, capitals for any name.
    """

    page: str
    line: str
    files: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: {self.line}"


def fences(page: Path) -> Iterator[tuple[str, str]]:
    """Yield the language and the text of every fenced block of a page."""
    for found in _FENCE.finditer(page.read_text(encoding="utf-8")):
        yield found[1], found[2]


def commands() -> list[Command]:
    """Return every command of every page, in their order.

    A block without a language holds nothing but commands; in others, such as shown output and what is for
    other programs, lines that begin with ``utopic`` are commands.
    """
    return [command for page in PAGES for command in _commands_of(page)]


def _commands_of(page: Path) -> Iterator[Command]:
    name, text = page.relative_to(ROOT).as_posix(), page.read_text(encoding="utf-8")
    blocks = list(_FENCE.finditer(text))
    bare = [block.start() for block in blocks if not block[1]]
    for block in blocks:
        assert block[1] in LANGUAGES, f"{page}: say in documentation.py what {block[1]} is"
        end = next((start for start in bare if start > block.start()), len(text))
        files = _files_of_table(text[block.end() : end])
        for line in block[2].replace("\\\n", " ").splitlines():
            command = " ".join(re.sub(r"(^|\s)#.*", "", line).split())
            if command and (not block[1] or command.startswith("utopic ")):
                yield Command(name, command, files)


def _files_of_table(text: str) -> tuple[str, ...]:
    """Return the names in the first column of the first table of files."""
    table = _TABLE_OF_FILES.search(text)
    rows = table[1].splitlines() if table else []
    return tuple(name for row in rows for name in re.findall(r"`([^`]+)`", row.split("|")[1]))
