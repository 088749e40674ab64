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
"""``auto`` begins with each scan's most similar ones, this many, and some neighbours in order."""

PROBES, ORDERED = 20, 0.25
"""So many neighbours in order, all over the batch, tell whether order means anything: whether at least
this share of them may hold. Only then are the others worth their time.
"""

PAIRS_PER_SCAN = 10
"""``auto`` never tries more than this many pairs a scan."""

MOST_ROUNDS = 6
PROMISING = 0.3  # chance of being right from which a pair predicts the overlap of others
LEAST_PREDICTED_OVERLAP = 0.1
TRIES_PER_GROUP = 3
TRIED_BEFORE = 0.1  # a pair tried between two groups makes the next one seem a tenth less alike
ROWS = 256  # of the table of distances at a time


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


def similar_pairs(looks: Mapping[int, np.ndarray]) -> list[Pair]:
    """Return ``auto``'s first pairs on many scans: the most similar ones, and some neighbours in order.

    Args:
        looks: (D,) by scan, the nearer the more alike; see ``vocabulary``.
    """
    scans = sorted(looks)
    pairs = set(_probes(scans))
    for row, distance in enumerate(_distances(looks)):
        distance[row] = np.inf
        nearest = np.argsort(distance, kind="stable")[: min(NEAREST, len(scans) - 1)]
        pairs |= {_ordered(scans[row], scans[i]) for i in nearest}
    return sorted(pairs)


def further_pairs(model: Model, looks: Mapping[int, np.ndarray], tried: set[Pair]) -> list[Pair]:
    """Return what ``auto`` tries next: neighbours in order, pairs between groups, pairs that close loops.

    Neighbours in order count if there is an order (see ``PROBES``). Groups that don't connect are tried
    by their most similar scans. Two scans that both lie on a third overlap by about the product of
    their overlaps with it; where a pair is not yet confirmed by a loop, such a pair can do so.

    Args:
        model: of the pairs so far.
        looks: (D,) by scan, the nearer the more alike; see ``vocabulary``.
        tried: pairs so far, in any direction.
    """
    known = {_ordered(*pair) for pair in tried}
    room = PAIRS_PER_SCAN * len(looks) - len(known)
    chain = [pair for pair in _in_order(model, sorted(looks)) if pair not in known]
    between = _between(model, looks, known)
    pairs = list(dict.fromkeys([*chain, *between, *_closing(model.pairs, known)]))
    return pairs[: max(0, min(room, 2 * len(looks)))]


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


def _probes(scans: Sequence[int]) -> list[Pair]:
    """Return some neighbours in order, evenly spread."""
    chain = list(zip(scans[1:], scans, strict=False))
    if not chain:
        return []
    return [chain[i] for i in np.unique(np.linspace(0, len(chain) - 1, PROBES).round().astype(int))]


def _in_order(model: Model, scans: Sequence[int]) -> list[Pair]:
    """Return all neighbours in order if the order of the scans means anything."""
    probes = set(_probes(scans))
    tried = [answer for answer in model.pairs if _ordered(answer.source, answer.target) in probes]
    hold = sum(_may_hold(answer) for answer in tried)
    return list(zip(scans[1:], scans, strict=False)) if hold and hold >= ORDERED * len(tried) else []


def _between(model: Model, looks: Mapping[int, np.ndarray], known: set[Pair]) -> list[Pair]:
    """Return the most promising untried pairs between each group, or lone scan, and the others.

    Those are the most similar ones; each pair tried before between the same two groups counts as so much
    less alike (see ``TRIED_BEFORE``), for what did not connect with one group may belong to another.
    """
    scans = sorted(looks)
    row_of = {scan: i for i, scan in enumerate(scans)}
    group_of = model.group_of()
    _, home = np.unique([group_of.get(scan, -1 - i) for i, scan in enumerate(scans)], return_inverse=True)
    tried: dict[int, list[int]] = defaultdict(list)
    tries: dict[int, Counter[int]] = defaultdict(Counter)
    for a, b in known:
        if a in row_of and b in row_of:
            for one, other in ((row_of[a], row_of[b]), (row_of[b], row_of[a])):
                tried[one].append(other)
                tries[int(home[one])][int(home[other])] += 1
    found: dict[int, list[tuple[float, int, Pair]]] = defaultdict(list)  # distance, other group, pair
    for row, distance in enumerate(_distances(looks)):
        distance[home == home[row]] = np.inf
        distance[tried[row]] = np.inf
        order = np.argsort(distance, kind="stable")
        order = order[np.isfinite(distance[order])]
        before = tries[int(home[row])]
        nearest = order[np.unique(home[order], return_index=True)[1]].tolist()  # of each other group
        nearest.sort(
            key=lambda other: (distance[other] * (1 + TRIED_BEFORE * before[int(home[other])]), other)
        )
        for other in {*nearest[:TRIES_PER_GROUP], *order[:TRIES_PER_GROUP].tolist()}:
            pair = _ordered(scans[row], scans[other])
            found[int(home[row])].append((float(distance[other]), int(home[other]), pair))
    chosen: list[tuple[float, Pair]] = []
    for group, candidates in found.items():
        counted = Counter(tries[group])
        ranked = []
        for distance_to, other, pair in sorted(candidates):
            ranked.append((distance_to * (1 + TRIED_BEFORE * counted[other]), pair))
            counted[other] += 1
        chosen += sorted(ranked)[:TRIES_PER_GROUP]
    return list(dict.fromkeys(pair for _, pair in sorted(chosen)))


def _closing(answers: Sequence[PairAnswer], known: set[Pair]) -> list[Pair]:
    """Return untried pairs that would close a loop with pairs not yet confirmed, surest overlap first."""
    neighbours: dict[int, dict[int, PairAnswer]] = defaultdict(dict)
    for answer in answers:
        if _may_hold(answer):
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


def _may_hold(answer: PairAnswer) -> bool:
    if answer.verdict in (FAILED, UNUSABLE):
        return False
    return answer.verdict == USED or (answer.prior or 0.0) >= PROMISING


def _confirmed(answer: PairAnswer) -> bool:
    return answer.verdict == USED and answer.belief is not None and answer.belief.agree > 0


def _distances(looks: Mapping[int, np.ndarray]) -> Iterator[np.ndarray]:
    """Yield each scan's (N,) distances to all.

    They are made a few rows at a time: all N x N of them need not fit in memory.
    """
    table = np.stack([looks[scan] for scan in sorted(looks)])
    squares = np.square(table).sum(axis=1)
    for start in range(0, len(table), ROWS):
        rows = slice(start, start + ROWS)
        yield from np.sqrt(np.maximum(squares[rows, None] + squares - 2.0 * table[rows] @ table.T, 0.0))


def _ordered(a: int, b: int) -> Pair:
    """Return a pair whose target is the earlier scan."""
    return (a, b) if a > b else (b, a)
