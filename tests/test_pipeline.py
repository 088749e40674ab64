"""The whole path with the bundled weights, on simulated scans with a known answer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from utopic_cli import align, pipeline
from utopic_cli.bridge import weigh
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.geometry import rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.pipeline import register
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.demo_object import demo_pair
from utopic_cli.verdict import SAME_POINTS

OPTIONS = AlignOptions(points=400)


@pytest.fixture(scope="module")
def pair():
    return demo_pair(np.random.default_rng(0), points=4000)


@pytest.fixture(scope="module")
def result(pair):
    return register(pair.source, pair.target, OPTIONS)


def rotation_error(found, gt):
    return rigid.relative_rotation_error_deg(found, gt)


def place_error(found, gt, cloud):
    return rigid.relative_translation_error(found, gt, cloud.points.mean(axis=0))


def test_the_known_answer_is_found(pair, result):
    assert rotation_error(result.T_target_source, pair.gt_T_target_source) < 0.5
    assert place_error(result.T_target_source, pair.gt_T_target_source, pair.source) < 0.005 * pair.extent
    assert rigid.is_rigid(result.T_target_source, 1e-9)


def test_every_original_point_gets_an_overlap_and_an_uncertainty(pair, result):
    for values, cloud in (
        (result.source_overlap, pair.source),
        (result.source_uncertainty, pair.source),
        (result.target_overlap, pair.target),
        (result.target_uncertainty, pair.target),
    ):
        assert values.shape == (len(cloud),) and values.dtype == np.float32
        assert values.min() >= 0 and values.max() <= 1 and np.ptp(values) > 0.1


def test_what_is_seen_is_weighed_with_the_confidence(pair, result, monkeypatch):
    """With the confidence where there is one, else with what the solve makes of it."""
    weighed = []

    def noted(model, first, shown, odds):
        assert first.source_gap is None and shown.source_gap is not None
        weighed.append(odds)
        return weigh(model, first, shown, odds)

    monkeypatch.setattr(pipeline, "weigh", noted)
    again = register(pair.source, pair.target, OPTIONS)
    assert np.array_equal(again.source_overlap, result.source_overlap)
    confidence = min(max(result.confidence, 0.001), 0.999)
    assert weighed == [pytest.approx(np.log(confidence / (1.0 - confidence)))]

    doubted = []
    monkeypatch.setattr(pipeline, "read_calibration", lambda card: None)
    monkeypatch.setattr(pipeline, "weigh", lambda *given: doubted.append(given) or weigh(*given))
    uncalibrated = register(pair.source, pair.target, OPTIONS)
    assert uncalibrated.confidence is None
    assert [odds for *_, odds in doubted] == [uncalibrated.signals["plausibility"]]


def known_overlap(pair):
    """Source points that have the target's surface within 2 % of the extent, by the known answer."""
    moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
    return cKDTree(pair.target.points).query(moved)[0] < 0.02 * pair.extent


def chance_of_more(here, there):
    """Area under the ROC curve: how often a value from ``here`` exceeds one from ``there``."""
    return (here[:, None] > there[None, ::5]).mean()


def test_overlap_is_high_where_the_scans_share_surface(pair, result):
    known = known_overlap(pair)
    assert chance_of_more(result.source_overlap[known], result.source_overlap[~known]) > 0.9
    assert ((result.source_overlap > 0.5) == known).mean() > 0.75


def test_uncertainty_is_higher_along_the_border_than_inside_the_overlap(pair, result):
    known, points = known_overlap(pair), pair.source.points
    to_the_other_side = np.where(
        known, cKDTree(points[~known]).query(points)[0], cKDTree(points[known]).query(points)[0]
    )
    border = to_the_other_side < 0.03 * pair.extent
    inside = known & ~border
    assert chance_of_more(result.source_uncertainty[border], result.source_uncertainty[inside]) > 0.75


def test_correspondences_are_pairs_of_original_points_that_the_answer_explains(pair, result):
    pairs = result.correspondences
    assert len(pairs) >= 3 and (pairs.weights >= 0).all()
    moved = rigid.apply(result.T_target_source, pair.source.points[pairs.source_indices])
    distance = np.linalg.norm(moved - pair.target.points[pairs.target_indices], axis=1)
    assert np.median(distance) < 0.05 * pair.extent


