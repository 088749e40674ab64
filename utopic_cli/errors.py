"""The error family: every failure a user can cause or meet is one of these.

Each carries the exit code of the command line (see the README). The message is one
line: what went wrong, which file, what to do about it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class UtopicError(Exception):
    """Base of all expected failures; anything else that escapes is a bug (exit code 1)."""

    exit_code = 1


class UsageError(UtopicError):
    """The options contradict each other or name something that does not exist."""

    exit_code = 2


class InputError(UtopicError):
    """A file or array that came in can't be used."""

    exit_code = 4


class OutputError(UtopicError):
    """A result can't be written where it was asked for."""

    exit_code = 5


@contextmanager
def optional_part(need: str, install: str) -> Iterator[None]:
    """Import an optional part in here.

    Args:
        need: who needs it and its name, as the error begins.
        install: what pip is told to install.

    Raises:
        UsageError: it can't be loaded; says why and the command that installs it.
    """
    try:
        yield
    except (ImportError, OSError) as error:
        raise UsageError(f"{need} ({error}); install it: pip install {install}") from error
