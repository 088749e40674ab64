"""The shapes that protocols measure on: those that no training sees."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from utopic_cli.errors import InputError
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.shapes import ShapeLibrary


def held_out(shapes: ShapeLibrary) -> tuple[ShapeLibrary, str]:
    """Return the shapes that no training sees, and the name of their split.

    Raises:
        InputError: there are none.
    """
    split = "test" if "test" in shapes.splits else "val"
    return shapes.select(split), split


@contextmanager
def made_of(data: str) -> Iterator[None]:
    """Make pairs of shapes in here.

    Args:
        data: what to call the shapes.

    Raises:
        InputError: no such pair can be made of them.
    """
    try:
        yield
    except DegeneratePair as error:
        raise InputError(f"{data}: {error}; give more or other shapes") from error
