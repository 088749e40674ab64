"""Which scans connect: the surest first, groups joined by the votes of all pairs between them.

Every scan starts as a group. Two groups are joined by the motion that most evidence between them
stands for: each pair across says how one group would lie on the other, and pairs that say the
same add up as loops do (see ``loops``), while those that say otherwise weigh against it: the
more, the more those scans would overlap if it were right. The join with the most evidence is
made first; where it falls short none is made. A wrong pair is outvoted before it can pull two
groups together, however much it is trusted, and a scan without evidence stays out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np

from utopic_cli.geometry.rigid import invert
from utopic_cli.multiway.edges import Edge, ScanShape, displacements
from utopic_cli.multiway.loops import CLOSES, Belief, agreement, disagreement, log_odds

ENOUGH = log_odds(0.999)
"""Evidence that joins two groups where no pair across is trusted: among many groups some look alike, and then
several pairs may err alike."""

ENOUGH_IF_TRUSTED = 0.0
"""Where a pair across is trusted by itself, loops only must not speak against it."""

MOST_SEEDS = 50
"""Between two groups this many motions at most are put to the vote, those of the surest pairs."""

FOUND = (1.4, 0.9)
"""Chance that a pair is registered rightly: this much times its overlap, and at most the other."""

LOOSEST = 2.5
"""Errors add up along a path: how much farther than a triangle's a long loop may miss."""


@dataclass
class Group:
    """Scans that connect.

    Attributes:
        T_group_scan: (4, 4) by scan, between centred frames; of the first member the identity.
        evidence: the least log odds of any join that made the group; infinite for one scan.
        hops: joins that one path through the group may take, about.
    """

    T_group_scan: dict[int, np.ndarray]
    evidence: float = float("inf")
    hops: int = 0


@dataclass(frozen=True)
class _Join:
    log_odds: float
    motion: np.ndarray  # (4, 4) from the first group's frame to the second's
    agreeing: tuple[int, ...] = ()  # the edges that say so


_NONE = _Join(-np.inf, np.eye(4))


def find_groups(
    edges: Sequence[Edge], beliefs: Sequence[Belief], shapes: Mapping[int, ScanShape]
) -> list[Group]:
    """Join scans into groups.

    Args:
        edges: at most one for any two scans.
        beliefs: of the edges.
        shapes: of all scans, by index; a scan without any edge is a group of its own.

    Returns:
        The groups, each with rough transformations; by size, then by first scan.
    """
    groups = {scan: Group({scan: np.eye(4)}) for scan in shapes}
    home = {scan: scan for scan in shapes}
    links: dict[int, dict[int, float]] = {scan: {scan: 1.0} for scan in shapes}  # overlaps, in groups
    across: dict[tuple[int, int], list[int]] = defaultdict(list)
    for number, edge in enumerate(edges):
        across[_ordered(edge.source, edge.target)].append(number)
    joins = {
        pair: _best_join(pair, votes, edges, beliefs, shapes, groups, home, links)
        for pair, votes in across.items()
    }
    beside: dict[int, set[int]] = defaultdict(set)
    for first, second in across:
        beside[first].add(second)
        beside[second].add(first)
    # The best join comes first, of equal ones that of the last groups. An entry of a join that has
    # changed since is passed over.
    heap = [(-join.log_odds, -first, -second) for (first, second), join in joins.items()]
    heapify(heap)
    while heap:
        worth, *negative = heappop(heap)
        first, second = (-number for number in negative)
        if worth == np.inf:
            break
        join = joins.get((first, second), _NONE)
        if join.log_odds != -worth:
            continue
        kept, gone = groups[first], groups.pop(second)
        back = invert(join.motion)
        for scan, transformation in gone.T_group_scan.items():
            kept.T_group_scan[scan] = back @ transformation
            home[scan] = first
        kept.evidence = min(kept.evidence, gone.evidence, join.log_odds)
        kept.hops += gone.hops + 1
        for number in join.agreeing:
            edge = edges[number]
            links[edge.source][edge.target] = links[edge.target][edge.source] = edge.overlap
        del joins[first, second], across[first, second]
        beside[first].remove(second)
        beside[second].remove(first)
        for there in beside.pop(second):
            across[_ordered(first, there)] += across.pop(_ordered(second, there))
            joins.pop(_ordered(second, there))
            beside[there].remove(second)
            beside[there].add(first)
            beside[first].add(there)
        for there in beside[first]:
            pair = _ordered(first, there)
            across[pair].sort()
            joins[pair] = _best_join(pair, across[pair], edges, beliefs, shapes, groups, home, links)
            heappush(heap, (-joins[pair].log_odds, -pair[0], -pair[1]))
    return sorted(groups.values(), key=lambda group: (-len(group.T_group_scan), min(group.T_group_scan)))


