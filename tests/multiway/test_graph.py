from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.multiway.stubs import jittered, random_motion, report
from utopic_cli.geometry.rigid import invert, relative_rotation_error_deg, rigid
from utopic_cli.multiway.edges import ScanShape, make_edge
from utopic_cli.multiway.loops import believe
from utopic_cli.multiway.model import REJECTED, UNCONFIRMED, UNUSABLE, USED, build_model
from utopic_cli.multiway.pose_graph import settle

CENTROID = np.array([0.3, -0.2, 0.1])
MOMENTS = np.diag([0.3, 0.2, 0.1])


class World:
    """Scans of one or more objects, in frames of their own, and pairs between them."""

    def __init__(self, count, *, objects=1, seed=0, far=0.0):
        self.rng = np.random.default_rng(seed)
        self.object = [i % objects for i in range(count)]
        self.world = [random_motion(self.rng) for _ in range(count)]
        for world in self.world:
            world[:3, 3] += far
        shape = MOMENTS, CENTROID
        self.shapes = {
            i: ScanShape(
                invert(world)[:3, :3] @ shape[1]
                + invert(world)[:3, 3]
                + invert(world)[:3, :3] @ np.full(3, far),
                world[:3, :3].T @ shape[0] @ world[:3, :3],
            )
            for i, world in enumerate(self.world)
        }
        self.records = {}

    def pair(self, source, target, *, right=True, motion=None, **kwargs):
        answer = invert(self.world[target]) @ self.world[source]
        if not right:
            answer = motion if motion is not None else random_motion(self.rng)
        # Errors turn about the scan, wherever its frame's origin lies.
        here = rigid(np.eye(3), self.shapes[target].centroid)
        answer = here @ jittered(invert(here) @ answer, self.rng)
        centre = self.shapes[target].centroid
        done = report(answer, centre=centre, **kwargs)
        self.records[source, target] = {"status": "done", "report": done}

    def model(self):
        return build_model(self.records, self.shapes)

    def verdicts(self):
        return {(pair.source, pair.target): pair.verdict for pair in self.model().pairs}

    def worst_error(self, group):
        first, place = min(group.T_world_scan), group.T_world_scan
        errors = []
        for scan, transformation in place.items():
            known = invert(self.world[first]) @ self.world[scan]
            centre = self.shapes[scan].centroid
            gap = (transformation - known) @ [*centre, 1.0]
            errors.append((relative_rotation_error_deg(transformation, known), np.linalg.norm(gap)))
        return np.max(errors, axis=0)


def every(count):
    return [(b, a) for a, b in itertools.combinations(range(count), 2)]


def test_trusted_pairs_make_one_group_in_the_first_scan_s_frame():
    world = World(6)
    for pair in every(6):
        world.pair(*pair)
    model = world.model()
    assert [list(group.T_world_scan) for group in model.groups] == [[0, 1, 2, 3, 4, 5]]
    assert not model.alone
    assert (model.groups[0].T_world_scan[0] == np.eye(4)).all()
    degrees, gap = world.worst_error(model.groups[0])
    assert degrees < 0.4 and gap < 0.01
    assert {pair.verdict for pair in model.pairs} == {USED}


def test_many_pairs_place_scans_better_than_a_chain():
    errors = []
    for pairs in ([(i + 1, i) for i in range(11)], every(12)):
        world = World(12, seed=3)
        for pair in pairs:
            world.pair(*pair)
        errors.append(world.worst_error(world.model().groups[0])[0])
    assert errors[1] < 0.6 * errors[0]


def test_coordinates_far_from_the_origin_lose_nothing():
    world = World(5, far=5e6)
    for pair in every(5):
        world.pair(*pair)
    degrees, gap = world.worst_error(world.model().groups[0])
    assert degrees < 0.4 and gap < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_wrong_pairs_are_rejected_even_if_trusted(seed):
    world = World(8, seed=seed)
    wrong = {(7, 0), (4, 2), (5, 1)}
    for pair in every(8):
        world.pair(*pair, right=pair not in wrong)
    model = world.model()
    assert len(model.groups) == 1 and len(model.groups[0].T_world_scan) == 8
    assert {pair for pair, verdict in world.verdicts().items() if verdict != USED} == wrong
    assert world.worst_error(model.groups[0])[0] < 0.4
    assert {pair.verdict for pair in model.pairs} == {USED, REJECTED}


def test_a_trusted_pair_that_its_loops_contradict_joins_nothing():
    """Scans 0-3 hold together; 4 is tied to 0 by a trusted wrong pair and to 1-3 by right ones."""
    world = World(5)
    for pair in every(4):
        world.pair(*pair)
    world.pair(4, 0, right=False, confidence=0.98)
    for other in (1, 2, 3):
        world.pair(4, other, confidence=0.8)
    verdicts = world.verdicts()
    assert verdicts[4, 0] == REJECTED
    assert [verdicts[4, other] for other in (1, 2, 3)] == [USED] * 3


