from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.synthesis.conftest import ball, cuboid, joined
from utopic_cli.geometry import rigid
from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.synthesis.pairs import (
    DegeneratePair,
    PairSettings,
    evaluation_pair,
    evaluation_pairs,
    patch_pair,
    random_pair,
    range_scan_pair,
    surface_pair,
)
from utopic_cli.synthesis.range_pairs import maps_onto_itself
from utopic_cli.synthesis.scan_pair import check_cloud
from utopic_cli.synthesis.shapes import pack
from utopic_cli.synthesis.surface import sample_surface

CLEAN = PairSettings(
    noise=(0.0, 0.0),
    hole_probability=0.0,
    outlier_probability=0.0,
    several_views_probability=0.0,
    points=(6000, 9000),
)


def clean_pair(library, number, settings=CLEAN):
    rng = np.random.default_rng(number)
    return random_pair(library, rng, replace(settings, kinds=(1, 0, 0, 0)))


def test_the_known_answer_brings_range_scans_together(library):
    for number in range(4):
        pair = clean_pair(library, number)
        assert rigid.is_rigid(pair.gt_T_target_source, 1e-9)
        moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
        distance = cKDTree(pair.target.points).query(moved)[0]
        near = np.sort(distance)[: int(0.7 * pair.overlap_ratio["source"] * len(distance))]
        assert near.max() < 0.01 * pair.extent
        # A wrong answer is told apart: the untouched source lies elsewhere.
        assert np.median(cKDTree(pair.target.points).query(pair.source.points)[0]) > 0.02 * pair.extent


def test_the_answers_overlap_lies_on_the_targets_surface_within_the_noise(library):
    """Distance to the local plane of the target, not to its points, is within the noise."""
    settings = replace(CLEAN, noise=(0.001, 0.001), warp_probability=0.0, points=(30_000, 40_000))
    pair = clean_pair(library, 3, settings)
    moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
    tree = cKDTree(pair.target.points)
    distance, index = tree.query(moved, k=12)
    near = distance[:, -1] < 0.02 * pair.extent
    patch = pair.target.points[index[near]]
    centre = patch.mean(axis=1, keepdims=True)
    normal = np.linalg.svd(patch - centre, full_matrices=False)[2][:, 2]
    off_plane = np.abs(np.einsum("nd,nd->n", normal, moved[near] - centre[:, 0]))
    assert near.mean() > 0.1
    assert np.percentile(off_plane, 90) < 3.0 * 0.001 * pair.extent


def test_scans_share_no_point_and_the_overlap_ratio_is_what_it_says(library):
    pair = clean_pair(library, 1)
    moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
    distance, _ = cKDTree(pair.target.points).query(moved)
    assert distance.min() > 0.0
    assert pair.overlap_ratio["source"] == pytest.approx((distance < 0.011 * pair.extent).mean(), abs=0.06)


def test_the_viewpoint_sees_every_point_first(library):
    """From the stated viewpoint, no point has another far in front of it on nearly the same ray."""
    for number in range(4):
        pair = clean_pair(library, number)
        for cloud, viewpoint in (
            (pair.source, pair.source_viewpoint),
            (pair.target, pair.target_viewpoint),
        ):
            assert np.linalg.norm(viewpoint) == pytest.approx(1.0)
            height = cloud.points @ viewpoint
            across = cloud.points - height[:, None] * viewpoint
            neighbour = cKDTree(across).query(across, k=2)[1][:, 1]
            # Steep surfaces and depth steps allow some; two layers on top of each other would give half.
            assert (np.abs(height[neighbour] - height) > 0.05 * pair.extent).mean() < 0.05


def test_scans_merged_from_several_views_carry_no_viewpoint(library):
    pair = clean_pair(library, 0, replace(CLEAN, several_views_probability=1.0))
    assert pair.source_viewpoint is None and pair.target_viewpoint is None


