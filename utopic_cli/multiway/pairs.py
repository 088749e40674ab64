"""Which pairs to try: all, neighbours in order, all to the first, a list, or the most promising ones.

A pair is (source, target), numbers of scans; the target is the earlier scan unless a list says
otherwise.
"""

from __future__ import annotations

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.io.files import read_bytes
from utopic_cli.multiway.model import FAILED, UNUSABLE, USED, Model, PairAnswer
from utopic_cli.multiway.scans import ScanFile

Pair = tuple[int, int]

MODES = ("auto", "all", "sequential", "to-first")

FEW_SCANS = 12
"""Up to this many scans ``auto`` tries all pairs: ranking them would save little."""

NEAREST = 4
"""``auto`` begins with each scan's most similar ones, this many, and its neighbours in order."""

PAIRS_PER_SCAN = 10
"""``auto`` never tries more than this many pairs a scan."""

MOST_ROUNDS = 6
PROMISING = 0.3  # chance of being right from which a pair predicts the overlap of others
LEAST_PREDICTED_OVERLAP = 0.1
TRIES_PER_GROUP = 3


def every_pair(scans: Sequence[int]) -> list[Pair]:
    """Return all pairs."""
    return [(later, earlier) for i, later in enumerate(scans) for earlier in scans[:i]]


def sequential_pairs(scans: Sequence[int]) -> list[Pair]:
    """Return each scan with the two before it, so that there are loops, and the last with the first."""
    pairs = [(scans[i], scans[i - back]) for i in range(len(scans)) for back in (1, 2) if back <= i]
    return list(dict.fromkeys([*pairs, (scans[-1], scans[0])])) if len(scans) > 1 else []


def pairs_to_first(scans: Sequence[int]) -> list[Pair]:
    """Return every scan with the first."""
    return [(scan, scans[0]) for scan in scans[1:]]


def similar_pairs(descriptors: Mapping[int, np.ndarray]) -> list[Pair]:
    """Return ``auto``'s first pairs on many scans: the most similar ones, and neighbours in order.

    Args:
        descriptors: (D,) by scan.
    """
    scans = sorted(descriptors)
    distance = _distances(descriptors)
    pairs = {_ordered(*pair) for pair in zip(scans[1:], scans, strict=False)}
    for row, scan in enumerate(scans):
        order = [i for i in np.argsort(distance[row], kind="stable") if i != row]
        pairs |= {_ordered(scan, scans[i]) for i in order[:NEAREST]}
    return sorted(pairs)


def further_pairs(model: Model, descriptors: Mapping[int, np.ndarray], tried: set[Pair]) -> list[Pair]:
    """Return what ``auto`` tries next: pairs that close loops, and pairs between groups.

    Two scans that both lie on a third overlap by about the product of their overlaps with it; where
    a pair is not yet confirmed by a loop, such a pair can do so. Groups that don't connect are
    tried by their most similar scans.

    Args:
        model: of the pairs so far.
        descriptors: (D,) by scan.
        tried: pairs so far, in any direction.
    """
    known = {_ordered(*pair) for pair in tried}
    room = PAIRS_PER_SCAN * len(descriptors) - len(known)
    pairs = list(dict.fromkeys([*_between(model, descriptors, known), *_closing(model.pairs, known)]))
    return pairs[: max(0, min(room, 2 * len(descriptors)))]


def read_pairs(path: Path, scans: Sequence[ScanFile]) -> list[Pair]:
    """Read pairs from a CSV file: source, target in each line; names, file names or paths.

    Raises:
        InputError: the file can't be read, or a line (named) has not two known, different scans.
    """
    known: dict[str, int] = {}
    several = {name for name, n in Counter(scan.path.name for scan in scans).items() if n > 1}
    for number, scan in enumerate(scans):
        known[scan.path.name] = number
    for number, scan in enumerate(scans):
        known[str(scan.path)] = number  # paths and names are distinct, file names are not
    for number, scan in enumerate(scans):
        known[scan.name] = number
    text = read_bytes(path).decode("utf-8-sig", "surrogateescape")
    pairs: dict[Pair, Pair] = {}
    rows = csv.reader(io.StringIO(text, newline=""))
    for row in _sound(path, rows):
        cells = [cell.strip() for cell in row]
        line = rows.line_num
        if not any(cells) or cells[0].startswith("#") or (line == 1 and cells[:2] == ["source", "target"]):
            continue
        if len(cells) < 2:
            raise InputError(f"{path}: line {line} has no second column; write source,target")
        for cell in cells[:2]:
            if cell in several:
                raise InputError(
                    f"{path}: line {line} names {cell!r}, which several files are called; give a path"
                )
            if cell not in known:
                raise InputError(f"{path}: line {line} names {cell!r}, which is no scan of this batch")
        source, target = known[cells[0]], known[cells[1]]
        if source == target:
            raise InputError(f"{path}: line {line} pairs {cells[0]!r} with itself; name two scans")
        pairs.setdefault(_ordered(source, target), (source, target))
    if not pairs:
        raise InputError(f"{path}: holds no pair; write source,target in each line")
    return list(pairs.values())