def test_untrusted_pairs_join_only_if_several_loops_confirm_them():
    world = World(3)
    for pair in every(3):
        world.pair(*pair, trusted=False, confidence=0.3)
    assert not world.model().groups  # one loop of three weak pairs is not enough
    assert set(world.verdicts().values()) == {UNCONFIRMED}
    world = World(6)
    for pair in every(6):
        world.pair(*pair, trusted=False, confidence=0.4)
    assert len(world.model().groups[0].T_world_scan) == 6


def test_weak_pairs_between_two_sure_groups_join_them_by_agreeing():
    world = World(8, seed=2)
    for group in (range(4), range(4, 8)):
        for a, b in itertools.combinations(group, 2):
            world.pair(b, a)
    world.pair(4, 0, trusted=False, confidence=0.4)
    world.pair(6, 1, trusted=False, confidence=0.4, right=False)
    assert [len(group.T_world_scan) for group in world.model().groups] == [4, 4]
    for pair in ((5, 2), (7, 3), (5, 3)):
        world.pair(*pair, trusted=False, confidence=0.4)
    model = world.model()
    assert [len(group.T_world_scan) for group in model.groups] == [8]
    assert world.verdicts()[6, 1] == REJECTED


def test_a_trusted_pair_joins_two_groups_unless_its_neighbours_should_have_said_so_too():
    world = World(8, seed=4)
    for group in (range(4), range(4, 8)):
        for a, b in itertools.combinations(group, 2):
            world.pair(b, a, overlap=0.8)
    world.pair(4, 0, overlap=0.7, confidence=0.92)
    assert [len(group.T_world_scan) for group in world.model().groups] == [8]
    for pair in ((5, 0), (4, 1), (5, 1)):  # they overlap with it nearly whole, and say otherwise
        world.pair(*pair, right=False, trusted=False, confidence=0.1, overlap=0.1)
    assert [len(group.T_world_scan) for group in world.model().groups] == [4, 4]
    assert world.verdicts()[4, 0] == UNCONFIRMED


