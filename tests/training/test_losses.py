"""Labels and losses against hand-made cases and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from utopic_cli.geometry import rigid
from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.model.uncertainty import OverlapDistribution
from utopic_cli.training.completion import CompletionDecoder, canonical_frame
from utopic_cli.training.labels import Labels, label_pair, mutual_nearest
from utopic_cli.training.losses import (
    FAR_WEIGHT,
    chamfer_loss,
    descriptor_loss,
    overlap_loss,
    registration_loss,
    reliability_loss,
    uncertainty_loss,
)


def hard_labels(correspondences: torch.Tensor) -> Labels:
    return Labels(
        correspondences,
        torch.zeros_like(correspondences, dtype=torch.bool),
        (correspondences.sum(2) > 0).float(),
        (correspondences.sum(1) > 0).float(),
        torch.ones_like(correspondences[:, :, 0]),
        torch.ones_like(correspondences[:, 0]),
    )


def bare_cloud(points: torch.Tensor, spacing: float, valid: torch.Tensor | None = None) -> CloudInput:
    """What labels need of a cloud: points (B, N, 3), spacing, validity."""
    nothing = torch.zeros(0)
    return CloudInput(points, nothing, torch.full((len(points),), spacing), nothing, (), (), valid)


def test_labels_equal_brute_force():
    rng = np.random.default_rng(0)
    target = rng.uniform(-1, 1, (40, 3))
    gt = rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
    source = rigid.apply(rigid.invert(gt), np.concatenate([target[:25] + 0.02, rng.uniform(4, 5, (10, 3))]))
    spacing = 0.3
    labels = label_pair(
        bare_cloud(torch.from_numpy(source)[None], spacing),
        bare_cloud(torch.from_numpy(target)[None], spacing),
        torch.from_numpy(gt)[None],
    )
    moved = rigid.apply(gt, source)
    distance = np.linalg.norm(moved[:, None] - target[None], axis=2) / spacing
    weight = np.where(distance < 1.1, np.exp(-0.5 * (distance / 0.45) ** 2), 0.0)

    def nearest_four(rows: np.ndarray) -> np.ndarray:
        kept = np.zeros_like(rows)
        for i, row in enumerate(rows):
            chosen = np.argsort(-row)[:4]
            kept[i, chosen] = row[chosen]
        return kept / np.maximum(kept.sum(1, keepdims=True), 1e-6)

    expected = 0.5 * (nearest_four(weight) + nearest_four(weight.T).T)
    np.testing.assert_allclose(labels.correspondences[0].numpy(), expected, atol=1e-6)
    np.testing.assert_array_equal(labels.source_overlap[0].numpy(), (distance < 1.1).any(1))
    np.testing.assert_array_equal(labels.target_overlap[0].numpy(), (distance < 1.1).any(0))
    np.testing.assert_array_equal(labels.ignored[0].numpy(), (distance >= 1.1) & (distance < 2.0))
    assert labels.source_overlap[0, :25].all() and not labels.source_overlap[0, 25:].any()


def test_mutual_nearest_needs_both_sides_and_the_radius():
    source = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0]]])
    target = torch.tensor([[[0.02, 0, 0], [5.2, 0, 0]]])
    distance = torch.cdist(source, target)
    assert mutual_nearest(distance, 0.075).tolist() == [[[1, 0], [0, 0], [0, 0]]]
    assert mutual_nearest(distance, 0.5).tolist() == [[[1, 0], [0, 0], [0, 1]]]


def test_the_papers_labels_are_hard_and_within_their_radius():
    source = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0]]])
    target = torch.tensor([[[0.02, 0, 0], [5.2, 0, 0]]])
    clouds = (bare_cloud(source, 0.2), bare_cloud(target, 0.2))
    labels = label_pair(*clouds, torch.eye(4)[None], hard_radius=0.075)
    assert labels.correspondences.tolist() == [[[1, 0], [0, 0], [0, 0]]]
    assert labels.source_overlap.tolist() == [[1, 0, 0]]
    assert labels.target_overlap.tolist() == [[1, 0]]


def test_descriptor_loss_is_the_cross_entropy_of_known_partners():
    similarity = torch.tensor([[[1.0, 0.0], [0.0, 1.0], [0.3, 0.3]]])
    labels = hard_labels(torch.tensor([[[1.0, 0], [0, 1.0], [0, 0]]]))
    forward = math.log(1 + math.exp(-5))  # rows 0 and 1; row 2 has no partner
    column = math.log(1 + math.exp(-5) + math.exp(-3.5))
    expected = 0.5 * (forward + column)
    assert float(descriptor_loss(similarity, torch.tensor(5.0), labels)) == pytest.approx(expected, rel=1e-5)


def test_descriptor_loss_leaves_ignored_entries_out():
    labels = hard_labels(torch.tensor([[[1.0, 0], [0, 1.0]]]))
    ignored = torch.tensor([[[False, True], [True, False]]])
    loss = descriptor_loss(torch.zeros(1, 2, 2), torch.tensor(5.0), labels._replace(ignored=ignored))
    assert float(loss) == pytest.approx(0.0, abs=1e-5)


def test_registration_loss_is_the_papers_sum_per_known_correspondence():
    scores = torch.tensor([[[0.8, 0.1, 0.1], [0.2, 0.3, 0.5], [0.0, 0.6, 0.0]]])
    labels = hard_labels(torch.tensor([[[1.0, 0], [0, 0]]]))
    expected = -(math.log(0.8) + math.log(0.9) + math.log(0.8) + math.log(0.7))
    assert float(registration_loss(scores, labels)) == pytest.approx(expected, rel=1e-5)


def test_overlap_loss_is_binary_cross_entropy_of_both_clouds():
    labels = hard_labels(torch.tensor([[[1.0, 0], [0, 0]]]))
    source, target = torch.tensor([[2.0, -2.0]]), torch.tensor([[0.0, 0.0]])
    expected = 0.5 * (math.log(1 + math.exp(-2)) + math.log(2))
    assert float(overlap_loss(source, target, labels)) == pytest.approx(expected, rel=1e-5)


def test_uncertainty_loss_grows_for_confident_wrong_points_and_narrow_gaussians():
    def loss(mean: float, log_variance: float, overlap: float) -> float:
        samples = torch.full((1, 4, 1), 1 / (1 + math.exp(-mean)))
        distribution = OverlapDistribution(
            torch.tensor([[mean]]), torch.tensor([[log_variance]]), samples, torch.zeros(1, 1)
        )
        return float(uncertainty_loss(distribution, torch.tensor([[overlap]]), torch.ones(1, 1)))

    assert loss(0.0, 0.0, 1.0) == pytest.approx(0.5 * math.log(2))  # KL of N(0, 1) to itself is 0
    assert loss(2.0, 0.0, 0.0) > loss(2.0, 0.0, 1.0)
    assert loss(0.0, -3.0, 1.0) == pytest.approx(0.5 * math.log(2) + 0.1 * 0.5 * (math.exp(-3) - 1 + 3))


def test_chamfer_loss_of_two_known_clouds():
    predicted, expected = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]]), torch.tensor([[[0.0, 0, 1.0]]])
    forward, backward = (1 + math.sqrt(2)) / 2, 1.0
    loss = chamfer_loss(predicted, expected, torch.ones(1, 1))
    assert float(loss) == pytest.approx(0.5 * (forward + backward), rel=1e-5)


def test_the_canonical_frame_moves_with_the_cloud():
    rng = np.random.default_rng(1)
    points = rng.gamma(2.0, 1.0, (200, 3)) * [3.0, 2.0, 1.0]
    pose = rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
    coordinates = []
    for cloud in (points, rigid.apply(pose, points)):
        tensor = torch.from_numpy(cloud)[None]
        centre, axes = canonical_frame(tensor, torch.ones_like(tensor[..., 0]))
        assert float(torch.linalg.det(axes[0])) == pytest.approx(1.0)
        coordinates.append((tensor - centre) @ axes)
    torch.testing.assert_close(coordinates[0], coordinates[1], atol=1e-8, rtol=1e-6)


def test_the_completion_decoder_makes_the_sizes_it_promises():
    coarse, fine = CompletionDecoder(16, coarse=32, folds=4)(torch.randn(2, 50, 16))
    assert coarse.shape == (2, 32, 3) and fine.shape == (2, 128, 3)


def test_nodes_that_fill_a_batch_up_are_no_part_of_any_answer():
    rng = np.random.default_rng(4)
    source, target = (torch.from_numpy(rng.uniform(-1, 1, (1, 30, 3))).float() for _ in range(2))
    valid = torch.arange(30)[None] < 22
    filled = label_pair(bare_cloud(source, 0.5, valid), bare_cloud(target, 0.5), torch.eye(4)[None])
    alone = label_pair(bare_cloud(source[:, :22], 0.5), bare_cloud(target, 0.5), torch.eye(4)[None])
    torch.testing.assert_close(filled.correspondences[:, :22], alone.correspondences)
    assert not filled.correspondences[:, 22:].any() and filled.ignored[:, 22:].all()
    torch.testing.assert_close(filled.target_overlap, alone.target_overlap)
    similarity = torch.from_numpy(rng.uniform(-1, 1, (1, 30, 30))).float()
    scale = torch.tensor(5.0)
    torch.testing.assert_close(
        descriptor_loss(similarity, scale, filled), descriptor_loss(similarity[:, :22], scale, alone)
    )
    logits, other = similarity[:, :, 0], similarity[:, :, 1]
    torch.testing.assert_close(
        overlap_loss(logits, other, filled), overlap_loss(logits[:, :22], other, alone)
    )
    torch.testing.assert_close(
        chamfer_loss(target, source, valid.float()), chamfer_loss(target, source[:, :22], torch.ones(1, 22))
    )
    frames = (canonical_frame(source, valid.float()), canonical_frame(source[:, :22], torch.ones(1, 22)))
    torch.testing.assert_close(frames[0], frames[1])
    features = torch.randn(1, 30, 16)
    decoder = CompletionDecoder(16, coarse=8, folds=4)
    torch.testing.assert_close(decoder(features, valid), decoder(features[:, :22]))


def test_a_loss_is_a_mean_over_pairs():
    rng = np.random.default_rng(6)
    similarity = torch.from_numpy(rng.uniform(-1, 1, (2, 5, 5))).float()
    partners = torch.stack([torch.eye(5), torch.diag(torch.tensor([1.0, 0, 0, 0, 0]))])
    both = hard_labels(partners)
    each = [
        descriptor_loss(similarity[i : i + 1], torch.tensor(5.0), hard_labels(partners[i : i + 1]))
        for i in (0, 1)
    ]
    assert float(descriptor_loss(similarity, torch.tensor(5.0), both)) == pytest.approx(float(sum(each)) / 2)


def spread_out(variances: list[float]) -> OverlapDistribution:
    """Points of such raw uncertainty."""
    raw = torch.tensor([variances])
    nothing = torch.zeros_like(raw)
    return OverlapDistribution(nothing, nothing, nothing[:, None], raw)


def test_reliability_loss_reads_the_variance_as_odds_of_a_wrong_match():
    # Point 0 is matched rightly, 1 wrongly, 2 only near the border, 3 far from everything, 4 no point.
    scores = torch.tensor([[[0.9, 0.1], [0.8, 0.2], [0.1, 0.9], [0.9, 0.1], [0.9, 0.1]]])
    near = torch.tensor([[[1, 0], [0, 1], [0, 1], [0, 0], [1, 0]]]).bool()
    overlap = torch.tensor([[1.0, 1, 0, 0, 1]])
    valid = torch.tensor([[1.0, 1, 1, 1, 0]])
    distribution = spread_out([0.02 / 3, 0.06, 0.18, 0.2, 0.2])  # odds 1/3, 3, 9
    expected = -(math.log(3 / 4) + math.log(3 / 4) + math.log(9 / 10)) / 3
    blind, shown = torch.zeros(1), torch.ones(1)
    found = float(reliability_loss(distribution, scores, near, overlap, valid, blind))
    assert found == pytest.approx(expected, rel=1e-4)
    other = spread_out([0.06, 0.06, 0.18, 0.2, 0.2])
    assert float(reliability_loss(other, scores, near, overlap, valid, blind)) > expected + 0.3
    # Shown a transformation, it should be seen that point 3 has no match to be wrong: odds 10.
    found = float(reliability_loss(distribution, scores, near, overlap, valid, shown))
    assert found == pytest.approx((3 * expected + FAR_WEIGHT * math.log(11)) / (3 + FAR_WEIGHT), rel=1e-4)


def test_reliability_loss_moves_the_variance_of_a_wrong_point_up():
    mean, log_variance = torch.zeros(1, 1), torch.full((1, 1), -2.0, requires_grad=True)
    noise = torch.randn(1, 50, 1, generator=torch.Generator().manual_seed(0))
    samples = torch.sigmoid(mean[:, None] + noise * (0.5 * log_variance).exp()[:, None])
    distribution = OverlapDistribution(mean, log_variance, samples, samples.var(dim=1, unbiased=False))
    scores, near = torch.tensor([[[0.9, 0.1]]]), torch.tensor([[[False, True]]])
    reliability_loss(
        distribution, scores, near, torch.ones(1, 1), torch.ones(1, 1), torch.zeros(1)
    ).backward()
    assert float(log_variance.grad) < 0