def test_counts_and_noise_stay_within_the_settings(library):
    pairs = [clean_pair(library, number, PairSettings()) for number in range(8)]
    counts = np.array([[len(p.source), len(p.target)] for p in pairs])
    assert counts.max() <= 40_002 and counts.min() >= 500
    assert counts.max() > 3 * counts.min()  # densities differ
    assert all(np.isfinite(p.source.points).all() and p.source.points.dtype == np.float64 for p in pairs)
    assert all(p.smaller_overlap >= 0.1 for p in pairs)


def test_overlap_bands_are_hit_about_evenly(library):
    settings = replace(PairSettings(), kinds=(1, 0, 0, 0), points=(4000, 5000))
    rng = np.random.default_rng(5)
    overlaps = [random_pair(library, rng, settings).smaller_overlap for _ in range(30)]
    shares = np.histogram(overlaps, [0.1, 0.3, 0.5, 1.0])[0] / len(overlaps)
    assert shares.min() > 0.1


def test_rotations_are_uniform(library):
    rng = np.random.default_rng(6)
    traces = np.array([np.trace(random_rotation(rng)) for _ in range(4000)])
    assert traces.mean() == pytest.approx(0.0, abs=0.06)  # E[trace] = 0, Var = 1 under SO(3)
    assert traces.var() == pytest.approx(1.0, abs=0.1)
    sparse = replace(PairSettings(), kinds=(0, 1, 0, 0))
    angles = [
        rigid.rotation_angle_deg(random_pair(library, rng, sparse).gt_T_target_source[:3, :3])
        for _ in range(20)
    ]
    assert np.mean(angles) == pytest.approx(126.5, abs=25)  # the mean angle between random rotations


def test_the_seed_decides_everything(library):
    for kinds in ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)):
        settings = replace(PairSettings(), kinds=kinds)
        first, again, other = (
            random_pair(library, np.random.default_rng(seed), settings) for seed in (9, 9, 10)
        )
        np.testing.assert_array_equal(first.source.points, again.source.points)
        np.testing.assert_array_equal(first.target.points, again.target.points)
        np.testing.assert_array_equal(first.gt_T_target_source, again.gt_T_target_source)
        assert not np.array_equal(first.gt_T_target_source, other.gt_T_target_source)


def test_evaluation_pairs_lie_in_their_bands_and_do_not_depend_on_the_count(library):
    bands = ((0.1, 0.3), (0.3, 0.5), (0.5, 0.7))
    settings = replace(PairSettings(), points=(4000, 6000))
    pairs = list(evaluation_pairs(library, 3, 6, bands, settings))
    for number, pair in enumerate(pairs):
        low, high = bands[number % 3]
        assert low <= pair.smaller_overlap < high
        assert pair.kind == "range_scan"
    again = next(evaluation_pairs(library, 3, 1, bands, settings))
    np.testing.assert_array_equal(again.source.points, pairs[0].source.points)


@pytest.mark.parametrize(("keep", "count"), [(0.7, 717), (0.5, 512)])
def test_the_papers_protocols_have_the_papers_counts(library, keep, count):
    for sampling in ("shared", "independent"):
        pair = surface_pair(library.mesh(0), np.random.default_rng(0), sampling, keep)
        assert len(pair.source) == len(pair.target) == count
        assert pair.kind == sampling


def test_shared_pairs_share_points_and_independent_ones_do_not(library):
    nearest = {}
    for sampling in ("shared", "independent"):
        pair = surface_pair(library.mesh(1), np.random.default_rng(1), sampling, 0.9, noise=0.0)
        moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
        nearest[sampling] = cKDTree(pair.target.points).query(moved)[0]
    assert (nearest["shared"] < 1e-9).mean() > 0.7
    assert (nearest["independent"] < 1e-9).mean() == 0.0


def test_jitter_is_clipped(library):
    pair = surface_pair(library.mesh(1), np.random.default_rng(1), "shared", 1.0, noise=0.2, clip=0.05)
    moved = rigid.apply(pair.gt_T_target_source, pair.source.points)
    distance = cKDTree(pair.target.points).query(moved)[0]
    assert distance.max() <= 2 * 0.05 * np.sqrt(3) + 1e-9  # both clouds are off by at most this


