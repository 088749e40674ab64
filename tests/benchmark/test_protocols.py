from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from utopic_cli.benchmark.protocols import (
    DETAIL_POINTS,
    DETAIL_RELIEF,
    SCAN_BANDS,
    SCAN_REACH,
    CropProtocol,
    RangeProtocol,
    RoomProtocol,
)
from utopic_cli.errors import UsageError
from utopic_cli.geometry.rigid import apply
from utopic_cli.model.pose_verifier import MEETING_REACH
from utopic_cli.synthesis.pairs import evaluation_pairs
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.shapes import ShapeLibrary, pack
from utopic_cli.training.labels import POSITIVE_REACH


@pytest.fixture(scope="module")
def shapes() -> ShapeLibrary:
    rng = np.random.default_rng(3)
    return pack([procedural_mesh(rng, 32) for _ in range(3)], list("abc"), ["val"] * 3, ["one"] * 3)


SHARED = CropProtocol("modelnet", 0.7, "shared", "euler45")


@pytest.mark.parametrize(("keep", "count"), [(0.7, 717), (0.5, 512)])
def test_the_papers_crops(shapes: ShapeLibrary, keep: float, count: int) -> None:
    protocol = CropProtocol("modelnet", keep, "shared", "euler45")
    for number in range(6):
        pair = protocol.pair(shapes, 0, number)
        assert len(pair.source) == len(pair.target) == count
        angles = Rotation.from_matrix(pair.gt_T_target_source[:3, :3]).as_euler("xyz", degrees=True)
        assert (angles >= -1e-9).all() and (angles <= 45.0 + 1e-9).all()
        assert np.abs(pair.gt_T_target_source[:3, 3]).max() <= 0.5
        assert pair.shared is not None and pair.object_points is not None
        i, j = pair.shared.T
        # Two crops of one sample share at least 2 keep - 1 of it, and no point twice.
        assert len(i) >= (2 * keep - 1) * 1024 - 1
        assert len(set(i)) == len(set(j)) == len(i)
        apart = apply(pair.gt_T_target_source, pair.source.points[i]) - pair.target.points[j]
        assert np.abs(apart).max() <= 2 * 0.05 * np.sqrt(3)  # both are jittered, cut off at 0.05
        assert np.abs(apart).std() < 0.02  # no chance partner is that near
        whole = apply(pair.gt_T_target_source, pair.object_points)
        assert np.linalg.norm(whole, axis=1).max() == pytest.approx(1.0, abs=0.01)


def test_shapes_take_turns_and_pairs_depend_on_seed_and_number_alone(shapes: ShapeLibrary) -> None:
    names = [SHARED.pair(shapes, 5, number).shape for number in range(6)]
    assert sorted(names[:3]) == ["a", "b", "c"] and names[:3] == names[3:]
    first, again, other = (SHARED.pair(shapes, seed, 4) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.source.points, again.source.points)
    assert not np.array_equal(first.gt_T_target_source, other.gt_T_target_source)


def test_independent_samples_have_no_floor_and_any_rotation(shapes: ShapeLibrary) -> None:
    protocol = CropProtocol("modelnet", 0.7, "independent", "uniform")
    pairs = [protocol.pair(shapes, 0, number) for number in range(8)]
    assert all(pair.shared is None for pair in pairs)
    traces = [np.trace(pair.gt_T_target_source[:3, :3]) for pair in pairs]
    assert min(traces) < 1.0  # some turn by more than 90 degrees
    assert protocol.centre(pairs[0]) is not None and SHARED.centre(pairs[0]) is None


def test_unknown_words_are_refused() -> None:
    with pytest.raises(UsageError, match="shared or independent"):
        CropProtocol("modelnet", 0.7, "both", "uniform")
    with pytest.raises(UsageError, match="uniform or euler45"):
        CropProtocol("modelnet", 0.7, "shared", "little")


