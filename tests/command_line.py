"""The command line as a shell sees it, without running anything."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import typer

from utopic_cli.cli import app


def parse(command: str) -> list[str]:
    """Parse a command as it would be typed; a usage error is raised.

    Returns:
        The names of the commands on the way: ``["bench", "noise"]``.
    """
    words = shlex.split(command)
    assert words[0] == "utopic", command
    parser: Any = typer.main.get_command(app)
    context = parser.make_context("utopic", words[1:])
    path = []
    while hasattr(parser, "commands"):
        rest = [*getattr(context, "_protected_args", []), *context.args]
        name, parser, rest = parser.resolve_command(context, rest)
        path.append(name)
        context = parser.make_context(name, rest, parent=context)
    return path


def all_commands() -> Iterator[tuple[list[str], Any]]:
    """Yield every command that does something, with the names that lead to it."""
    waiting: list[tuple[list[str], Any]] = [([], typer.main.get_command(app))]
    while waiting:
        path, command = waiting.pop()
        if hasattr(command, "commands"):
            waiting += [([*path, name], inner) for name, inner in command.commands.items()]
        else:
            yield path, command
