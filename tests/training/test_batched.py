"""Pairs made in batches on the device: like the ones made one at a time, and repeatable."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from utopic_cli.frame import DENSE_RATIO, _common_spacing
from utopic_cli.geometry.normals import orient_normals
from utopic_cli.preprocess import PATCHES, sample
from utopic_cli.synthesis import scanner as one_scanner
from utopic_cli.synthesis.pairs import random_pair
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.shapes import pack, procedural_shapes
from utopic_cli.training.batched import BatchedPairs, sampling
from utopic_cli.training.batched.draws import Draws, unit
from utopic_cli.training.batched.hypotheses import draw_hypotheses
from utopic_cli.training.batched.meshes import Meshes
from utopic_cli.training.batched.normals import guessed_signs, smallest_eigenvector
from utopic_cli.training.batched.ragged import group_means, masked_quantile, to_rows
from utopic_cli.training.batched.raw_pairs import RawPairs, smaller_overlap
from utopic_cli.training.batched.sampling import FlatClouds, dense_clouds, moved_apart, sampled
from utopic_cli.training.batched.scanner import depth_maps
from utopic_cli.training.batched.surface import map_onto_themselves, sample_surfaces, warp
from utopic_cli.training.batched.surface_pairs import paper_rotations
from utopic_cli.training.batched.voxels import near
from utopic_cli.training.hypotheses import MOST_ROTATION_DEG, MOST_SHIFT

CPU = torch.device("cpu")
POINTS = 200
SMALL = PairSettings(points=(1500, 3000), dense_samples=(4, 16_000, 18_000), patch_points=(1000, 3000))
SCANS = dataclasses.replace(SMALL, kinds=(1.0, 0.0, 0.0, 0.0))


def draws(seed=0):
    return Draws(torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def library():
    return procedural_shapes(np.random.default_rng(3), 12, resolution=32)


@pytest.fixture(scope="module")
def scans(library) -> RawPairs:
    return BatchedPairs(library, SCANS, device=CPU, neighbours=8).raw_pairs(10, draws(1))


@pytest.fixture(scope="module")
def batch(library):
    pairs = BatchedPairs(library, SMALL, device=CPU, neighbours=8)
    return pairs.make(6, POINTS, torch.Generator().manual_seed(2))


def one_cloud(clouds: FlatClouds, number: int) -> np.ndarray:
    return clouds.points[clouds.cloud == number].double().numpy()


@pytest.mark.parametrize("points", [POINTS, 4000], ids=["dense", "sparse"])
def test_what_the_network_sees_is_what_preprocess_makes(scans, points, monkeypatch):
    monkeypatch.setattr(sampling, "KNOWN_SIDE", 1.0)
    seen_once = scans.one_side.all(dim=1).nonzero()[:1, 0]
    clouds, _ = moved_apart(scans[seen_once])
    dense = dense_clouds(clouds, points, draws(5))
    nodes = sampled(clouds, dense, points, 8)
    each = [one_cloud(clouds, number) for number in (0, 1)]
    assert float(dense.spacing[0]) == pytest.approx(_common_spacing(each, points), rel=1e-4)
    for number, cloud in enumerate(each):
        towards = clouds.towards[clouds.cloud == number][0].double().numpy()
        expected = sample(cloud, float(dense.spacing[0]), points, viewpoint=1e4 * towards)
        mine = dense.voxels.cloud == number
        assert int(mine.sum()) == len(expected.dense.points)
        np.testing.assert_allclose(dense.voxels.means[mine], expected.dense.points, atol=1e-5)
        same = (dense.normals[mine].numpy() * expected.dense.normals).sum(axis=1)
        # A point with fewer than three in reach, an outlier, gets a random normal here.
        alone = near(dense.voxels.means[mine], dense.voxels.cloud[mine], dense.voxels, 3.0, 3)[0]
        together = alone.isfinite().all(dim=1).numpy()
        assert together.mean() > 0.95
        assert (same[together] > 0.999).mean() > 0.995
        valid = nodes.valid[number]
        assert int(valid.sum()) == len(expected.points)
        # Sparse clouds come in the order of their points here, and sorted there.
        order = np.arange(len(expected.points))
        if len(cloud) <= points:
            order = np.lexsort(nodes.points[number][valid].numpy().T[::-1])
        np.testing.assert_allclose(nodes.points[number][valid][order], expected.points, atol=1e-5)
        place = np.argsort(order)
        neighbours = place[nodes.neighbours[number][valid].numpy()][order]
        assert (neighbours == expected.neighbours[:, :8]).mean() > 0.995
        for scale in range(len(PATCHES)):
            mask = nodes.patch_masks[scale][number][valid][order].numpy()
            assert (mask == expected.patch_masks[scale]).mean() > 0.999
            offsets = nodes.patches[scale][number][valid][order].numpy()[..., :3]
            apart = np.abs(offsets - expected.patches[scale][..., :3]).max(axis=-1)
            assert (apart < 1e-3).mean() > 0.995


def test_neighbours_by_cells_equal_brute_force(scans):
    clouds, _ = moved_apart(scans[:2])
    voxels = dense_clouds(clouds, POINTS, draws(5)).voxels
    distance, index = near(voxels.means, voxels.cloud, voxels, 3.0, 12)
    every = torch.cdist(voxels.means, voxels.means, compute_mode="donot_use_mm_for_euclid_dist")
    radius = 3.0 * voxels.size[voxels.cloud]
    foreign = voxels.cloud[:, None] != voxels.cloud
    every = every.masked_fill(foreign | (every >= radius[:, None]), torch.inf)
    expected = every.topk(12, largest=False).values
    assert torch.equal(distance.isfinite(), expected.isfinite())
    found = distance.isfinite()
    torch.testing.assert_close(distance[found], expected[found], rtol=0, atol=1e-6)
    assert torch.equal(index[:, 0], torch.arange(len(index)))


def test_guessed_signs_are_those_of_inference(scans):
    clouds, _ = moved_apart(scans)
    count = len(clouds.one_side)
    dense = dense_clouds(clouds, POINTS, draws(7))
    voxels = dense.voxels
    normals = dense.normals
    distance, index = near(voxels.means, voxels.cloud, voxels, 3.0, 30)
    every = torch.ones(count, dtype=torch.bool)
    sign = guessed_signs(voxels.means, normals, distance, index, voxels.cloud, count, every)
    agreement = []
    for number in range(count):
        mine = voxels.cloud == number
        guessed = (normals * sign[:, None])[mine].double().numpy()
        expected = orient_normals(voxels.means[mine].double().numpy(), normals[mine].double().numpy())
        agreement.append((guessed * expected).sum(axis=1) > 0)
    shares = np.array([share.mean() for share in agreement])
    assert (shares > 0.95).mean() > 0.8
    nobody = guessed_signs(voxels.means, normals, distance, index, voxels.cloud, count, ~every)
    assert bool((nobody == 1).all())


def test_visibility_equals_the_scanner_of_single_pairs(library):
    source = draws(8)
    meshes = Meshes(library, CPU).batch(torch.arange(4))
    surfaces = sample_surfaces(meshes, torch.full((4,), 20_000), 20_000, source)
    direction = source.direction(4)
    cell = surfaces.cell.clamp_min(float(surfaces.extent.max()) / 100)
    view = depth_maps(surfaces.points, direction, cell, 101)
    seen, cosine = view.seen(surfaces.normals, 0.15)
    second = view.half(torch.ones(4, dtype=torch.int64))
    assert torch.equal(second.seen(surfaces.normals[:, 10_000:], 0.15)[0], seen[:, 10_000:])
    for i in range(4):
        expected = one_scanner.depth_map(surfaces.points[i].numpy(), direction[i].numpy(), float(cell[i]))
        normals = surfaces.normals[i].numpy()
        expected_seen, expected_cosine = expected.seen(np.arange(20_000), normals, 0.15)
        assert (seen[i].numpy() == expected_seen).mean() > 0.999
        assert (view.near_front()[i].numpy() == expected.near_front(slice(None))).mean() > 0.999
        np.testing.assert_allclose(cosine[i], expected_cosine, atol=1e-5)
        assert 0.05 < expected_seen.mean() < 0.7


def test_warped_normals_stand_on_the_warped_surface():
    source = draws(9)
    normal = source.direction(1, 500)
    first = unit(torch.linalg.cross(normal, source.direction(1, 500)))
    second = torch.linalg.cross(normal, first)
    centre, step = source.uniform(1, 500, 3), 1e-2
    points = torch.cat([centre + a * step * t for t in (first, second) for a in (-1, 1)], dim=1)
    normals = torch.cat([centre * 0 + normal] * 4, dim=1)
    moved, _ = warp(points, normals, torch.tensor([2.0]), torch.tensor([0.03]), draws(10))
    a, b, c, d = moved.view(1, 4, 500, 3).unbind(1)
    expected = unit(torch.linalg.cross(b - a, d - c))
    _, exact = warp(
        torch.cat([centre] * 4, dim=1), normals, torch.tensor([2.0]), torch.tensor([0.03]), draws(10)
    )
    assert float((expected * exact[:, :500]).sum(-1).abs().mean()) > 0.999
    assert float((normal * exact[:, :500]).sum(-1).abs().mean()) < 0.99  # the warp does bend


def test_a_ball_maps_onto_itself_and_a_lopsided_thing_does_not():
    source = draws(11)
    ball = source.direction(1, 2000)
    lopsided = ball * (1.0 + 0.5 * (ball * torch.tensor([1.0, 0.7, 0.4])).sum(-1, keepdim=True))
    lopsided = lopsided + torch.tensor([0.0, 0.3, 0.0]) * lopsided[..., :1].square()
    assert map_onto_themselves(torch.cat([ball, lopsided])).tolist() == [True, False]


def test_smallest_eigenvector_equals_the_general_solver():
    factors = draws(12).normal(500, 3, 3) * torch.tensor([1.0, 0.7, 0.01])
    factors[:5, :, 2] = 0.0  # exactly flat
    matrices = factors @ factors.transpose(1, 2)
    matrices[:5] = torch.diag(torch.tensor([1.0, 0.0, 1.0]))  # the two large ones coincide
    upper = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    expected = torch.linalg.eigh(matrices.double())[1][:, :, 0].float()
    assert float((smallest_eigenvector(upper) * expected).sum(-1).abs().min()) > 0.9999


def test_known_answers_bring_the_scans_together(batch):
    rotation, translation = batch.gt_T_target_source[:, :3, :3], batch.gt_T_target_source[:, None, :3, 3]
    moved = batch.source.points @ rotation.transpose(1, 2) + translation
    distance = torch.cdist(moved, batch.target.points)
    distance = distance.masked_fill(~batch.target.valid[:, None], torch.inf).amin(dim=2)
    distance = distance / batch.source.spacing[:, None]
    for own, valid in zip(distance, batch.source.valid, strict=True):
        overlap = own[valid] < 1.1
        assert overlap.float().mean() > 0.1
        assert own[valid][overlap].mean() < 0.75  # two grids of one surface, h apart, lie about h / 2 apart


def test_filling_comes_last_and_means_nothing(batch):
    for cloud in (batch.source, batch.target):
        count = cloud.valid.sum(dim=1)
        assert int(count.min()) >= 50 and int(count.max()) <= POINTS
        assert not bool((cloud.valid[:, 1:] & ~cloud.valid[:, :-1]).any())
        assert bool((cloud.points[~cloud.valid] == 0).all())
        assert not any(bool(mask[~cloud.valid].any()) for mask in cloud.patch_masks)
        assert bool((cloud.neighbours.amax(dim=(1, 2)) < count).all())
        own = torch.arange(POINTS)[:, None]
        assert not bool(((cloud.neighbours == own) & cloud.valid[..., None]).any())
        assert float((cloud.normals.norm(dim=2)[cloud.valid] - 1.0).abs().max()) < 1e-4
        assert cloud.points.isfinite().all() and all(patch.isfinite().all() for patch in cloud.patches)
        for patch, mask in zip(cloud.patches, cloud.patch_masks, strict=True):
            assert float(patch[..., :3].norm(dim=-1).max()) <= 1.0 + 1e-4
            assert bool((patch[~mask] == 0).all())


def test_a_seed_names_a_batch(library):
    pairs = BatchedPairs(library, SCANS, device=CPU, neighbours=8)
    first, again, other = (pairs.make(1, 60, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(first.source.points, again.source.points)
    assert torch.equal(first.target.patches[2], again.target.patches[2])
    assert torch.equal(first.hypothesis, again.hypothesis)
    assert not torch.equal(first.source.points, other.source.points)


def test_batches_look_like_single_pairs(library, scans):
    """Overlap, size and noise of raw pairs by both ways; tolerances are about three standard errors."""
    rng = np.random.default_rng(0)
    single = [random_pair(library, rng, SCANS) for _ in range(24)]
    overlap = smaller_overlap(scans, draws(13)).numpy()
    expected = np.array([pair.smaller_overlap for pair in single])
    assert overlap.min() >= SCANS.minimum_overlap - 0.05
    assert abs(overlap.mean() - expected.mean()) < 0.18
    sizes = scans.mask.sum(dim=2).float().mean()
    assert abs(float(sizes) / np.mean([[len(p.source), len(p.target)] for p in single]) - 1.0) < 0.25
    spread = [np.linalg.norm(p.source.points.std(axis=0)) / p.extent for p in single]
    mine = [
        float(p[m].std(dim=0).norm() / e)
        for p, m, e in zip(scans.points[:, 0], scans.mask[:, 0], scans.extent)
    ]
    assert abs(np.mean(mine) / np.mean(spread) - 1.0) < 0.2


def test_rotations_are_uniform():
    count = 2000
    clouds = RawPairs(
        draws(14).normal(count, 2, 12, 3),
        torch.ones(count, 2, 12, dtype=torch.bool),
        draws(15).direction(count, 2, 12),
        torch.ones(count, 2, dtype=torch.bool),
        draws(16).rotation(2 * count).view(count, 2, 3, 3),
        torch.ones(count),
        torch.ones(count, dtype=torch.bool),
    )
    flat, gt = moved_apart(clouds)
    rotation = gt[:, :3, :3]
    identity = torch.eye(3).expand(count, 3, 3)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), identity, atol=1e-5, rtol=0)
    assert float(rotation.mean(dim=0).abs().max()) < 0.06
    trace = rotation.diagonal(dim1=1, dim2=2).sum(dim=1)
    assert float(trace.square().mean()) == pytest.approx(1.0, abs=0.1)  # Haar: E tr = 0, E tr^2 = 1
    assert float(flat.points.norm(dim=1).max()) < 1.5
    assert float(group_means(flat.points, flat.cloud, 2 * count).abs().max()) < 1e-5


def test_the_papers_rotations_are_small_ones(library):
    rotation = paper_rotations(500, draws(30))
    yaw = torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0])
    pitch = torch.asin(-rotation[:, 2, 0])
    for angle in (yaw, pitch):
        assert float(angle.min()) >= 0.0 and float(angle.max()) <= np.pi / 4 + 1e-5
        assert float(angle.mean()) == pytest.approx(np.pi / 8, abs=0.05)
    paper = dataclasses.replace(SMALL, kinds=(0.0, 0.0, 1.0, 0.0), surface_rotations="euler45")
    raw = BatchedPairs(library, paper, device=CPU, neighbours=8).raw_pairs(2, draws(31))
    _, gt = moved_apart(raw)
    assert bool((gt[:, :3, :3].diagonal(dim1=1, dim2=2).sum(dim=1) > 0.9).all())
    # Two crops of one sample share their points but for the jitter.
    first, second = (raw.points[0, side][raw.mask[0, side]] for side in (0, 1))
    assert float((torch.cdist(first, second).amin(dim=1) < 0.05).float().mean()) > 0.1


def test_hypotheses_are_absent_nearly_right_or_settled(scans):
    rows = torch.arange(70) % 10
    clouds, gt = moved_apart(scans[rows])
    dense = dense_clouds(clouds, 50, draws(18))
    shown, present = draw_hypotheses(dense, gt, draws(19))
    assert float(present.mean()) == pytest.approx(0.6, abs=0.15)
    assert bool((shown[present == 0] == torch.eye(4)).all())
    error = shown[:, :3, :3] @ gt[:, :3, :3].transpose(1, 2)
    angle = torch.rad2deg(((error.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1).acos())
    near_right = (present == 1) & (angle <= MOST_ROTATION_DEG + 0.1)
    assert 0.25 < float(near_right.float().mean()) < 0.55
    shift = (shown[:, :3, 3] - gt[:, :3, 3]).norm(dim=1)[near_right]
    assert float(angle[near_right].median()) < 3.0
    reach = MOST_SHIFT * 1.8 * dense.spacing[::2][near_right] + 0.11 * gt[near_right, :3, 3].norm(dim=1)
    assert bool((shift <= reach).all())
    identity = torch.eye(3).expand(70, 3, 3)
    torch.testing.assert_close(
        shown[:, :3, :3] @ shown[:, :3, :3].transpose(1, 2), identity, atol=1e-4, rtol=0
    )


def test_kinds_and_bands_are_drawn_as_set(library):
    pairs = BatchedPairs(library, SMALL, device=CPU, neighbours=8)
    orders = pairs.orders(4000, draws(20))
    share = torch.bincount(orders.kind, minlength=4) / 4000
    torch.testing.assert_close(share, torch.tensor(SMALL.kinds), atol=0.03, rtol=0)
    bands, counts = orders.band.unique(dim=0, return_counts=True)
    torch.testing.assert_close(bands, torch.tensor(SMALL.bands))
    assert int(counts.min()) > 1200


def test_shapes_are_drawn_by_the_root_of_their_sets_size(library):
    meshes = [library.mesh(i) for i in range(10)]
    two = pack(meshes, list("abcdefghij"), ["train"] * 10, ["one"] * 9 + ["two"])
    drawn = Meshes(two, CPU).draw(8000, draws(21))
    assert float((drawn == 9).float().mean()) == pytest.approx(0.25, abs=0.02)
    batch = Meshes(two, CPU).batch(torch.tensor([9, 2]))
    for row, number in enumerate((9, 2)):
        vertices, faces = two.mesh(number)
        np.testing.assert_allclose(batch.vertices[row][batch.vertex_mask[row]], vertices, atol=1e-6)
        np.testing.assert_array_equal(batch.faces[row][: len(faces)], faces)


def test_no_usable_pair_is_an_error(library):
    impossible = dataclasses.replace(SCANS, minimum_overlap=1.1, attempts=2)
    pairs = BatchedPairs(library, impossible, device=CPU, neighbours=8)
    with pytest.raises(DegeneratePair, match="2 rounds"):
        pairs.make(1, 60, torch.Generator().manual_seed(0))


def test_shapes_without_surface_are_passed_over(library):
    point = np.zeros((4, 3)), np.array([[0, 1, 2], [1, 2, 3]])
    line = np.arange(12.0).reshape(4, 3), np.array([[0, 1, 1], [2, 3, 3]])
    few = pack([library.mesh(0), point, line], ["mesh", "point", "line"], ["train"] * 3, ["one"] * 3)
    pairs = BatchedPairs(few, SCANS, device=CPU, neighbours=8)
    attempt = pairs.attempt(pairs.orders(6, draws(28)), draws(29))
    drawn = pairs.meshes.draw(6, draws(29))
    assert set(drawn.tolist()) == {0, 1, 2}
    assert not bool(attempt.good[drawn > 0].any())
    made = pairs.make(1, 60, torch.Generator().manual_seed(3))
    assert made.source.points.isfinite().all() and made.hypothesis.isfinite().all()


def test_sums_do_not_depend_on_the_order():
    values, group = draws(22).normal(5000, 3), torch.arange(5000) % 7
    order = torch.randperm(5000, generator=torch.Generator().manual_seed(0))
    means = group_means(values, group, 7)
    assert torch.equal(means, group_means(values[order], group[order], 7))
    torch.testing.assert_close(means[3], values[group == 3].mean(dim=0))


def test_quantiles_rows_and_draws_respect_masks():
    values, mask = draws(23).normal(6, 50), draws(24).chance(0.5, 6, 50)
    expected = [np.quantile(v[m].double().numpy(), 0.99) for v, m in zip(values, mask, strict=True)]
    np.testing.assert_allclose(masked_quantile(values, mask, 0.99), expected, rtol=1e-4)
    drawn = draws(25).rows(mask, 400)
    assert bool(mask.gather(1, drawn).all())
    assert all(len(set(row.tolist())) == int(m.sum()) for row, m in zip(drawn, mask, strict=True))
    rows, filled = to_rows(torch.arange(6.0), torch.tensor([0, 0, 0, 2, 2, 2]), 3, 2)
    assert rows.tolist() == [[0, 1], [0, 0], [3, 4]]
    assert filled.tolist() == [[True, True], [False, False], [True, True]]


def test_dense_ratio_is_the_one_of_inference(scans):
    clouds, _ = moved_apart(scans[:1])
    dense = dense_clouds(clouds, POINTS, draws(27))
    torch.testing.assert_close(dense.voxels.size, dense.spacing / DENSE_RATIO)