def test_range_scans_lie_in_their_bands_in_equal_numbers(shapes: ShapeLibrary) -> None:
    protocol = RangeProtocol()
    groups = [protocol.group(number) for number in range(6)]
    assert groups == ["0.5-0.9", "0.3-0.5", "0.1-0.3"] * 2
    expected = evaluation_pairs(shapes, 2, 3, SCAN_BANDS)
    for number, same in enumerate(expected):
        pair = protocol.pair(shapes, 2, number)
        low, high = SCAN_BANDS[number]
        assert low <= pair.smaller_overlap < high
        np.testing.assert_array_equal(pair.source.points, same.source.points)
        assert pair.object_points is not None and len(pair.object_points) >= 20_000
        assert protocol.unit(pair) == pair.extent


def test_rooms_overlap_enough_and_bring_the_whole_room(shapes: ShapeLibrary) -> None:
    protocol = RoomProtocol(least_overlap=0.5)
    for number in range(3):
        pair = protocol.pair(shapes, 2, number)
        assert pair.kind == "room" and pair.smaller_overlap >= 0.5
        assert pair.object_points is not None and len(pair.object_points) >= 20_000
        found = cKDTree(pair.object_points).query(pair.source.points)[0]
        assert np.quantile(found, 0.9) < 0.02 * pair.extent
        assert protocol.unit(pair) == pair.extent and protocol.group(number) == "rooms"
    with pytest.raises(DegeneratePair, match="no usable room in 30 draws"):
        RoomProtocol(pairs=PairSettings(room_points=(300_000, 400_000))).pair(shapes, 0, 0)


def test_overlap_means_the_same_as_in_training() -> None:
    assert SCAN_REACH == POSITIVE_REACH == MEETING_REACH


@pytest.mark.parametrize("sampling", ["shared", "independent"])
def test_detail_takes_five_thousand_points_and_bends_them(shapes: ShapeLibrary, sampling: str) -> None:
    plain = CropProtocol("detail", 0.7, sampling, "euler45", points=DETAIL_POINTS)
    bent = replace(plain, relief=DETAIL_RELIEF)
    for protocol in (plain, bent):
        pair = protocol.pair(shapes, 0, 1)
        assert len(pair.source) == len(pair.target) == 3500
        assert (pair.shared is not None) == (sampling == "shared")
        assert pair.object_points is not None
        whole = apply(pair.gt_T_target_source, pair.object_points)
        assert np.linalg.norm(whole, axis=1).max() == pytest.approx(1.0, abs=0.01)
        # The clouds are noisy samples of that very surface.
        distance = cKDTree(whole).query(pair.target.points)[0]
        assert np.quantile(distance, 0.99) < 0.05
    assert plain.settings()["relief"] == 0 and bent.settings()["relief"] == DETAIL_RELIEF
    # Bending is all the difference: another surface, several per cent of the radius away.
    surfaces = [
        apply(pair.gt_T_target_source, pair.object_points)
        for pair in (plain.pair(shapes, 0, 1), bent.pair(shapes, 0, 1))
        if pair.object_points is not None
    ]
    assert np.median(cKDTree(surfaces[0]).query(surfaces[1])[0]) > 0.01


def test_points_of_a_data_set_are_used_as_they_are(shapes: ShapeLibrary) -> None:
    rng = np.random.default_rng(0)
    given = rng.uniform(-0.5, 0.5, (3, 2048, 3)).astype(np.float16)
    library = replace(shapes, samples=given)
    protocol = CropProtocol("scanobjectnn", 0.7, "shared", "euler45")
    pair = protocol.pair(library, 0, 0)
    number = "abc".index(str(pair.shape))
    assert len(pair.source) == len(pair.target) == 717
    # The target stays in the object's frame under the paper's rotations: off by the jitter alone.
    offset = np.abs(pair.target.points[:, None] - given[number][None].astype(float)).max(axis=2).min(axis=1)
    assert offset.max() <= 0.05 + 1e-9
    with pytest.raises(DegeneratePair, match=r"2048 points .* 10000 are needed"):
        replace(protocol, points=DETAIL_POINTS).pair(library, 0, 0)
