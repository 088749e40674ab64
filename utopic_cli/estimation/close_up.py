"""A close-up of a candidate: what each sampled point sees of the other scan, for the verifier to read.

A right transformation and a wrong one that lays the surfaces as closely differ in detail: whether what
lies apart does so at random (noise) or together (two surfaces), how far the agreement reaches, what stands in
the other scan's empty space, and whether what the network matched is where it meets. ``Candidate.standing``
is made of averages over the scans; here are the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.estimation.candidates import LEAST_SUPPORT, Candidate
from utopic_cli.estimation.meeting import MEETING
from utopic_cli.estimation.problem import Problem
from utopic_cli.estimation.surface import Surface
from utopic_cli.estimation.verification import FREE_SPACE_MARGIN
from utopic_cli.geometry import rigid
from utopic_cli.geometry.nearest import nearest

NODES = 256
"""Sampled points of each scan that are looked at."""

NEIGHBOURHOODS = (4, 16, 64)
"""Dense points round a node over which is averaged."""

POINT_FEATURES = 5 * len(NEIGHBOURHOODS) + 11
WHOLE_FEATURES = 13

MATCHED = 1.6
"""Node spacings within which two nodes are the same place."""

FARTHEST = 12.0
"""Voxels; farther from the other scan is as far."""


@dataclass(frozen=True)
class CloseUp:
    """What there is to see of one candidate; the same, but for the points' order, with the scans swapped.

    Attributes:
        points: (P, ``POINT_FEATURES``) float32 of nodes of both scans. For each neighbourhood: share that
            meets the other scan, and of that the mean distance from its tangent planes with sign, without,
            the mean cosine between the normals, and the scatter of the distances; distance of the node, in
            all and along the surface; how rough and how curved its own surface is; whether it stands in what
            the other scan saw past, by two margins; how much of its matching score lies where it comes to
            lie; its overlap, uncertainty, total and largest matching score at first sight. Lengths in voxels.
        whole: (``WHOLE_FEATURES``,) float32 of the candidate: support, score, fit, and the ``Meeting``.
    """

    points: np.ndarray
    whole: np.ndarray


@dataclass(frozen=True)
class _Scan:
    """One scan's part in every close-up.

    Attributes:
        surface: of the scan.
        nodes: (P, 3) the nodes looked at.
        around: (P, K) rows of their nearest dense points, nearest first.
        shape: (P, 2) roughness and curvature.
        seen: (P, 4) what the network sees in them at first sight.
        scores: (P, M) their matching scores.
    """

    surface: Surface
    nodes: np.ndarray
    around: np.ndarray
    shape: np.ndarray
    seen: np.ndarray
    scores: np.ndarray


def close_ups(problem: Problem, candidates: Sequence[Candidate]) -> list[CloseUp]:
    """Look closely at weighed candidates of one problem.

    Args:
        problem: that they are candidates for.
        candidates: weighed ones.
    """
    surfaces = problem.surfaces
    source = _scan(
        surfaces[0],
        problem.source_nodes,
        problem.matching_scores,
        problem.source_overlap,
        problem.source_certainty,
    )
    target = _scan(
        surfaces[1],
        problem.target_nodes,
        problem.matching_scores.T,
        problem.target_overlap,
        problem.target_certainty,
    )
    reach = MATCHED * problem.spacing
    found = []
    for candidate in candidates:
        T = candidate.T_target_source
        there = _one_way(source, surfaces[1], T, problem.target_nodes, reach)
        back = _one_way(target, surfaces[0], rigid.invert(T), problem.source_nodes, reach)
        found.append(CloseUp(np.concatenate([there, back]).astype(np.float32), _whole(candidate)))
    return found


def _scan(
    surface: Surface, nodes: np.ndarray, scores: np.ndarray, overlap: np.ndarray, certainty: np.ndarray
) -> _Scan:
    # Nodes come in the order of a farthest-point sampling or of a grid: evenly spaced ones are spread.
    chosen = np.linspace(0, len(nodes) - 1, min(NODES, len(nodes))).astype(np.int64)
    nodes, scores = nodes[chosen], scores[chosen]
    most = min(NEIGHBOURHOODS[-1], len(surface.points))
    around = nearest(surface.tree, nodes, list(range(1, most + 1)))[1]
    points, normals = surface.points, surface.normals
    own = normals[around[:, 0]]
    away = points[around[:, : NEIGHBOURHOODS[1]]] - points[around[:, 0]][:, None]
    roughness = np.abs(np.einsum("pkd,pd->pk", away, own)).mean(axis=1) / surface.voxel
    curvature = 1.0 - np.einsum("pkd,pd->pk", normals[around], own).mean(axis=1)
    seen = (2.0 * overlap[chosen] - 1.0, 1.0 - certainty[chosen], _log(scores.sum(1)), _log(scores.max(1)))
    return _Scan(
        surface,
        nodes,
        around,
        np.stack([np.minimum(roughness, 4.0), curvature], axis=1),
        np.stack(seen, axis=1),
        scores,
    )


def _one_way(scan: _Scan, other: Surface, T: np.ndarray, other_nodes: np.ndarray, reach: float) -> np.ndarray:
    """Features (P, ``POINT_FEATURES``) of one scan's nodes, moved by T (4, 4) onto the other scan."""
    surface, voxel = scan.surface, other.voxel
    moved = rigid.apply(T, surface.points)
    distance, index = nearest(other.tree, moved)
    plane = other.normals[index]
    beside = np.einsum("nd,nd->n", moved - other.points[index], plane) / voxel
    cosine = np.einsum("nd,nd->n", surface.normals @ T[:3, :3].T, plane)
    distance = distance / voxel
    along = np.sqrt(np.maximum(distance**2 - beside**2, 0.0))
    meets = distance < MEETING
    beside = np.where(meets, beside, 0.0)
    features = []
    for count in NEIGHBOURHOODS:
        rows = scan.around[:, :count]
        met = meets[rows].sum(axis=1)
        of_met = 1.0 / np.maximum(met, 1)
        mean = beside[rows].sum(axis=1) * of_met
        variance = (beside[rows] ** 2).sum(axis=1) * of_met - mean**2
        features += [
            met / rows.shape[1],
            mean,
            np.abs(beside[rows]).sum(axis=1) * of_met,
            np.where(meets, cosine, 0.0)[rows].sum(axis=1) * of_met,
            np.sqrt(np.maximum(variance, 0.0)),
        ]
    nodes = rigid.apply(T, scan.nodes)
    near = np.linalg.norm(nodes[:, None] - other_nodes, axis=2) < reach
    at = scan.around[:, 0]
    features += [
        np.minimum(distance[at], FARTHEST) / 4.0,
        np.minimum(along[at], MEETING),
        *scan.shape.T,
        other.sight.in_front(nodes, FREE_SPACE_MARGIN * voxel),
        other.sight.in_front(nodes, 2.0 * FREE_SPACE_MARGIN * voxel),
        _log((scan.scores * near).sum(axis=1)),
        *scan.seen.T,
    ]
    return np.stack(features, axis=1)


def _whole(candidate: Candidate) -> np.ndarray:
    meeting = candidate.meeting
    if meeting is None:
        raise ValueError("a candidate that was not weighed has no close-up")
    values = (
        np.log10(max(candidate.support, LEAST_SUPPORT)),
        candidate.score,
        candidate.fit,
        min(meeting.source_share, meeting.target_share),
        max(meeting.source_share, meeting.target_share),
        meeting.agreement,
        meeting.likeness,
        meeting.tightness,
        meeting.looseness,
        min(meeting.turning, 0.5),
        min(meeting.violation, 0.5),
        min(meeting.conflict, 1.0),
        np.log10(max(meeting.contradiction, 1e-3)),
    )
    return np.array(values, np.float32)


def _log(score: np.ndarray) -> np.ndarray:
    """Matching scores from 1e-4 to 1 as -2 to 0."""
    return np.log10(score + 1e-4) / 2.0
