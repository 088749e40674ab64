"""The journal of a training run: its records as lines, TensorBoard events and a page of curves."""

from __future__ import annotations

import importlib.util
import json
import logging
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any

from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.output import write_atomically
from utopic_cli.training.curves import curves_page, kind_of

log = logging.getLogger(__name__)

LINES = "log.jsonl"
PAGE = "curves.html"
EVENTS = "tensorboard"
SECONDS_BETWEEN_PAGES = 60.0


class Journal:
    """Keeps the records of a run; used as a context manager.

    Each record becomes a line of ``log.jsonl``, at once; events in the folder ``tensorboard``,
    where that package is installed; and part of the page ``curves.html``, which is written anew
    after a minute at the earliest and at the end.

    The lines are the run's memory, and failing to write one is an error. Page and events only show
    what the lines hold: failing to write them is a warning, so that no training ends for them.

    Attributes:
        records: all records of the run, those before a resumption included.
    """

    def __init__(self, out: Path, done: int, *, settings: Mapping[str, Any] | None = None) -> None:
        """Open the journal of a run.

        Args:
            out: folder of the run.
            done: pairs already shown when the run goes on from a checkpoint, 0 for a new run.
                What an earlier process recorded after that point is dropped: it is done again.
            settings: sections of settings, for the page.

        Raises:
            InputError: the lines that are there can't be read.
            OutputError: the lines can't be written.
        """
        self._out = out
        self._path = out / LINES
        self._settings = dict(settings or {})
        self.records = _read_records(self._path, done)
        lines = "".join(json.dumps(record) + "\n" for record in self.records)
        write_atomically(self._path, lines.encode("utf-8"), overwrite=True)
        try:
            self._lines = open(self._path, "a", encoding="utf-8")  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise self._unwritable(error) from None
        self._events = _open_events(out / EVENTS, done)
        self._paged = time.monotonic()
        self._page_warned = False

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def write(self, record: dict[str, Any]) -> None:
        """Keep one record: ``pairs``, ``of``, ``stage``, ``elapsed_s`` and any numbers.

        Raises:
            OutputError: its line can't be written.
        """
        self.records.append(dict(record))
        try:
            self._lines.write(json.dumps(record) + "\n")
            self._lines.flush()
        except OSError as error:
            raise self._unwritable(error) from None
        self._write_events(record)
        # The first page comes with the first record, so that there is something to open.
        if len(self.records) == 1 or time.monotonic() - self._paged >= SECONDS_BETWEEN_PAGES:
            self._write_page(datetime.now().astimezone())

    def close(self) -> None:
        """Write the last page and close all files; may be called twice."""
        if self._lines.closed:
            return
        try:
            self._lines.close()
        except OSError as error:  # what could not be flushed; write() has said so
            log.warning("%s: can't be closed (%s)", self._path, error.strerror)
        if self._events is not None:
            try:
                self._events.close()
            except OSError as error:
                log.warning("%s: can't be written (%s)", self._out / EVENTS, error.strerror)
        self._write_page(None)

    def _write_events(self, record: Mapping[str, Any]) -> None:
        if self._events is None:
            return
        try:
            for name, value in record.items():
                kind = kind_of(name)
                if kind != "about" and isinstance(value, (int, float)):
                    self._events.add_scalar(f"{kind}/{name}", value, record["pairs"])
            self._events.flush()
        except OSError as error:
            log.warning("%s: can't be written (%s); no more events", self._out / EVENTS, error.strerror)
            self._events = None

    def _write_page(self, now: datetime | None) -> None:
        self._paged = time.monotonic()
        page = curves_page(self.records, self._out.absolute().name, self._settings, now=now)
        try:
            write_atomically(self._out / PAGE, page.encode("utf-8"), overwrite=True)
        except OutputError as error:
            if not self._page_warned:
                log.warning("%s", error)
            self._page_warned = True

    def _unwritable(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._path}: can't be written ({error.strerror}); mend that and go on with --resume"
        )


def _read_records(path: Path, done: int) -> list[dict[str, Any]]:
    """Read the records up to a number of pairs; a new run (0) has none."""
    if done == 0 or not path.exists():
        return []
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror})") from error
    records, damaged = [], []
    for number, line in enumerate(lines, 1):
        record = _parse(line)
        if record is None:
            damaged.append(number)
        elif record["pairs"] <= done:
            records.append(record)
    # The last line is half written when the machine went down, and no loss: its pairs are shown again.
    inner = [number for number in damaged if number != len(lines)]
    if inner:
        log.warning("%s: left out %d damaged lines, the first is line %d", path, len(inner), inner[0])
    return records


def _parse(line: str) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    known = isinstance(record, dict) and all(key in record for key in ("pairs", "of", "stage", "elapsed_s"))
    return record if known else None


def _open_events(folder: Path, done: int) -> Any:
    """Return a TensorBoard writer, or None where that package isn't installed.

    Events after the resumed place are marked as undone. A new run takes away those of a run before: files
    begun in one second are read in the order of their names, in which a mark may come before what it undoes.
    """
    if importlib.util.find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    try:
        if not done:
            for old in folder.glob("events.out.tfevents.*"):
                old.unlink()
        return SummaryWriter(str(folder), purge_step=done + 1 if done else 0)
    except OSError as error:
        log.warning("%s: can't be written (%s); no TensorBoard events", folder, error.strerror)
        return None
