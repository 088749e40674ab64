"""Pairs that fit in two ways: the other way is taken where loops of sure pairs say so, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from tests.multiway.test_graph import World, every
from utopic_cli.geometry.rigid import invert, rigid
from utopic_cli.multiway.edges import make_edge
from utopic_cli.multiway.loops import settle_rivals
from utopic_cli.multiway.model import INSTEAD, REJECTED, USED


def half_turned(world, scan):
    """Where the scan would lie, turned by half about an axis through its middle."""
    middle = (world.world[scan] @ [*world.shapes[scan].centroid, 1.0])[:3]
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    return rigid(np.eye(3), middle) @ half @ rigid(np.eye(3), -middle) @ world.world[scan]


def ambiguous_pair(world, source, target, *, flipped):
    """A pair that two answers fit; the wrong one comes first where it is flipped."""
    back = invert(world.world[target])
    answers = [back @ world.world[source], back @ half_turned(world, source)]
    if flipped:
        answers.reverse()
    world.pair(source, target, right=False, motion=answers[0], trusted=False, confidence=0.4)
    world.records[source, target]["report"]["ambiguous_with"] = [answers[1].tolist()]


@pytest.mark.parametrize("seed", range(3))
def test_flipped_pairs_are_turned_back_and_say_so(seed):
    world = World(8, seed=seed)
    flipped, upright = {(4, 1), (7, 2)}, {(5, 0)}
    for pair in every(8):
        if pair in flipped | upright:
            ambiguous_pair(world, *pair, flipped=pair in flipped)
        else:
            world.pair(*pair)
    model = world.model()
    assert {pair.verdict for pair in model.pairs} == {USED}
    assert {(p.source, p.target) for p in model.pairs if p.reason == INSTEAD} == flipped
    assert world.worst_error(model.groups[0])[0] < 0.4


def test_a_scan_tied_by_flipped_pairs_only_where_a_loop_is_sure_of_it():
    world = World(5)
    for pair in every(4):
        world.pair(*pair)
    ambiguous_pair(world, 4, 0, flipped=True)
    ambiguous_pair(world, 4, 1, flipped=False)
    before = dict(world.records)
    edges = [make_edge(*pair, record["report"], world.shapes)[0] for pair, record in before.items()]
    assert settle_rivals(edges, world.shapes) == edges  # no triangle of sure pairs goes through scan 4
    world.pair(4, 2)
    assert {pair.verdict for pair in world.model().pairs} == {USED}


def test_scans_that_are_ambiguous_throughout_are_not_put_together_by_choice():
    """Each pair may be flipped so that all loops close, in many ways; none of them is taken."""
    world = World(6, seed=1)
    for pair in every(6):
        ambiguous_pair(world, *pair, flipped=bool(world.rng.random() < 0.5))
    assert not any(pair.reason == INSTEAD for pair in world.model().pairs)


def test_a_rival_that_loops_contradict_too_is_not_taken():
    world = World(5)
    for pair in every(5):
        world.pair(*pair, right=pair != (3, 1))
    world.records[3, 1]["report"]["ambiguous_with"] = [np.eye(4).tolist()]
    assert world.verdicts()[3, 1] == REJECTED