def test_the_same_seed_gives_the_same_bits(pair, result):
    again = register(pair.source, pair.target, OPTIONS)
    assert np.array_equal(again.T_target_source, result.T_target_source)
    for name in ("source_overlap", "target_overlap", "source_uncertainty", "target_uncertainty"):
        assert np.array_equal(getattr(again, name), getattr(result, name)), name
    # The network draws nothing whose outcome matters.
    other = register(pair.source, pair.target, dataclasses.replace(OPTIONS, seed=1))
    assert np.array_equal(other.source_uncertainty, result.source_uncertainty)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_another_unit_scales_the_translation_alone(pair, result, scale):
    found = register(
        PointCloud(pair.source.points * scale), PointCloud(pair.target.points * scale), OPTIONS
    ).T_target_source
    np.testing.assert_allclose(found[:3, :3], result.T_target_source[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found[:3, 3], scale * result.T_target_source[:3, 3], rtol=1e-5)


def test_coordinates_the_size_of_a_country_lose_nothing(pair, result):
    shift = np.array([4e5, 5e6, 300.0])
    moved = PointCloud(pair.source.points + shift), PointCloud(pair.target.points + shift)
    found = register(*moved, OPTIONS).T_target_source
    # Found on shifted scans, T maps p + s to T0 p + s.
    expected = result.T_target_source.copy()
    expected[:3, 3] += shift - expected[:3, :3] @ shift
    assert rotation_error(found, expected) < 1e-4
    assert place_error(found, expected, moved[0]) < 1e-6 * pair.extent


def test_a_moved_input_composes(pair, result):
    rng = np.random.default_rng(3)
    motion = rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
    found = register(pair.source.transformed(motion), pair.target, OPTIONS).T_target_source
    expected = result.T_target_source @ rigid.invert(motion)
    assert rotation_error(found, expected) < 0.3
    assert place_error(found @ motion, result.T_target_source, pair.source) < 0.003 * pair.extent


def test_swapping_the_scans_inverts_the_transformation(pair, result):
    found = register(pair.target, pair.source, OPTIONS).T_target_source
    expected = rigid.invert(result.T_target_source)
    assert rotation_error(found, expected) < 0.3
    assert place_error(found, expected, pair.target) < 0.003 * pair.extent


def test_the_order_of_points_and_repeated_points_hardly_matter(pair, result):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(pair.source))
    shuffled = np.concatenate([pair.source.points[order], pair.source.points[:100]])
    found = register(PointCloud(shuffled), pair.target, OPTIONS)
    assert rotation_error(found.T_target_source, result.T_target_source) < 0.2
    overlap = found.source_overlap[: len(order)]
    assert np.abs(overlap - result.source_overlap[order]).mean() < 0.05


def test_a_right_initial_transformation_is_used(pair):
    sparse = PointCloud(pair.source.points[::8]), PointCloud(pair.target.points[::8])
    found = register(*sparse, OPTIONS, initial=pair.gt_T_target_source)
    assert rotation_error(found.T_target_source, pair.gt_T_target_source) < 5


def test_the_overlap_of_an_asymmetric_object_fixes_every_motion(pair, result):
    seen = result.observability
    assert seen is not None and not seen.free
    spread = np.sqrt(np.diag(seen.covariance))
    extent = np.linalg.norm(np.ptp(pair.source.points, axis=0))
    assert (spread[:3] < np.radians(0.5)).all() and (spread[3:] < 0.005 * extent).all()
    # The covariance scales with the unit, and its middle lies in the target's overlap.
    assert np.linalg.norm(seen.centre - pair.target.points.mean(axis=0)) < extent


def test_a_motion_that_the_surfaces_leave_free_is_named():
    rng = np.random.default_rng(0)
    tubes = []
    for low, high in ((-1.0, 0.6), (-0.6, 1.0)):
        angle, height = rng.uniform(-1.4, 1.4, 9000), rng.uniform(low, high, 9000)
        tubes.append(1000.0 * np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height], axis=1))
    found = align(*tubes, seed=0)
    assert found.observability is not None
    assert {motion.kind for motion in found.observability.free} == {"rotation", "translation"}
    for motion in found.observability.free:
        assert abs(motion.axis[2]) > 0.99
        if motion.point is not None:
            assert np.linalg.norm(motion.point[:2]) < 50.0
    assert not found.trusted
    assert any("not determined" in text and "sliding along" in text for text in found.reasons)