@pytest.mark.parametrize("confidence", [None, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_mixed_objects_are_told_apart(confidence, seed):
    """Right pairs within each object, nonsense between them, no verdict or a weak one on anything."""
    world = World(16, objects=2, seed=seed)
    for a, b in every(16):
        right = world.object[a] == world.object[b]
        world.pair(a, b, right=right, trusted=False, confidence=confidence, overlap=0.4 if right else 0.2)
    model = world.model()
    assert [list(group.T_world_scan) for group in model.groups] == [
        list(range(0, 16, 2)),
        list(range(1, 16, 2)),
    ]
    used = {pair for pair, verdict in world.verdicts().items() if verdict == USED}
    assert {(a, b) for a, b in used if world.object[a] != world.object[b]} == set()


def test_a_scan_with_nothing_but_nonsense_stays_alone():
    world = World(6, seed=1)
    for pair in every(6):
        world.pair(
            *pair, right=5 not in pair, trusted=5 not in pair, confidence=0.9 if 5 not in pair else 0.2
        )
    model = world.model()
    assert model.alone == (5,)
    assert len(model.groups[0].T_world_scan) == 5


def test_pairs_that_leave_a_motion_free_or_hardly_overlap_are_no_edges():
    world = World(2)
    good = report(np.eye(4), centre=np.zeros(3))
    assert make_edge(1, 0, good, world.shapes)[0] is not None
    free = {"unobservable": [{"kind": "rotation"}, {"kind": "rotation"}]}
    for change, reason in (
        (free, "leave a rotation free"),
        ({"covariance": None, "covariance_about": None}, "too little overlaps"),
        ({"overlap_ratio": {"source": 0.01, "target": 0.02}, "trusted": False}, "only 2% overlaps"),
    ):
        edge, why = make_edge(1, 0, {**good, **change}, world.shapes)
        assert edge is None and reason in why
    world.records[1, 0] = {"status": "done", "report": {**good, **free}}
    assert world.verdicts() == {(1, 0): UNUSABLE}


def test_an_uncalibrated_pair_alone_is_not_trusted_and_an_ambiguous_one_counts_less():
    world = World(2)
    world.pair(1, 0, confidence=None, trusted=None, overlap=0.9)
    assert not world.model().groups
    plain = report(np.eye(4), confidence=None, trusted=None)
    ambiguous = {**plain, "ambiguous_with": [np.eye(4).tolist()]}
    priors = [make_edge(1, 0, one, world.shapes)[0].prior for one in (plain, ambiguous)]
    assert priors[1] == pytest.approx(priors[0] / 2)


def test_loops_are_counted_for_each_pair():
    world = World(4)
    for pair in every(4):
        world.pair(*pair, right=pair != (3, 0))
    edges = [make_edge(*pair, record["report"], world.shapes)[0] for pair, record in world.records.items()]
    beliefs = dict(zip(world.records, believe(edges, world.shapes), strict=True))
    assert (beliefs[3, 0].agree, beliefs[3, 0].disagree) == (0, 2)
    assert (beliefs[2, 1].agree, beliefs[2, 1].disagree) == (2, 0)
    assert (beliefs[1, 0].agree, beliefs[1, 0].disagree) == (1, 1)
    assert beliefs[2, 1].support > 0 > beliefs[3, 0].doubt


def test_loops_of_a_used_pair_are_those_of_used_pairs():
    """Scan 3 is tied by nonsense that nobody believes: not held against those that hold."""
    world = World(4)
    for pair in every(3):
        world.pair(*pair)
    for other in range(3):
        world.pair(3, other, right=False, confidence=0.05, trusted=False)
    told = {(pair.source, pair.target): pair for pair in world.model().pairs}
    assert told[1, 0].verdict == USED and told[1, 0].belief.disagree == 1
    assert told[1, 0].loops == (1, 0)
    assert told[3, 0].verdict == UNCONFIRMED and told[3, 0].loops == (0, 2)
    assert told[3, 0].reason == "its loops run through unreliable pairs"


def test_loops_of_reliable_pairs_that_speak_against_a_pair_are_its_reason():
    world = World(3)
    world.pair(1, 0)
    world.pair(2, 0, right=False, confidence=0.4, trusted=False)
    world.pair(2, 1, right=False, confidence=0.3, trusted=False)
    told = {(pair.source, pair.target): pair.reason for pair in world.model().pairs}
    assert told[2, 0] == "loops: 1 against it, 0 for it"


def test_displacement_counts_turns_and_shifts_by_the_scan_s_size():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((500, 3)) * (3.0, 1.0, 0.2)
    points -= points.mean(axis=0)
    shape = ScanShape(np.zeros(3), points.T @ points / 500)
    motion = random_motion(rng)
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    measured = np.sqrt(np.square(moved - points).sum(axis=1).mean()) / shape.size
    assert shape.displacement(motion) == pytest.approx(measured, rel=1e-9)
    assert shape.displacement(np.eye(4)) == 0.0


def test_a_long_way_round_closes_though_errors_add_up():
    """Thirty scans on a ring, each registered with the next two: no triangle spans the ring."""
    world = World(30, seed=5)
    for i in range(30):
        world.pair(max(i, (i + 1) % 30), min(i, (i + 1) % 30))
        world.pair(max(i, (i + 2) % 30), min(i, (i + 2) % 30))
    model = world.model()
    assert len(model.groups) == 1 and len(model.groups[0].T_world_scan) == 30
    assert {pair.verdict for pair in model.pairs} == {USED}


@pytest.mark.parametrize("seed", range(3))
def test_symmetric_scans_are_wrong_in_few_ways_and_agree_by_accident(seed):
    """Each answer is one of four quarter turns, at random: a quarter of all loops close."""
    world = World(8, seed=seed)
    quarters = [
        np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))
    ]
    for source, target in every(8):
        turned = world.world[source].copy()
        turned[:3] = quarters[world.rng.integers(4)] @ (turned[:3] - np.outer(CENTROID, [0, 0, 0, 1.0]))
        turned[:3, 3] += CENTROID
        answer = invert(world.world[target]) @ turned
        world.pair(source, target, right=False, motion=answer, trusted=False, confidence=0.35)
        world.records[source, target]["report"]["ambiguous_with"] = [np.eye(4).tolist()] * 3
    assert not world.model().groups


def test_a_group_falls_into_parts_where_nothing_holds_it_together():
    """Rough transformations may come with a pair that they contradict: it must not be solved with."""
    world = World(5)
    for pair in ((1, 0), (2, 1), (2, 0), (4, 3)):
        world.pair(*pair)
    world.pair(3, 2, right=False)
    edges = [make_edge(*pair, record["report"], world.shapes)[0] for pair, record in world.records.items()]
    centred = {}
    for scan, motion in enumerate(world.world):
        centred[scan] = motion @ rigid(np.eye(3), world.shapes[scan].centroid)
    parts = settle(centred, edges, world.shapes)
    assert [sorted(part.T_group_scan) for part in parts] == [[0, 1, 2], [3, 4]]
    assert [part.used for part in parts] == [(0, 1, 2), (3,)]
    assert all(np.isfinite(place).all() for part in parts for place in part.T_group_scan.values())


def test_weak_pairs_that_err_alike_join_no_two_things_that_look_alike():
    world = World(10, objects=2)
    for later, earlier in every(10):
        if (later - earlier) % 2 == 0:
            world.pair(later, earlier)
    for later, earlier, confidence in ((1, 0, 0.14), (3, 0, 0.3), (1, 2, 0.3)):
        world.pair(later, earlier, confidence=confidence, trusted=False, overlap=0.4)
    assert [len(group.T_world_scan) for group in world.model().groups] == [5, 5]
    world.pair(3, 2)  # one that is trusted, and agrees
    assert [len(group.T_world_scan) for group in world.model().groups] == [10]
