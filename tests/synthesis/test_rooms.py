from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from utopic_cli.errors import InputError
from utopic_cli.geometry import rigid
from utopic_cli.synthesis.pairs import DegeneratePair, PairSettings, random_pair
from utopic_cli.synthesis.rooms import furnished_room, seen_from_within
from utopic_cli.synthesis.solids import box, joined
from utopic_cli.synthesis.surface import sample_surface

ROOMS = PairSettings(kinds=(0, 0, 0, 0, 1), room_points=(4000, 6000))


def test_a_scanner_in_a_room_sees_what_nothing_stands_before():
    rng = np.random.default_rng(0)
    walls, pillar = box(np.array([3.0, 3.0, 1.5])), box(np.array([0.3, 0.3, 1.5]))
    points = sample_surface(*joined(walls, pillar), 80_000, rng)[0].astype(float)
    seen = points[seen_from_within(points, np.array([-2.0, 0.0, 0.0]))]
    front = np.abs(seen[:, 0] + 0.3) < 1e-3
    behind = (seen[:, 0] > 2.9) & (np.abs(seen[:, 1]) < 0.5)
    assert front.sum() > 300 and behind.sum() == 0
    assert ((seen[:, 0] > 2.9) & (np.abs(seen[:, 1]) > 1.5)).sum() > 300  # beside the pillar
    assert (np.abs(seen[:, 0] - 0.3) < 1e-3).sum() < 60  # the pillar's back but for the rims at the ceiling


def test_the_library_furnishes_the_room_and_nothing_leaves_it(library):
    for number in range(5):
        bare = furnished_room(np.random.default_rng(number))
        room = furnished_room(np.random.default_rng(number), library)
        np.testing.assert_array_equal(bare.halves, room.halves)
        vertices, faces = room.mesh
        assert (np.abs(vertices) <= room.halves + 1e-9).all()
        assert len(faces) > 500 > len(bare.mesh[1]) - 10 * 200  # boxes and cylinders are of few faces
        assert faces.max() == len(vertices) - 1


def test_the_known_answer_brings_both_scans_of_a_room_together(library):
    for number in range(3):
        pair = random_pair(library, np.random.default_rng(number), ROOMS)
        assert pair.kind == "room" and pair.source_viewpoint is None
        assert 4000 <= len(pair.source) <= 6000
        assert pair.smaller_overlap >= ROOMS.minimum_overlap
        moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
        distance = np.sort(cKDTree(pair.target.points).query(moved)[0])
        near = distance[: int(0.7 * pair.overlap_ratio["source"] * len(distance))]
        assert near.max() < 0.03 * pair.extent
        assert np.median(cKDTree(pair.target.points).query(pair.source.points)[0]) > 0.03 * pair.extent


def test_rooms_that_overlap_too_little_are_refused(library):
    with pytest.raises(DegeneratePair, match="room pair in 2 draws"):
        random_pair(library, np.random.default_rng(0), replace(ROOMS, minimum_overlap=1.1, attempts=2))


@pytest.mark.parametrize("kinds", [(), (0.0, 0.0), (1.0, -0.1), (1.0,) * 6])
def test_weights_that_no_kind_can_be_drawn_by_are_refused(kinds):
    with pytest.raises(InputError, match="give weights of range_scan, independent, shared, patch, room"):
        PairSettings(kinds=kinds)


def test_kinds_left_out_are_never_drawn(library):
    settings = PairSettings(kinds=(0, 1), surface_points=(300, 400))
    kinds = {random_pair(library, np.random.default_rng(number), settings).kind for number in range(4)}
    assert kinds == {"independent"}
