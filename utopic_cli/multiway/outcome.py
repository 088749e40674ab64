"""What one batch came to: every scan's fate, every pair's record, and the exit code that follows."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from utopic_cli.multiway.aside import Aside
from utopic_cli.multiway.model import FAILED, Model
from utopic_cli.multiway.scans import ScanFile

WHOLE, IN_PARTS, NOTHING = 0, 6, 7


@dataclass(frozen=True)
class ScanEntry:
    """What became of one input file.

    Attributes:
        file: the file and its name.
        points: how many finite points it has; None if it could not be read.
        group: number of its group, from 1, or None.
        T_world_scan: (4, 4), file units, or None.
        left_out: why it has no place, or None.
        passed_over: why a file of the folder is taken for no scan at all, or None.
    """

    file: ScanFile
    points: int | None
    group: int | None = None
    T_world_scan: np.ndarray | None = None
    left_out: str | None = None
    passed_over: str | None = None

    @property
    def status(self) -> tuple[str, str]:
        """A word for it, and the reason."""
        if self.passed_over is not None:
            return "no scan", self.passed_over
        if self.left_out is not None:
            return ("unreadable" if self.points is None else "left out"), self.left_out
        return ("copy", f"of {self.file.copy_of}") if self.file.copy_of else ("placed", "")


@dataclass(frozen=True)
class BatchOutcome:
    """A finished batch.

    Attributes:
        scans: every input file, in order; scan numbers elsewhere are places in it.
        model: groups and pairs.
        described: by number of the scans that could be read, see ``tasks.describe``.
        records: by (source, target), as the journal keeps them.
        notes: what a user should know about the inputs.
        weights: name and sha256.
        options: of the pairwise registration.
        pairs_mode: how the pairs were chosen.
        seconds: wall time of this run.
        waited_s: of which jobs were waited for.
        resumed: pairs that were done before this run.
        aside: files of the folders that are no scans.
    """

    scans: tuple[ScanEntry, ...]
    model: Model
    described: Mapping[int, Mapping[str, Any]]
    records: Mapping[tuple[int, int], Mapping[str, Any]]
    notes: tuple[str, ...]
    weights: dict[str, str]
    options: dict[str, Any]
    pairs_mode: str
    seconds: float
    waited_s: float
    resumed: int
    aside: tuple[Aside, ...] = ()

    def pair_name(self, source: int, target: int) -> str:
        """Return what a pair and its file are called."""
        return pair_name(self.scans[source].file, self.scans[target].file)

    @property
    def exit_code(self) -> int:
        """0: every scan lies in one group; 6: some do; 7: no two scans connect."""
        if not self.model.groups:
            return NOTHING
        left_out = any(entry.left_out is not None for entry in self.scans)
        return IN_PARTS if left_out or len(self.model.groups) > 1 else WHOLE


def pair_name(source: ScanFile, target: ScanFile) -> str:
    """Return what a pair and its file are called."""
    return f"{source.name}--{target.name}"


def why_alone(
    number: int,
    model: Model,
    files: Sequence[ScanFile],
    records: Mapping[tuple[int, int], Mapping[str, Any]],
) -> str:
    """Return why a scan connects with nothing, the pair that came closest, and what to do.

    Args:
        number: of the scan.
        model: with all pairs.
        files: of all scans.
        records: by (source, target), as the journal keeps them.
    """
    own = [pair for pair in model.pairs if number in (pair.source, pair.target)]
    if not own:
        return "no pair with it was tried"
    verdicts = Counter(pair.verdict for pair in own)
    said = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    why = f"connects with no other scan ({len(own)} {'pair' if len(own) == 1 else 'pairs'}: {said})"
    answered = [pair for pair in own if pair.verdict != FAILED]
    if not answered:
        return why
    best = max(answered, key=lambda pair: (pair.prior or 0.0, pair.overlap or 0.0))
    source, target = files[best.source], files[best.target]
    confidence = records[best.source, best.target]["report"]["confidence"]
    sure = "" if confidence is None else f"confidence {confidence:.2f}, "
    scans = shlex.join((str(source.path), str(target.path)))
    return (
        f"{why}; best {pair_name(source, target)}: {sure}overlap {best.overlap or 0.0:.0%}; "
        f"scan more in between, or look at it: utopic align {scans}"
    )