def test_paper_rotations_stay_within_45_degrees_about_each_axis(library):
    for seed in range(10):
        pair = surface_pair(library.mesh(0), np.random.default_rng(seed), "shared", rotations="euler45")
        matrix = pair.gt_T_target_source[:3, :3]
        about_y = np.arcsin(-matrix[2, 0])
        assert 0 <= np.degrees(about_y) <= 45
        assert 0 <= np.degrees(np.arctan2(matrix[2, 1], matrix[2, 2])) <= 45
        assert 0 <= np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])) <= 45


def test_hidden_surfaces_are_not_sampled():
    mesh = joined(cuboid((2, 1.5, 1)), ball(0.3))
    pair = surface_pair(mesh, np.random.default_rng(2), "shared", 1.0, noise=0.0)
    centred = pair.source.points - (pair.source.points.max(axis=0) + pair.source.points.min(axis=0)) / 2
    assert (np.linalg.norm(centred, axis=1) < 0.25).mean() < 0.003  # 8 % of the mesh's area


@pytest.mark.parametrize("sampling", ["shared", "independent"])
def test_the_whole_object_travels_along_without_changing_the_pair(library, sampling):
    without, pair = (
        surface_pair(library.mesh(0), np.random.default_rng(4), sampling, noise=0.0, whole=whole)
        for whole in (False, True)
    )
    assert without.object_points is None
    np.testing.assert_array_equal(without.source.points, pair.source.points)
    np.testing.assert_array_equal(without.target.points, pair.target.points)
    # The source is part of it as it lies, the target once the object is moved as the source is.
    assert cKDTree(pair.object_points).query(pair.source.points)[0].max() < 1e-9
    moved = rigid.apply(pair.gt_T_target_source, pair.object_points)
    assert cKDTree(moved).query(pair.target.points)[0].max() < 1e-9


@pytest.mark.parametrize("make", [range_scan_pair, patch_pair])
def test_scans_and_patches_lie_on_the_whole_object(library, make):
    settings = replace(CLEAN, minimum_overlap=0.0, keep_above=1.0)
    without, pair = (
        make(library.mesh(1), np.random.default_rng(5), settings, whole=whole) for whole in (False, True)
    )
    assert without.object_points is None
    np.testing.assert_array_equal(without.source.points, pair.source.points)
    assert 15_000 <= len(pair.object_points) <= 40_000
    tree = cKDTree(pair.object_points)
    for points in (
        pair.source.points,
        rigid.apply(rigid.invert(pair.gt_T_target_source), pair.target.points),
    ):
        assert np.quantile(tree.query(points)[0], 0.99) < 0.02 * pair.extent
    # And it is whole: much of it neither scan shows.
    seen = cKDTree(pair.source.points).query(pair.object_points)[0] < 0.02 * pair.extent
    assert seen.mean() < 0.8


def test_points_that_are_given_are_the_ones_used(library):
    mesh = library.mesh(0)
    given = 0.9 * sample_surface(*mesh, 2048, np.random.default_rng(0))[0]
    for sampling in ("shared", "independent"):
        with_whole, pair = (
            surface_pair(
                (0.9 * mesh[0], mesh[1]), np.random.default_rng(7), sampling, noise=0.0, rotations="euler45",
                sample=given, whole=whole,
            )
            for whole in (True, False)
        )  # fmt: skip
        np.testing.assert_array_equal(pair.source.points, with_whole.source.points)
        assert len(pair.source) == 717
        # The target stays in the object's frame: its points are the given ones, neither moved nor scaled.
        assert cKDTree(given).query(pair.target.points)[0].max() < 1e-6
        moved = rigid.apply(pair.gt_T_target_source, with_whole.object_points)
        assert cKDTree(moved).query(given)[0].max() < 0.1
    assert pair.object_points is None
    with pytest.raises(DegeneratePair, match="only 2000"):
        surface_pair(mesh, np.random.default_rng(7), sample=given[:2000])


