from __future__ import annotations

import numpy as np

from tests.multiway.stubs import report
from tests.multiway.test_graph import World
from utopic_cli.multiway import pairs as choice


def test_the_fixed_ways_of_choosing():
    assert choice.every_pair([0, 1, 3]) == [(1, 0), (3, 0), (3, 1)]
    assert choice.sequential_pairs([0, 1, 2, 5]) == [(1, 0), (2, 1), (2, 0), (5, 2), (5, 1), (5, 0)]
    assert choice.sequential_pairs([4]) == []
    assert choice.pairs_to_first([2, 5, 7]) == [(5, 2), (7, 2)]


def test_similar_scans_are_paired_and_the_order_is_probed():
    rng = np.random.default_rng(0)
    kind = {scan: scan % 3 for scan in range(30)}
    descriptors = {scan: 5.0 * np.eye(3)[kind[scan]] + 0.1 * rng.standard_normal(3) for scan in kind}
    pairs = choice.similar_pairs(descriptors)
    assert all(later > earlier for later, earlier in pairs)
    probes = [pair for pair in pairs if pair[0] - pair[1] == 1]
    assert len(probes) == choice.PROBES
    assert (1, 0) in probes and (29, 28) in probes
    alike = [pair for pair in pairs if pair[0] - pair[1] > 1]
    assert len(alike) >= 30 and all(kind[a] == kind[b] for a, b in alike)
    assert len(pairs) < 30 * 29 / 4


def test_the_next_pairs_close_loops_and_reach_out_to_other_groups():
    world = World(6)
    for pair in ((1, 0), (2, 1), (4, 3)):
        world.pair(*pair)
    descriptors = {scan: np.array([float(scan), 0.0]) for scan in range(6)}
    model = world.model()
    more = choice.further_pairs(model, descriptors, set(world.records))
    assert (2, 0) in more  # closes the loop 0-1-2
    assert (3, 2) in more  # the most similar scans of two groups
    assert (5, 4) in more  # the lone scan and its most similar one
    assert not set(more) & set(world.records)
    for pair in more:
        world.pair(*pair)
    assert choice.further_pairs(world.model(), descriptors, set(world.records)) == []


def test_a_scan_left_over_is_tried_with_other_groups_than_those_that_refused_it():
    """Scan 0 looks a little more like the scans of two strange objects than like those of its own."""
    world = World(16, objects=3)
    world.object[0] = 2
    for source, target in [(b, a) for a in range(1, 16) for b in range(a + 1, 16)]:
        if world.object[source] == world.object[target]:
            world.pair(source, target)
    for target in (3, 6):
        world.pair(target, 0, right=False, trusted=False, confidence=0.01)
    model = world.model()
    assert model.alone == (0,)
    looks = {0: 1.0, 1: 1.1, 2: 1.15}
    descriptors = {scan: np.array([looks[world.object[scan]] + 1e-4 * scan]) for scan in range(1, 16)}
    descriptors[0] = np.zeros(1)
    more = choice.further_pairs(model, descriptors, set(world.records))
    assert {1, 2} <= {world.object[source] for source, target in more if target == 0}


def test_pairs_without_overlap_predict_no_loops():
    world = World(3)
    for pair in ((1, 0), (2, 1)):
        world.pair(*pair, overlap=0.2)
    descriptors = {scan: np.array([float(scan)]) for scan in range(3)}
    assert choice.further_pairs(world.model(), descriptors, set(world.records)) == []
    assert report(np.eye(4))["trusted"]


def test_neighbours_in_order_are_tried_where_the_order_means_something():
    """Forty scans of one object in a row, or of objects in turn; only the probes tell."""
    for objects, ordered in ((1, True), (8, False)):
        world = World(40, objects=objects)
        descriptors = {scan: np.array([scan % objects, world.rng.uniform()]) for scan in range(40)}
        for source, target in choice.similar_pairs(descriptors):
            right = world.object[source] == world.object[target]
            world.pair(source, target, right=right, trusted=right, confidence=0.97 if right else 0.01)
        chain = {(scan, scan - 1) for scan in range(1, 40)}
        assert not chain <= set(world.records)
        more = choice.further_pairs(world.model(), descriptors, set(world.records))
        assert (chain <= set(more) | set(world.records)) == ordered
        if not ordered:  # a few of them are alike, too
            assert len(chain & set(more)) < 6