def _best_join(
    pair: tuple[int, int],
    votes: Sequence[int],
    edges: Sequence[Edge],
    beliefs: Sequence[Belief],
    shapes: Mapping[int, ScanShape],
    groups: Mapping[int, Group],
    home: Mapping[int, int],
    links: Mapping[int, Mapping[int, float]],
) -> _Join:
    """Return the motion between two groups that most pairs across stand for; -inf: none does."""
    first, second = groups[pair[0]], groups[pair[1]]
    tolerance = CLOSES * min(LOOSEST, float(np.sqrt(1 + 0.5 * (first.hops + second.hops))))
    motions, ways, places = [], [], []
    for number in votes:
        edge = edges[number]
        if home[edge.source] == pair[0]:
            scan, other, along = edge.source, edge.target, edge.T_target_source
        else:
            scan, other, along = edge.target, edge.source, invert(edge.T_target_source)
        place = first.T_group_scan[scan]
        motions.append(second.T_group_scan[other] @ along @ invert(place))
        ways.append(invert(place) @ invert(motions[-1]))
        places.append(scan)
    there, back = np.stack([first.T_group_scan[scan] for scan in places]), np.stack(ways)  # (K, 4, 4)
    moments = np.stack([shapes[scan].moments for scan in places])
    priors = np.array([edges[number].prior for number in votes])
    for_it = np.array([agreement(edges[n].prior, edges[n].rivals) for n in votes])
    trusted = np.array([edges[number].trusted for number in votes])
    best = _NONE
    for seed in np.argsort(-priors - trusted, kind="stable")[:MOST_SEEDS].tolist():
        agrees = displacements(back @ motions[seed] @ there, moments) <= tolerance
        others = np.arange(len(votes)) != seed
        doubt = sum(
            disagreement(max(priors[i], _expected(edges[votes[seed]], edges[votes[i]], links)))
            for i in np.flatnonzero(~agrees & others).tolist()
        )
        # Votes and triangles rest on the same pairs in part, so the stronger counts, not the sum.
        belief = beliefs[votes[seed]]
        total = log_odds(priors[seed]) + max(float(for_it[agrees & others].sum()), belief.support)
        total += min(doubt, belief.doubt)
        enough = ENOUGH_IF_TRUSTED if trusted[agrees].any() else ENOUGH
        if total >= enough and total > best.log_odds:
            best = _Join(total, motions[seed], tuple(votes[i] for i in np.flatnonzero(agrees).tolist()))
    return best


def _expected(right: Edge, other: Edge, links: Mapping[int, Mapping[int, float]]) -> float:
    """Return the chance that ``other`` is right too if ``right`` is, by the overlap that follows.

    The ends of the other pair overlap with those of the first, in their groups, by known shares, or
    are the same scans; what two scans share with a third they share by about the product.
    """
    ends, others = (right.source, right.target), (other.source, other.target)
    shares = [links[ends[0]].get(others[i], 0.0) * links[ends[1]].get(others[1 - i], 0.0) for i in range(2)]
    slope, most = FOUND
    return min(most, slope * right.overlap * max(shares))


def _ordered(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)
