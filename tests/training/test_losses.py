"""Labels and losses against hand-made cases and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from utopic_cli.geometry import rigid
from utopic_cli.model.uncertainty import OverlapDistribution
from utopic_cli.training.completion import CompletionDecoder, canonical_frame
from utopic_cli.training.labels import Labels, label_pair, mutual_nearest
from utopic_cli.training.losses import (
    chamfer_loss,
    descriptor_loss,
    overlap_loss,
    registration_loss,
    uncertainty_loss,
)


def hard_labels(correspondences: torch.Tensor) -> Labels:
    return Labels(
        correspondences,
        torch.zeros_like(correspondences, dtype=torch.bool),
        (correspondences.sum(2) > 0).float(),
        (correspondences.sum(1) > 0).float(),
    )


def test_labels_equal_brute_force():
    rng = np.random.default_rng(0)
    target = rng.uniform(-1, 1, (40, 3))
    gt = rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
    source = rigid.apply(rigid.invert(gt), np.concatenate([target[:25] + 0.02, rng.uniform(4, 5, (10, 3))]))
    spacing = 0.3
    labels = label_pair(
        torch.from_numpy(source)[None],
        torch.from_numpy(target)[None],
        torch.from_numpy(gt)[None],
        torch.tensor([spacing]),
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
    assert mutual_nearest(source, target, 0.075).tolist() == [[[1, 0], [0, 0], [0, 0]]]
    assert mutual_nearest(source, target, 0.5).tolist() == [[[1, 0], [0, 0], [0, 1]]]


def test_the_papers_labels_are_hard_and_within_their_radius():
    source = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [5.0, 0, 0]]])
    target = torch.tensor([[[0.02, 0, 0], [5.2, 0, 0]]])
    labels = label_pair(source, target, torch.eye(4)[None], torch.tensor([0.2]), hard_radius=0.075)
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
        return float(uncertainty_loss(distribution, torch.tensor([[overlap]])))

    assert loss(0.0, 0.0, 1.0) == pytest.approx(0.5 * math.log(2))  # KL of N(0, 1) to itself is 0
    assert loss(2.0, 0.0, 0.0) > loss(2.0, 0.0, 1.0)
    assert loss(0.0, -3.0, 1.0) == pytest.approx(0.5 * math.log(2) + 0.1 * 0.5 * (math.exp(-3) - 1 + 3))


def test_chamfer_loss_of_two_known_clouds():
    predicted, expected = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]]), torch.tensor([[[0.0, 0, 1.0]]])
    forward, backward = (1 + math.sqrt(2)) / 2, 1.0
    assert float(chamfer_loss(predicted, expected)) == pytest.approx(0.5 * (forward + backward), rel=1e-5)


def test_the_canonical_frame_moves_with_the_cloud():
    rng = np.random.default_rng(1)
    points = rng.gamma(2.0, 1.0, (200, 3)) * [3.0, 2.0, 1.0]
    pose = rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
    coordinates = []
    for cloud in (points, rigid.apply(pose, points)):
        tensor = torch.from_numpy(cloud)[None]
        centre, axes = canonical_frame(tensor)
        assert float(torch.linalg.det(axes[0])) == pytest.approx(1.0)
        coordinates.append((tensor - centre) @ axes)
    torch.testing.assert_close(coordinates[0], coordinates[1], atol=1e-8, rtol=1e-6)


def test_the_completion_decoder_makes_the_sizes_it_promises():
    coarse, fine = CompletionDecoder(16, coarse=32, folds=4)(torch.randn(2, 50, 16))
    assert coarse.shape == (2, 32, 3) and fine.shape == (2, 128, 3)
