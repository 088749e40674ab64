"""All transformations of a group at once: the ones that all its pairs agree on best.

Gauss-Newton on rigid motions with robust weights. A pair says where its source lies; by how much the
current transformations miss that is a twist (omega, v) in the group's frame about the middle of
the overlap, and moving the target by a small twist adds to it what moving the source takes away. Each
twist counts by the covariance that the pair's overlap gives it, so that a pair of two flat
pieces has no say about sliding.

SciPy's sparse solver in float64 does it in a few lines, the same on every machine; Open3D's optimiser
asks for distances in the scans' unit to tell a wrong edge and for a library that does not load
everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from utopic_cli.geometry.rigid import apply, invert, nearest_rotation, rigid, rotation_from_vector
from utopic_cli.multiway.edges import Edge, ScanShape
from utopic_cli.multiway.loops import CLOSES

OUTLYING = 0.01
"""A pair that is missed by this share of the scan's size counts half."""

INFLATION = 9.0
"""Neighbouring points err alike, so a covariance that takes them as independent is too small."""

FLOOR_DEG, FLOOR_SHARE = 0.2, 0.001
"""No pair is believed to be more exact than this: degrees, and share of the scan's size."""

MOST_STEPS = 30
SMALLEST_STEP = 1e-9
ROUNDS = 5


@dataclass(frozen=True)
class Settled:
    """Scans that hold together after optimisation.

    Attributes:
        T_group_scan: (4, 4) by scan, between centred frames.
        used: numbers of the edges it rests on.
        missed: by how much each edge inside the group is missed (share of the scan's size), by number.
    """

    T_group_scan: dict[int, np.ndarray]
    used: tuple[int, ...]
    missed: dict[int, float]


def settle(
    T_group_scan: Mapping[int, np.ndarray], edges: Sequence[Edge], shapes: Mapping[int, ScanShape]
) -> list[Settled]:
    """Optimise a group, leaving out the pairs that contradict it.

    Args:
        T_group_scan: rough transformations of its scans, between centred frames.
        edges: all edges; those with both ends in the group count.
        shapes: of the scans.

    Returns:
        The group, or the parts that it falls into without the pairs that contradict it.
    """
    inside = [n for n, edge in enumerate(edges) if {edge.source, edge.target} <= T_group_scan.keys()]
    current = dict(T_group_scan)
    missed = {n: _missed(current, edges[n], shapes) for n in inside}
    # Rough transformations miss more than optimised ones; the tree they came from must stay in.
    used = [n for n in inside if missed[n] <= 2.5 * CLOSES]
    for _ in range(ROUNDS):
        parts = _connected(sorted(current), [edges[n] for n in used])
        if len(parts) > 1:
            apart = ({scan: current[scan] for scan in part} for part in parts)
            return [settled for part in apart for settled in settle(part, edges, shapes)]
        current = optimise(current, [edges[n] for n in used], shapes)
        missed = {n: _missed(current, edges[n], shapes) for n in inside}
        agreeing = [n for n in inside if missed[n] <= CLOSES]
        if agreeing == used:
            break
        used = agreeing
    return [
        Settled(
            {scan: current[scan] for scan in sorted(part)},
            tuple(n for n in used if edges[n].source in part),
            {n: missed[n] for n in inside if {edges[n].source, edges[n].target} <= part},
        )
        for part in _connected(sorted(current), [edges[n] for n in used])
    ]


def optimise(
    T_group_scan: Mapping[int, np.ndarray], edges: Sequence[Edge], shapes: Mapping[int, ScanShape]
) -> dict[int, np.ndarray]:
    """Return the transformations that miss the edges least; the first scan's stays as it is.

    Args:
        T_group_scan: (4, 4) by scan, between centred frames: a rough start.
        edges: between these scans.
        shapes: of the scans.
    """
    scans = sorted(T_group_scan)
    current = {scan: T_group_scan[scan] for scan in scans}
    place = {scan: i - 1 for i, scan in enumerate(scans)}  # -1: the first, which stays
    unknowns = 6 * (len(scans) - 1)
    if not unknowns or not edges:
        return current
    size = float(np.mean([shapes[scan].size for scan in scans]))
    for _ in range(MOST_STEPS):
        matrix, right = _normal_equations(current, edges, shapes, place, unknowns)
        step = np.atleast_1d(spsolve(matrix, right)).reshape(-1, 6)
        for scan in scans[1:]:
            omega, shift = step[place[scan], :3], step[place[scan], 3:]
            moved = rigid(rotation_from_vector(omega), shift) @ current[scan]
            moved[:3, :3] = nearest_rotation(moved[:3, :3])
            current[scan] = moved
        if max(np.abs(step[:, :3]).max(), np.abs(step[:, 3:]).max() / size) < SMALLEST_STEP:
            break
    return current


def _normal_equations(
    current: Mapping[int, np.ndarray],
    edges: Sequence[Edge],
    shapes: Mapping[int, ScanShape],
    place: Mapping[int, int],
    unknowns: int,
) -> tuple[csc_matrix, np.ndarray]:
    rows, columns, values = [], [], []
    right = np.zeros(unknowns)
    block_rows, block_columns = (index.ravel() for index in np.indices((6, 6)))
    for edge in edges:
        placed = current[edge.target]
        error = placed @ edge.T_target_source @ invert(current[edge.source])
        centre = apply(placed, edge.centre)
        twist = np.concatenate(
            [Rotation.from_matrix(error[:3, :3]).as_rotvec(), apply(error, centre) - centre]
        )
        weight = 1.0 / (1.0 + (_missed(current, edge, shapes) / OUTLYING) ** 2)
        about = np.eye(6)  # a twist about the group's origin, as seen at the centre
        about[3:, :3] = -_cross_matrix(centre)
        information = weight * _information(edge, placed[:3, :3], shapes)
        block = about.T @ information @ about
        pull = about.T @ information @ twist
        ends = ((place[edge.target], 1.0), (place[edge.source], -1.0))
        for end, sign in ends:
            if end < 0:
                continue
            right[6 * end : 6 * end + 6] -= sign * pull
            for other, other_sign in ends:
                if other >= 0:
                    rows.append(6 * end + block_rows)
                    columns.append(6 * other + block_columns)
                    values.append(sign * other_sign * block.ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csc_matrix(coo_matrix(entries, shape=(unknowns, unknowns))), right


def _information(edge: Edge, rotation: np.ndarray, shapes: Mapping[int, ScanShape]) -> np.ndarray:
    """Return the (6, 6) inverse covariance of an edge's twist in the group's frame."""
    size = shapes[edge.source].size
    turn = np.kron(np.eye(2), rotation)
    floor = np.diag([np.radians(FLOOR_DEG) ** 2] * 3 + [(FLOOR_SHARE * size) ** 2] * 3)
    return np.linalg.inv(INFLATION * turn @ edge.covariance @ turn.T + floor)


def _missed(current: Mapping[int, np.ndarray], edge: Edge, shapes: Mapping[int, ScanShape]) -> float:
    back = invert(current[edge.source]) @ current[edge.target] @ edge.T_target_source
    return shapes[edge.source].displacement(back)


def _connected(scans: list[int], edges: Sequence[Edge]) -> list[set[int]]:
    place = {scan: i for i, scan in enumerate(scans)}
    ends = np.array([(place[edge.source], place[edge.target]) for edge in edges]).reshape(-1, 2)
    links = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(scans), len(scans)))
    count, label = connected_components(links, directed=False)
    return [
        {scan for scan, part in zip(scans, label, strict=True) if part == number} for number in range(count)
    ]


def _cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) matrix of ``x -> vector x x``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
