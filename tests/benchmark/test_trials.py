from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from utopic_cli.benchmark import trials
from utopic_cli.benchmark.labelled import Trial
from utopic_cli.benchmark.solids import SYMMETRIC
from utopic_cli.benchmark.trial_scans import CLEARLY_APART, mirror_distance, turned_distance
from utopic_cli.benchmark.trials import KINDS, bench_half, calibration_half, trial
from utopic_cli.errors import InputError, UsageError
from utopic_cli.geometry.rigid import apply, is_rigid, rigid, rotation_from_vector
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.shapes import ShapeLibrary, pack
from utopic_cli.synthesis.solids import box, extruded, joined, revolved
from utopic_cli.synthesis.surface import bounding_diagonal, face_areas, sample_surface

WITHOUT_ANSWER = ("disjoint", "different", "mirrored")
WITH_ANSWER = tuple(kind for kind in KINDS if kind not in WITHOUT_ANSWER)


@pytest.fixture(scope="module")
def shapes() -> ShapeLibrary:
    rng = np.random.default_rng(11)
    meshes = [procedural_mesh(rng, 36) for _ in range(4)]
    return pack(meshes, list("abcd"), ["val"] * 4, ["one", "one", "two", "two"])


@pytest.fixture(scope="module")
def made(shapes: ShapeLibrary) -> dict[str, list[Trial]]:
    return {kind: [trial(shapes, 3, number, (kind,)) for number in range(2)] for kind in KINDS}


