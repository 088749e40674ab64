"""Packed shapes, kept in the user's cache until the files they were made of change."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.output import check_writable, write_atomically
from utopic_cli.synthesis.shapes import ShapeLibrary, load_shapes

_FORM = 1  # part of a pack's name: raise it when what is packed changes


def cache_folder() -> Path:
    """Return where packed shapes are kept: ``utopic`` in the user's cache."""
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        return (Path(local) if local else Path.home() / "AppData" / "Local") / "utopic"
    given = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "utopic"


def cached(
    root: Path, kind: str, files: Sequence[Path], build: Callable[[], dict[str, np.ndarray]]
) -> ShapeLibrary:
    """Return the pack of some files of a folder, built if the cache has none or a damaged one.

    Args:
        root: the folder.
        kind: what is made of it; a folder may have a pack of each kind.
        files: that the pack is made of; it is made anew when one of them changes.
        build: makes the arrays that ``load_shapes`` reads.

    Raises:
        OutputError: the cache can't be written.
    """
    place = hashlib.sha1(kind.encode() + os.fsencode(root.resolve())).hexdigest()[:16]
    content = hashlib.sha1(f"form {_FORM}".encode())
    for file in files:
        try:
            found = file.stat()
            line = (os.fsencode(file.relative_to(root)), found.st_size, found.st_mtime_ns)
        except OSError:  # a broken link, say: packing will name it
            line = (os.fsencode(file.relative_to(root)), -1, -1)
        content.update(repr(line).encode())
    pack = cache_folder() / f"{place}-{content.hexdigest()[:16]}.npz"
    if pack.exists():
        with contextlib.suppress(InputError):
            return load_shapes(pack)
    _prepare_cache(pack)
    arrays = build()
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    write_atomically(pack, stream.getvalue(), overwrite=True)
    for old in pack.parent.glob(f"{place}-*.npz"):
        if old != pack:  # what this folder held before
            with contextlib.suppress(OSError):
                old.unlink()
    return load_shapes(pack)


def _prepare_cache(pack: Path) -> None:
    """Make sure, before minutes of work, that its result can be kept."""
    advice = "shapes are packed there; set XDG_CACHE_HOME to a folder that can be written"
    try:
        pack.parent.mkdir(parents=True, exist_ok=True)
        check_writable([pack], overwrite=True)
    except OSError as error:
        raise OutputError(f"{pack.parent}: can't be made ({error.strerror}); {advice}") from error
    except OutputError as error:
        raise OutputError(f"{error} ({advice})") from error
