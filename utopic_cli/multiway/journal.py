"""What is done stays done: one JSON file for each scan described and each pair tried.

A record is written atomically when its job has ended, and is the commit mark of that job. It holds a
fingerprint of everything its content follows from (inputs, options, weights), so that a record
of other inputs, or a damaged one, is never taken for done.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from utopic_cli.errors import OutputError
from utopic_cli.io.output import write_atomically

KINDS = ("scans", "pairs")

_MARK_WITHIN = 64  # bytes: the fingerprint is what a record begins with


def fingerprint(content: Any) -> str:
    """Return the sha256 of JSON-ready data."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode("ascii")).hexdigest()


class Journal:
    """The records of a batch in its folder."""

    def __init__(self, folder: Path) -> None:
        """Make the folders.

        Raises:
            OutputError: they can't be made.
        """
        self._folder = folder
        for kind in KINDS:
            try:
                (folder / kind).mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise OutputError(
                    f"{folder / kind}: the folder can't be made ({error.strerror}); choose another place"
                ) from None

    def load(self, kind: str, name: str, mark: str) -> dict[str, Any] | None:
        """Return a record of the given fingerprint whose job need not be done again, or None."""
        try:
            record = json.loads(self.path(kind, name).read_bytes())
        except (OSError, ValueError, RecursionError):
            return None
        if not isinstance(record, dict) or record.get("fingerprint") != mark:
            return None
        # A scan that could not be read may have been out of reach; to look again costs little.
        lasting = ("done", "refused") if kind == "pairs" else ("done",)
        return record if record.get("status") in lasting else None

    def commit(self, kind: str, name: str, mark: str, record: dict[str, Any]) -> dict[str, Any]:
        """Write a record and return it as it will be read back.

        Raises:
            OutputError: it can't be written; nothing of it is left.
        """
        text = json.dumps({"fingerprint": mark, **record}, indent=1, allow_nan=False)
        write_atomically(self.path(kind, name), (text + "\n").encode("ascii"), overwrite=True)
        read_back: dict[str, Any] = json.loads(text)
        return read_back

    def path(self, kind: str, name: str) -> Path:
        """Return where a record goes."""
        return self._folder / kind / f"{name}.json"

    def clear(self) -> None:
        """Remove all records; other files stay.

        Raises:
            OutputError: one can't be removed.
        """
        for kind in KINDS:
            for path in (self._folder / kind).glob("*.json"):
                try:
                    if b'"fingerprint"' in path.read_bytes()[:_MARK_WITHIN] or not path.stat().st_size:
                        path.unlink()
                except OSError as error:
                    raise OutputError(f"{path}: can't be removed ({error.strerror})") from None