def test_the_papers_solver_returns_a_rigid_motion(pair):
    found = register(pair.source, pair.target, dataclasses.replace(OPTIONS, solver="svd", refine=False))
    assert rigid.is_rigid(found.T_target_source, 1e-9)
    assert found.options["solver"] == "svd"
    assert found.confidence is None and not found.trusted and "default solver" in found.reasons[0]


@pytest.mark.parametrize("stray", [[0.0, 0.0, 0.0], [4e5, 5e6, 9e3]])
def test_one_point_astray_changes_nothing_to_speak_of(pair, result, stray):
    shift = np.array([4e5, 5e6, 300.0])  # so that (0, 0, 0), a scanner's "no return", is far away
    clouds = [PointCloud(cloud.points + shift) for cloud in (pair.source, pair.target)]
    dirty = PointCloud(np.concatenate([clouds[0].points, [np.array(stray) - shift * (stray[2] > 1000)]]))
    found = register(dirty, clouds[1], OPTIONS)
    expected = result.T_target_source.copy()
    expected[:3, 3] += shift - expected[:3, :3] @ shift
    assert rotation_error(found.T_target_source, expected) < 0.2
    assert found.trusted and not any("sizes" in reason for reason in found.reasons)
    assert len(found.source_overlap) == len(dirty)


def test_places_that_are_there_fifty_times_are_taken_once(pair):
    rng = np.random.default_rng(0)
    places = rng.standard_normal((60, 3))
    merged = PointCloud(np.repeat(places, 50, axis=0))
    found = register(merged, merged, OPTIONS)
    assert any(SAME_POINTS in reason for reason in found.reasons)
    assert rigid.is_rigid(found.T_target_source, 1e-9)


def test_a_second_sampling_nothing_follows_from_leaves_the_first_answer(pair, result, monkeypatch):
    def nothing_follows(*_):
        raise InputError("no transformation can be found")

    monkeypatch.setattr("utopic_cli.look.UNCLEAR_MARGIN", (-1.0, 2.0))
    monkeypatch.setattr("utopic_cli.pipeline.look", nothing_follows)
    found = register(pair.source, pair.target, OPTIONS)
    np.testing.assert_array_equal(found.T_target_source, result.T_target_source)
    assert found.signals["spread"] == 0.0


def test_arrays_and_files_give_the_same_answer(pair, tmp_path):
    paths = []
    for name, cloud in (("a", pair.source), ("b", pair.target)):
        grey = np.zeros((len(cloud), 3), np.uint8)
        paths.append(tmp_path / f"{name}.ply")
        paths[-1].write_bytes(scalar_cloud_ply(cloud.points, grey, {}, ()))
    from_files = align(*paths, points=300)
    from_arrays = align(pair.source.points, pair.target.points, points=300)
    assert np.array_equal(from_files.T_target_source, from_arrays.T_target_source)


def test_scans_of_very_different_size_are_named(pair):
    found = register(PointCloud(pair.source.points * 9), pair.target, OPTIONS)
    assert not found.trusted and "factor of about" in found.reasons[0]
    with pytest.raises(InputError, match=r"sizes differ by a factor of about 1.*same unit"):
        register(PointCloud(pair.source.points * 1000), pair.target, OPTIONS)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((100, 2)), r"source: an array of shape \(100, 2\); expected \(N, 3\)"),
        (np.zeros((100, 3)), "source: all of its 100 points are equal; check what"),
        (np.full((100, 3), np.nan), r"source: none of its 100 points is finite; check what"),
        (np.full((100, 3), 1e200), r"source: has coordinates beyond 1e100.*; check what"),
        (np.outer(np.arange(100.0), [1, 2, 3]), "source: all of its points lie on a line"),
        (None, r"source: is None; give a path or an \(N, 3\) array"),
        (np.ones((100, 3)).astype(str), "source: holds text, not numbers; give a path"),
        ([["a", "b", "c"]] * 60, "source: holds text, not numbers"),
        (np.ones((100, 3), complex), "source: holds complex numbers; give"),
        (PointCloud(np.ones((100, 3))), r"source: is a PointCloud, .*pass numpy\.asarray\(cloud\.points\)"),
        ({}, "source: is neither a path nor real numbers, but of type dict"),
    ],
    ids=[
        "two columns",
        "all equal",
        "all NaN",
        "huge",
        "a line",
        "nothing",
        "words",
        "a list of words",
        "complex",
        "a cloud",
        "a dict",
    ],
)
def test_arrays_that_cannot_be_used_are_explained(pair, points, message):
    with pytest.raises(InputError, match=message):
        align(points, pair.target.points)


