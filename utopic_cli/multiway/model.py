"""What a batch knows when its pairs are done: groups, where every scan lies, what became of each pair."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from utopic_cli.geometry.rigid import invert, rigid
from utopic_cli.multiway.edges import Edge, ScanShape, make_edge
from utopic_cli.multiway.groups import find_groups
from utopic_cli.multiway.loops import Belief, believe, settle_rivals
from utopic_cli.multiway.pose_graph import settle

USED, REJECTED, UNCONFIRMED, UNUSABLE, FAILED = "used", "rejected", "unconfirmed", "unusable", "failed"

INSTEAD = "not as answered but as another pose that fits about as well (ambiguous_with): loops say so"


@dataclass(frozen=True)
class PairAnswer:
    """What became of a pair.

    Attributes:
        source: index of the scan that moves.
        target: index of the scan that stays.
        verdict: ``used``; ``rejected``: it contradicts the pose graph; ``unconfirmed``: between
            groups, and neither trusted by itself nor confirmed by loops; ``unusable``: it can't be
            an edge; ``failed``: there is no answer.
        reason: why, in plain words; of what is ``used`` only where a rival answer is.
        belief: what triangles say of it, or None.
        loops: triangles through it that close and that don't; of a pair that is ``used`` only those
            whose pairs all are.
        missed: by how much the final transformations miss it, as a share of the source's size.
        prior: chance that it is right from the pair alone, or None.
        overlap: the smaller overlap ratio, or None.
    """

    source: int
    target: int
    verdict: str
    reason: str = ""
    belief: Belief | None = None
    loops: tuple[int, int] | None = None
    missed: float | None = None
    prior: float | None = None
    overlap: float | None = None


@dataclass(frozen=True)
class ModelGroup:
    """Two or more scans in one frame, that of the first.

    Attributes:
        T_world_scan: (4, 4) by scan, file units; scans ascending; of the first one the identity.
        evidence: chance that its weakest join is right.
    """

    T_world_scan: dict[int, np.ndarray]
    evidence: float


@dataclass(frozen=True)
class Model:
    """Where scans lie.

    Attributes:
        groups: largest first; each of two scans or more.
        alone: scans that connect with no other.
        pairs: what became of every pair tried, in the order of the records.
    """

    groups: tuple[ModelGroup, ...]
    alone: tuple[int, ...]
    pairs: tuple[PairAnswer, ...]

    def group_of(self) -> dict[int, int]:
        """Return the group's number (from 0) by scan; scans alone have none."""
        return {scan: number for number, group in enumerate(self.groups) for scan in group.T_world_scan}


def build_model(records: Mapping[tuple[int, int], Mapping[str, Any]], shapes: dict[int, ScanShape]) -> Model:
    """Find groups and transformations from all pairs' records.

    Args:
        records: by (source, target): ``status`` and, if it is ``done``, ``report``; else ``problem``.
        shapes: of the scans that could be read, by index.
    """
    edges: list[Edge] = []
    number_of: dict[tuple[int, int], int] = {}
    answers: dict[tuple[int, int], PairAnswer] = {}
    for (source, target), record in records.items():
        if record["status"] != "done":
            answers[source, target] = PairAnswer(source, target, FAILED, str(record["problem"]))
            continue
        overlap = min(record["report"]["overlap_ratio"].values())
        edge, reason = make_edge(source, target, record["report"], shapes)
        if edge is None:
            answers[source, target] = PairAnswer(source, target, UNUSABLE, reason, overlap=overlap)
        else:
            number_of[source, target] = len(edges)
            edges.append(edge)
    given = edges
    edges = settle_rivals(edges, shapes)
    beliefs = believe(edges, shapes)
    used: set[int] = set()
    missed: dict[int, float] = {}
    groups: list[ModelGroup] = []
    alone: list[int] = []
    for rough in find_groups(edges, beliefs, shapes):
        for part in settle(rough.T_group_scan, edges, shapes):
            used.update(part.used)
            missed.update(part.missed)
            if len(part.T_group_scan) == 1:
                alone += part.T_group_scan
            else:
                evidence = 1.0 / (1.0 + math.exp(-min(rough.evidence, 700.0)))
                groups.append(ModelGroup(_in_file_units(part.T_group_scan, shapes), evidence))
    kept = sorted(used)
    counted = dict(enumerate(beliefs))
    counted.update(zip(kept, believe([edges[number] for number in kept], shapes), strict=True))
    for pair, number in number_of.items():
        edge, belief = edges[number], beliefs[number]
        loops = counted[number].agree, counted[number].disagree
        if number in used:
            verdict, reason = USED, "" if edge is given[number] else INSTEAD
        elif number in missed:
            verdict, reason = REJECTED, f"contradicts the group by {missed[number]:.1%} of the scan's size"
        elif belief.disagree and not (belief.agree or belief.weighty):
            verdict, reason = UNCONFIRMED, "its loops run through unreliable pairs"
        elif belief.disagree > belief.agree:
            verdict, reason = UNCONFIRMED, f"loops: {belief.disagree} against it, {belief.agree} for it"
        else:
            verdict, reason = UNCONFIRMED, "not trusted by itself, and too few loops confirm it"
        answers[pair] = PairAnswer(
            *pair, verdict, reason, belief, loops, missed.get(number), edge.prior, edge.overlap
        )
    groups.sort(key=lambda group: (-len(group.T_world_scan), min(group.T_world_scan)))
    return Model(tuple(groups), tuple(sorted(alone)), tuple(answers[pair] for pair in records))


def _in_file_units(
    T_group_scan: Mapping[int, np.ndarray], shapes: Mapping[int, ScanShape]
) -> dict[int, np.ndarray]:
    """Take transformations between centred scans to files' coordinates and the first scan's frame."""
    scans = sorted(T_group_scan)
    first = scans[0]
    world = rigid(np.eye(3), shapes[first].centroid) @ invert(T_group_scan[first])
    result = {first: np.eye(4)}
    for scan in scans[1:]:
        result[scan] = world @ T_group_scan[scan] @ rigid(np.eye(3), -shapes[scan].centroid)
    return result