def test_shared_points_are_known_by_their_numbers(library):
    pair = surface_pair(library.mesh(0), np.random.default_rng(6), "shared", 0.7, noise=0.0)
    source, target = pair.source.points[pair.shared[:, 0]], pair.target.points[pair.shared[:, 1]]
    np.testing.assert_allclose(rigid.apply(pair.gt_T_target_source, source), target, atol=1e-9)
    distance = cKDTree(pair.target.points).query(rigid.apply(pair.gt_T_target_source, pair.source.points))[0]
    assert len(pair.shared) == (distance < 1e-9).sum()  # all of them
    assert surface_pair(library.mesh(0), np.random.default_rng(6), "independent").shared is None


def test_one_evaluation_pair_is_made_without_those_before_it(library):
    settings = replace(PairSettings(), points=(4000, 6000))
    bands = ((0.1, 0.5), (0.5, 0.9))
    pairs = list(evaluation_pairs(library, 3, 2, bands, settings))
    alone = evaluation_pair(library, 3, 1, bands, settings, whole=True)
    np.testing.assert_array_equal(alone.source.points, pairs[1].source.points)
    assert alone.shape in library.names and alone.object_points is not None


def test_patches_are_parts_of_a_whole_surface(library):
    pair = patch_pair(library.mesh(2), np.random.default_rng(3))
    assert pair.kind == "patch" and pair.source_viewpoint is None
    assert pair.smaller_overlap >= 0.1
    assert np.linalg.norm(np.ptp(pair.source.points, axis=0)) < 1.7 * pair.extent


def test_symmetric_shapes_are_recognised(library):
    rng = np.random.default_rng(4)
    for mesh, symmetric in ((cuboid((1, 2, 3)), True), (ball(), True), (library.mesh(0), False)):
        assert maps_onto_itself(sample_surface(*mesh, 20_000, rng)[0], rng) is symmetric


def test_a_hopeless_library_raises_after_its_attempts(library):
    settings = replace(CLEAN, kinds=(1, 0, 0, 0), minimum_overlap=1.1, attempts=2, points=(1000, 1100))
    with pytest.raises(DegeneratePair, match="2 draws"):
        random_pair(library, np.random.default_rng(0), settings)


def test_shapes_without_area_are_passed_over():
    nothing = (np.zeros((3, 3)), np.array([[0, 1, 2]]))
    hopeless = pack([nothing], ["nothing"], ["train"], ["one"])
    for kinds in ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)):
        settings = replace(CLEAN, kinds=kinds, attempts=3)
        with pytest.raises(DegeneratePair, match="3 draws"):
            random_pair(hopeless, np.random.default_rng(0), settings)


def test_a_cloud_along_a_line_is_refused():
    line = np.linspace(0, 1, 600)[:, None] * np.array([1.0, 2.0, 3.0])
    with pytest.raises(DegeneratePair, match="line"):
        check_cloud(line, 500, 1.0)
    with pytest.raises(DegeneratePair, match="only 600"):
        check_cloud(line, 1000, 1.0)


def test_an_unknown_sampling_is_refused(library):
    with pytest.raises(ValueError, match="sampling"):
        surface_pair(library.mesh(0), np.random.default_rng(0), "both")


def test_thinned_out_and_too_little_overlap_are_told_apart(library):
    strict = replace(CLEAN, minimum_overlap=1.1)
    with pytest.raises(DegeneratePair, match="is under"):
        range_scan_pair(library.mesh(0), np.random.default_rng(0), strict)
    thin = replace(CLEAN, thin_above=0.0, keep_above=0.0, minimum_overlap=0.0)
    with pytest.raises(DegeneratePair, match="thinned"):
        range_scan_pair(library.mesh(0), np.random.default_rng(0), thin)