def test_what_turns_the_source_farther_than_allowed_is_no_answer(pair, result):
    angle = rigid.rotation_angle_deg(pair.gt_T_target_source[:3, :3])
    enough = dataclasses.replace(OPTIONS, max_rotation=angle + 5.0)
    found = register(pair.source, pair.target, enough)
    np.testing.assert_allclose(found.T_target_source, result.T_target_source, atol=1e-3 * pair.extent)
    assert found.options["max_rotation"] == angle + 5.0
    other = register(pair.source, pair.target, dataclasses.replace(OPTIONS, max_rotation=angle - 15.0))
    # The refinement at full resolution may go a little beyond.
    assert rigid.rotation_angle_deg(other.T_target_source[:3, :3]) < angle - 10.0
    assert not other.trusted
    with pytest.raises(InputError, match=r"turns the source by 0\.5 degrees at most.*; allow more"):
        register(pair.source, pair.target, dataclasses.replace(OPTIONS, max_rotation=0.5))


def test_the_bound_counts_from_the_initial_transformation(pair):
    near = dataclasses.replace(OPTIONS, max_rotation=10.0)
    found = register(pair.source, pair.target, near, initial=pair.gt_T_target_source)
    assert rotation_error(found.T_target_source, pair.gt_T_target_source) < 0.5


def test_unknown_options_are_explained(pair):
    with pytest.raises(UsageError, match=r"unknown option voxel; known options: weights, points.*initial"):
        align(pair.source.points, pair.target.points, voxel=3)
    with pytest.raises(UsageError, match="no such solver; choose auto"):
        align(pair.source.points, pair.target.points, solver="magic")
    with pytest.raises(UsageError, match="refine is 'no'; give True or False"):
        align(pair.source.points, pair.target.points, refine="no")
    with pytest.raises(UsageError, match="points is True; give a whole number"):
        align(pair.source.points, pair.target.points, points=True)
    for degrees in (0, 181.0, np.nan, True, "45"):
        with pytest.raises(UsageError, match=r"max_rotation is .*; give degrees above 0, 180 at most"):
            align(pair.source.points, pair.target.points, max_rotation=degrees)
    with pytest.raises(InputError, match="initial transformation is a str; give a"):
        align(pair.source.points, pair.target.points, initial="T.txt")
    with pytest.raises(InputError, match="no bundled weights of that name"):
        align(pair.source.points, pair.target.points, weights="absent")


def test_values_and_indices_are_those_of_the_array_that_was_given(pair):
    """Rows that are not finite keep their place, so that a caller's other columns still fit."""
    holes = np.insert(pair.source.points, [0, 5, 5], np.nan, axis=0)
    options = {"points": np.int64(300), "seed": np.int32(0), "threads": 1}
    whole = align(pair.source.points, pair.target.points, **options)
    found = align(holes, pair.target.points.tolist(), initial=np.eye(4).tolist(), **options)
    finite = np.isfinite(holes).all(axis=1)
    assert found.source_overlap.shape == found.source_uncertainty.shape == (len(holes),)
    assert np.array_equal(np.isfinite(found.source_overlap), finite)
    assert found.warnings == (f"source: 3 of {len(holes)} points are NaN or infinite and were left out",)
    assert whole.warnings == () and len(whole.source_overlap) == len(pair.source)
    pairs = found.correspondences
    assert finite[pairs.source_indices].all() and pairs.target_indices.max() < len(pair.target)
    moved = holes[pairs.source_indices] @ found.T_target_source[:3, :3].T + found.T_target_source[:3, 3]
    size = np.linalg.norm(np.ptp(pair.target.points, axis=0))
    apart = np.linalg.norm(moved - pair.target.points[pairs.target_indices], axis=1)
    assert np.median(apart) < 0.1 * size


def test_the_library_shows_its_names():
    import utopic_cli

    assert dir(utopic_cli) == sorted(utopic_cli.__all__)
    assert all(getattr(utopic_cli, name) is not None for name in utopic_cli.__all__)
    assert issubclass(utopic_cli.InputError, utopic_cli.UtopicError)