def reach(trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Distances of both clouds' points to the other, laid on it by the known answer."""
    assert trial.gt_T_target_source is not None
    there = apply(trial.gt_T_target_source, trial.source.points)
    return (
        cKDTree(trial.target.points).query(there)[0],
        cKDTree(there).query(trial.target.points)[0],
    )


@pytest.mark.parametrize("kind", WITH_ANSWER)
def test_the_known_answer_lays_the_overlap_of_the_source_on_the_target(made, kind):
    for one in made[kind]:
        assert one.kind == kind and one.shape
        assert is_rigid(one.gt_T_target_source, 1e-9)
        near = [float((distance < 0.03 * one.extent).mean()) for distance in reach(one)]
        # Noise and outliers make overlap as measured smaller, not larger.
        assert min(near) > 0.7 * one.overlap - 0.02
        median = float(np.median(np.sort(reach(one)[0])[: max(20, len(one.source) // 50)]))
        assert median < 0.01 * one.extent
        assert one.right(one.gt_T_target_source)


@pytest.mark.parametrize("kind", WITHOUT_ANSWER)
def test_nothing_is_right_where_there_is_no_answer(made, kind):
    for one in made[kind]:
        assert one.gt_T_target_source is None and one.overlap == 0.0
        assert not one.right(np.eye(4))


def test_scans_are_clouds_of_a_sensible_size_in_poses_of_their_own(made):
    for kind, several in made.items():
        for one in several:
            sizes = [len(cloud) for cloud in (one.source, one.target)]
            assert (300 if kind == "sparse" else 500) <= min(sizes) and max(sizes) <= 40_000
            assert one.source.points.dtype == one.target.points.dtype == np.float64
            boxes = [np.linalg.norm(np.ptp(cloud.points, axis=0)) for cloud in (one.source, one.target)]
            assert one.extent == pytest.approx(max(boxes))
    angles = [
        np.degrees(np.arccos((np.trace(one.gt_T_target_source[:3, :3]) - 1.0) / 2.0))
        for kind in WITH_ANSWER
        for one in made[kind]
    ]
    assert np.median(angles) > 90.0 and max(angles) > 150.0  # uniform over SO(3): a median of 130


def test_right_means_five_degrees_and_five_percent_at_the_centroid(made):
    one = made["scans"][0]
    centre = one.source.points.mean(axis=0)

    def moved(degrees: float, share: float) -> np.ndarray:
        turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(degrees)]))
        shift = centre - turn @ centre + np.array([share * one.extent, 0.0, 0.0])
        return one.gt_T_target_source @ rigid(turn, shift)

    assert one.right(moved(4.9, 0.0)) and one.right(moved(0.0, 0.049)) and one.right(moved(4.9, 0.049))
    assert not one.right(moved(5.1, 0.0)) and not one.right(moved(0.0, 0.051))


def test_overlaps_are_as_the_kinds_promise(made):
    assert all(0.02 <= one.overlap < 0.1 for one in made["little"])
    assert all(0.1 <= one.overlap < 0.9 for one in made["scans"])
    assert all(one.overlap >= 0.15 for kind in ("symmetric", "near-symmetric", "room") for one in made[kind])


def test_disjoint_scans_share_no_surface(shapes, monkeypatch):
    """The trial hides its motion, so it is taken from the pair that the trial was cut from."""
    seen = []
    for name in ("range_scan_pair", "patch_pair"):
        original = getattr(trials.trial_scans, name)

        def kept(*arguments, original=original, **options):
            seen.append(original(*arguments, **options))
            return seen[-1]

        monkeypatch.setattr(trials.trial_scans, name, kept)
    for number in range(3):
        one = trial(shapes, 8, number, ("disjoint",))
        pair = seen[-1]
        np.testing.assert_array_equal(one.source.points, pair.source.points)
        there = apply(pair.gt_T_target_source, one.source.points)
        apart = cKDTree(there).query(one.target.points)[0]
        assert apart.min() > 0.02 * pair.extent
        assert cKDTree(pair.target.points).query(one.target.points)[0].max() == 0.0  # still the same scan


def test_symmetric_shapes_are_a_kind_of_their_own(shapes):
    rng = np.random.default_rng(5)
    lumpy, prism = shapes.mesh(0), SYMMETRIC["hexagonal prism"][0](rng)
    mixed = pack([lumpy, prism], ["lumpy", "prism"], ["val"] * 2, ["one"] * 2)
    settings = replace(trials.trial_scans.SETTINGS, warp_probability=0.0, stretch_probability=0.0)
    for kind, expected in (("sparse", "lumpy"), ("symmetric-shape", "prism")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(trials.trial_scans, "SETTINGS", settings)
            assert [trial(mixed, 4, number, (kind,)).shape for number in range(4)] == [expected] * 4, kind


def test_different_objects_come_from_different_collections(made, shapes):
    for one in made["different"]:
        first, second = one.shape.split(" | ")
        kind = dict(zip(shapes.names.tolist(), shapes.sets.tolist()))
        assert kind[first] != kind[second]
        sizes = [bounding_diagonal(cloud.points) for cloud in (one.source, one.target)]
        assert 0.4 < sizes[0] / sizes[1] < 2.5
    alone = replace(shapes, sets=np.array(["one"] * 4))
    first, second = trial(alone, 0, 0, ("different",)).shape.split(" | ")
    assert first != second


def test_one_shape_is_no_two_different_ones(shapes, monkeypatch):
    monkeypatch.setattr(trials, "ATTEMPTS", 2)
    single = pack([shapes.mesh(0)], ["a"], ["val"], ["one"])
    with pytest.raises(DegeneratePair, match="no different trial"):
        trial(single, 0, 0, ("different",))


@pytest.mark.parametrize("name", list(SYMMETRIC))
def test_symmetric_solids_equal_their_mirror_image(name):
    rng = np.random.default_rng(5)
    mesh = SYMMETRIC[name][0](rng)
    assert mirror_distance(sample_surface(*mesh, 12_000, rng)[0], rng) < 0.3 * CLEARLY_APART


@pytest.mark.parametrize("name", ["cylinder", "torus", "cube", "box", "hexagonal prism", "gear"])
def test_symmetric_solids_equal_themselves_turned(name):
    rng = np.random.default_rng(5)
    mesh = SYMMETRIC[name][0](rng)
    assert turned_distance(sample_surface(*mesh, 12_000, rng)[0], rng) < 0.3 * CLEARLY_APART


def test_a_mirror_plane_is_no_turn():
    rng = np.random.default_rng(6)
    body = box(np.array([0.6, 0.4, 0.2]))
    tower = box(np.array([0.15, 0.4, 0.3]))[0] + np.array([0.4, 0.0, 0.4])
    chair = sample_surface(*joined(body, (tower, body[1])), 12_000, rng)[0]
    assert mirror_distance(chair, rng) < 0.3 * CLEARLY_APART < CLEARLY_APART < turned_distance(chair, rng)


def test_disjoint_scans_are_of_shapes_that_no_turn_maps_onto_themselves(shapes, monkeypatch):
    monkeypatch.setattr(trials.trial_scans, "turned_distance", lambda points, rng: 0.0)
    monkeypatch.setattr(trials, "ATTEMPTS", 2)
    with pytest.raises(DegeneratePair, match="when turned"):
        trial(shapes, 8, 0, ("disjoint",))


def test_a_shape_with_a_hand_differs_from_its_mirror_image():
    rng = np.random.default_rng(6)
    body = box(np.array([0.6, 0.4, 0.2]))
    knobs = [
        (box(np.full(3, size))[0] + np.array(place), box(np.ones(3))[1])
        for size, place in ((0.2, (0.5, 0.3, 0.3)), (0.15, (-0.4, 0.35, 0.0)), (0.1, (0.1, -0.3, 0.25)))
    ]
    chiral = sample_surface(*joined(body, *knobs), 12_000, rng)[0]
    assert mirror_distance(chiral, rng) > CLEARLY_APART
    # One with a mirror plane that no principal axis names: two boxes side by side, at 45 degrees.
    both = joined(body, (body[0][:, [1, 0, 2]] + np.array([0.0, 0.0, 0.4]), body[1][:, ::-1]))
    assert mirror_distance(sample_surface(*both, 12_000, rng)[0], rng) < 0.3 * CLEARLY_APART


def test_mirrored_scans_are_of_shapes_that_differ_from_their_mirror_image(shapes, monkeypatch):
    measured = []
    original = trials.trial_scans.mirror_distance
    monkeypatch.setattr(
        trials.trial_scans,
        "mirror_distance",
        lambda points, rng: measured.append(original(points, rng)) or measured[-1],
    )
    for number in range(2):
        trial(shapes, 2, number, ("mirrored",))
        assert measured[-1] >= CLEARLY_APART
    # A shape that equals its mirror image, however it is warped, is no wrong pair.
    monkeypatch.setattr(trials.trial_scans, "mirror_distance", lambda points, rng: 0.0)
    monkeypatch.setattr(trials, "ATTEMPTS", 2)
    with pytest.raises(DegeneratePair, match="mirror"):
        trial(shapes, 2, 0, ("mirrored",))


def test_solids_are_closed_and_wound_outwards():
    cube = box(np.ones(3))
    tube = revolved(np.array([[0.0, -1.0], [0.5, -1.0], [0.5, 1.0], [0.0, 1.0]]))
    square = extruded(np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]), 0.5)
    for (vertices, faces), volume in ((cube, 8.0), (tube, np.pi * 0.5), (square, 2.0)):
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(volume, rel=1e-3)
    assert face_areas(*square).sum() == pytest.approx(2 * 2.0 + 4 * np.sqrt(2.0))


def test_a_trial_depends_on_its_arguments_alone(shapes):
    first, again = (trial(shapes, 5, 7) for _ in range(2))
    np.testing.assert_array_equal(first.source.points, again.source.points)
    assert first.kind == again.kind
    other = trial(shapes, 6, 7)
    assert other.kind == first.kind and not np.array_equal(other.source.points, first.source.points)


def test_halves_never_share_a_trial_even_of_no_shape(shapes):
    halves = [pack([shapes.mesh(i)], [name], ["val"], ["one"]) for i, name in enumerate("ab")]
    first, second = (trial(half, 0, 0, ("symmetric",)) for half in halves)
    assert first.source.points.shape != second.source.points.shape or not np.array_equal(
        first.source.points, second.source.points
    )


def test_kinds_come_in_their_shares(monkeypatch, shapes):
    monkeypatch.setattr(trials, "MAKERS", {k: (s, lambda *_, k=k: k) for k, (s, _) in trials.MAKERS.items()})
    assert sum(share for share, _ in trials.MAKERS.values()) == pytest.approx(1.0)
    counts = Counter(trial(shapes, 0, number) for number in range(200))
    for kind, (share, _) in trials.MAKERS.items():
        assert abs(counts[kind] - 200 * share) <= 3
    assert {trial(shapes, 0, number, ("room", "sparse")) for number in range(9)} == {"room", "sparse"}


@pytest.mark.parametrize("kinds", [("magic",), ()])
def test_unknown_kinds_are_refused(shapes, kinds):
    with pytest.raises(UsageError, match="no such kind"):
        trial(shapes, 0, 0, kinds)


def test_the_halves_part_the_held_out_shapes():
    triangle = (np.eye(3), np.array([[0, 1, 2]]))
    names = [f"shape {i}" for i in range(40)]
    library = pack([triangle] * 40, names, ["val" if i % 2 else "train" for i in range(40)], ["s"] * 40)
    first, second = (set(half(library).names.tolist()) for half in (calibration_half, bench_half))
    assert first | second == set(names[1::2]) and not first & second and len(first) > 3 < len(second)
    fewer = pack([triangle] * 10, names[1:20:2], ["val"] * 10, ["s"] * 10)
    assert set(calibration_half(fewer).names.tolist()) == first & set(fewer.names.tolist())
    lonely = pack([triangle], ["a"], ["val"], ["s"])
    with pytest.raises(InputError, match="can't be halved"):
        for half in (calibration_half, bench_half):
            half(lonely)
