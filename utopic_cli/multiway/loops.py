"""What triangles of pairs say of each pair: right ones agree, wrong ones nearly never do.

Three scans registered in all three ways close a loop. If all three answers are right, going round
it leads back; if one is wrong, it does so by accident only. Each triangle through an edge thus
multiplies the odds that the edge is right: by

    (q + (1 - q) a) / a     where the loop closes,
    1 - q                   where it does not,

q being the chance that both other edges are right, from those pairs alone, and a that of an accident:
small, but not where a pair has rivals, for the answers of symmetric scans are wrong in few ways.
The triangles through one edge share no other edge, so their evidence adds up without being
counted twice.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from utopic_cli.geometry.rigid import invert
from utopic_cli.multiway.edges import LEAST, Edge, ScanShape

CLOSES = 0.03
"""A loop of three closes if it moves the points of its first scan by no more than this share of its size."""

ACCIDENT = 0.02
"""Chance that a wrong answer closes a loop: scans of one object are not wrong in just any way."""


UNRELIABLE = 0.1
"""What a loop through a pair with less chance to be right says of the others is worth nothing to a reader."""


@dataclass(frozen=True)
class Belief:
    """What is thought of one edge.

    Attributes:
        support: by how much the triangles that close raise the log odds that it is right.
        doubt: by how much those that don't change them: a negative number, or 0.
        agree: triangles through it that close.
        disagree: triangles through it that don't.
        weighty: those of them whose other two pairs are both reliable.
    """

    support: float
    doubt: float
    agree: int
    disagree: int
    weighty: int = 0


def log_odds(chance: float) -> float:
    """Return ln(p / (1 - p))."""
    return math.log(chance / (1.0 - chance))


def agreement(chance: float, rivals: int) -> float:
    """Return by how much evidence that is right with this chance raises the log odds when it agrees.

    Args:
        chance: that it is right.
        rivals: how many other answers fit nearly as well: any of them may come up.
    """
    accident = 1.0 / (1 + rivals) if rivals else ACCIDENT
    return math.log((chance + (1.0 - chance) * accident) / accident)


def disagreement(chance: float) -> float:
    """Return by how much it changes them when it disagrees: a negative number."""
    return math.log(1.0 - chance)


def settle_rivals(edges: Sequence[Edge], shapes: Mapping[int, ScanShape]) -> list[Edge]:
    """Take a rival in place of an answer where loops speak against the answer and for the rival.

    Only triangles whose other two pairs have no rivals are asked: symmetric scans can be put together
    in several ways all of whose loops close. What is taken is never trusted by itself.

    Args:
        edges: at most one for any two scans.
        shapes: of the scans, by index.

    Returns:
        The edges, some with another transformation.
    """
    sure: dict[int, dict[int, Edge]] = defaultdict(dict)
    for edge in edges:
        if not edge.rivals:
            sure[edge.source][edge.target] = sure[edge.target][edge.source] = edge
    return [_settled(edge, sure, shapes) if edge.alternatives else edge for edge in edges]


def _settled(edge: Edge, sure: Mapping[int, dict[int, Edge]], shapes: Mapping[int, ScanShape]) -> Edge:
    answers = (edge.T_target_source, *edge.alternatives)
    votes = np.zeros(len(answers))
    beside, beyond = sure.get(edge.source, {}), sure.get(edge.target, {})
    for third in sorted(beside.keys() & beyond.keys()):
        chance = beside[third].prior * beyond[third].prior
        back = invert(_along(beside[third], edge.source)) @ _along(beyond[third], edge.target)
        for i, answer in enumerate(answers):
            closes = shapes[edge.source].displacement(back @ answer) <= CLOSES
            votes[i] += agreement(chance, edge.rivals) if closes else disagreement(chance)
    best = int(np.argmax(votes))
    if not best or votes[best] <= 0.0 or votes[0] >= 0.0:
        return edge
    prior = max(LEAST, min(edge.prior, (1.0 - edge.prior) / edge.rivals))
    return replace(edge, T_target_source=answers[best], prior=prior, trusted=False)


def believe(edges: Sequence[Edge], shapes: Mapping[int, ScanShape]) -> list[Belief]:
    """Weigh every edge by the triangles it is part of.

    Args:
        edges: at most one for any two scans.
        shapes: of the scans, by index.
    """
    support, doubt = [0.0] * len(edges), [0.0] * len(edges)
    agree, disagree, weighty = [0] * len(edges), [0] * len(edges), [0] * len(edges)
    neighbours: dict[int, dict[int, int]] = defaultdict(dict)
    for number, edge in enumerate(edges):
        neighbours[edge.source][edge.target] = number
        neighbours[edge.target][edge.source] = number
    for first in sorted(neighbours):
        for second in sorted(n for n in neighbours[first] if n > first):
            for third in sorted(n for n in neighbours[first] if n > second and n in neighbours[second]):
                corners = ((first, second), (second, third), (third, first))
                sides = [neighbours[a][b] for a, b in corners]
                motion = np.eye(4)
                for (start, _), side in zip(corners, sides, strict=True):
                    motion = _along(edges[side], start) @ motion
                rivals = max(edges[side].rivals for side in sides)
                closes = shapes[first].displacement(motion) <= CLOSES
                for place, side in enumerate(sides):
                    beside = [edges[other].prior for i, other in enumerate(sides) if i != place]
                    others = math.prod(beside)
                    if closes:
                        support[side] += agreement(others, rivals)
                        agree[side] += 1
                    else:
                        doubt[side] += disagreement(others)
                        disagree[side] += 1
                        weighty[side] += min(beside) >= UNRELIABLE
    return [Belief(*row) for row in zip(support, doubt, agree, disagree, weighty, strict=True)]


def _along(edge: Edge, start: int) -> np.ndarray:
    """Return the transformation from scan ``start`` to the edge's other scan."""
    return edge.T_target_source if edge.source == start else invert(edge.T_target_source)
