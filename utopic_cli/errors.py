"""The error family: every failure a user can cause or meet is one of these.

Each carries the exit code of the command line (see the README). The message is one
line: what went wrong, which file, what to do about it.
"""

from __future__ import annotations


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