def _sound(path: Path, rows: Any) -> Iterator[list[str]]:
    """Yield the rows of a CSV reader; what it can't split into cells is an input error."""
    try:
        yield from rows
    except csv.Error as error:
        raise InputError(f"{path}: line {rows.line_num} is no CSV ({error}); export it again") from None


def _between(model: Model, descriptors: Mapping[int, np.ndarray], known: set[Pair]) -> list[Pair]:
    """Return the most similar untried pairs between each group, or lone scan, and the others."""
    scans = sorted(descriptors)
    distance = _distances(descriptors)
    group_of = model.group_of()
    home = np.array([group_of.get(scan, -1 - i) for i, scan in enumerate(scans)])
    untried = home[:, None] != home[None, :]
    row_of = {scan: i for i, scan in enumerate(scans)}
    for a, b in known:
        if a in row_of and b in row_of:
            untried[row_of[a], row_of[b]] = untried[row_of[b], row_of[a]] = False
    found: list[tuple[float, Pair]] = []
    for part in np.unique(home):
        rows = np.flatnonzero(home == part)
        masked = np.where(untried[rows], distance[rows], np.inf)
        best = np.argsort(masked, axis=None, kind="stable")[:TRIES_PER_GROUP]
        for row, column in zip(*np.unravel_index(best, masked.shape), strict=True):
            if np.isfinite(masked[row, column]):
                pair = _ordered(scans[rows[row]], scans[column])
                found.append((float(masked[row, column]), pair))
    return [pair for _, pair in sorted(found)]


def _closing(answers: Sequence[PairAnswer], known: set[Pair]) -> list[Pair]:
    """Return untried pairs that would close a loop with pairs not yet confirmed, surest overlap first."""
    neighbours: dict[int, dict[int, PairAnswer]] = defaultdict(dict)
    for answer in answers:
        hopeless = answer.verdict in (FAILED, UNUSABLE)
        if not hopeless and (answer.verdict == USED or (answer.prior or 0.0) >= PROMISING):
            neighbours[answer.source][answer.target] = answer
            neighbours[answer.target][answer.source] = answer
    predicted: dict[Pair, float] = {}
    for around in neighbours.values():
        corners = sorted(around)
        for i, first in enumerate(corners):
            for second in corners[:i]:
                pair = _ordered(first, second)
                sides = (around[first], around[second])
                if pair in known or all(_confirmed(side) for side in sides):
                    continue
                overlap = float(np.prod([side.overlap or 0.0 for side in sides]))
                predicted[pair] = max(predicted.get(pair, 0.0), overlap)
    likely = [(-overlap, pair) for pair, overlap in predicted.items() if overlap >= LEAST_PREDICTED_OVERLAP]
    return [pair for _, pair in sorted(likely)]


def _confirmed(answer: PairAnswer) -> bool:
    return answer.verdict == USED and answer.belief is not None and answer.belief.agree > 0


def _distances(descriptors: Mapping[int, np.ndarray]) -> np.ndarray:
    """Return (N, N) distances of descriptors, each of whose numbers counts by its spread in the batch."""
    table = np.stack([descriptors[scan] for scan in sorted(descriptors)])
    table = (table - table.mean(axis=0)) / np.maximum(table.std(axis=0), 1e-6)
    squares = np.square(table).sum(axis=1)
    return np.sqrt(np.maximum(squares[:, None] + squares[None] - 2.0 * table @ table.T, 0.0))


def _ordered(a: int, b: int) -> Pair:
    """Return a pair whose target is the earlier scan."""
    return (a, b) if a > b else (b, a)
