"""Each part of the network against a slow, plain formulation of the paper's text."""

from __future__ import annotations

import numpy as np
import torch

from tests.model.conftest import SMALL, bumpy_points, cloud_input
from utopic_cli.config import ModelConfig
from utopic_cli.model.attention import AttentionLayer
from utopic_cli.model.cloud_input import gather
from utopic_cli.model.feature_extractor import AdaptConv
from utopic_cli.model.geometric_embedding import geometric_embedding
from utopic_cli.model.local_geometry import LocalGeometryEncoder, edge_invariants
from utopic_cli.model.matching import sinkhorn
from utopic_cli.model.uncertainty import UncertaintyWeighting, normalise_uncertainty


def test_gather_picks_rows_of_their_own_batch():
    values = torch.arange(12.0).view(2, 3, 2)
    index = torch.tensor([[[2, 0]], [[1, 1]]])
    assert gather(values, index).tolist() == [[[[4, 5], [0, 1]]], [[[8, 9], [8, 9]]]]


def test_adaptive_convolution_per_point_equals_the_one_per_edge():
    torch.manual_seed(0)
    layer = AdaptConv(5, 7, 6, hidden=4, rank=0, normalisation="layer")
    features, edges = torch.randn(1, 9, 5), torch.randn(1, 9, 3, 6)
    neighbours = torch.randint(0, 9, (1, 9, 3))
    # The paper's: a kernel from [f_j - f_i, f_i] applied to the edge, for every edge.
    a, b = layer.neighbour_part.weight, layer.point_part.weight
    on_difference, on_point = a, a + b
    expected = torch.empty(1, 9, 3, 7)
    kernel_weight = layer.output.weight.view(7, 5, 6)  # hidden + 1 rows of 6 edge channels
    for i in range(9):
        for slot in range(3):
            j = neighbours[0, i, slot]
            hidden = on_difference @ (features[0, j] - features[0, i]) + on_point @ features[0, i]
            hidden = torch.nn.functional.leaky_relu(hidden + layer.point_part.bias, 0.2)
            kernel = torch.einsum("chd,h->cd", kernel_weight, torch.cat([hidden, torch.ones(1)]))
            expected[0, i, slot] = kernel @ edges[0, i, slot] + layer.output.bias
    strongest = layer.norm(expected.max(dim=2).values) + layer.shortcut(features)
    torch.testing.assert_close(
        layer(features, edges, neighbours),
        torch.nn.functional.leaky_relu(strongest, 0.2),
        atol=1e-5,
        rtol=1e-4,
    )


def test_geometric_embedding_follows_the_three_definitions():
    points = torch.from_numpy(bumpy_points(12, 3).astype(np.float32))[None]
    neighbours = torch.cdist(points, points).argsort(dim=2)[:, :, 1:4]
    embedding = geometric_embedding(points, neighbours)[0]
    p = points[0].numpy()

    def perimeter(i: int) -> float:
        k1, k2 = neighbours[0, i, :2].tolist()
        a, b, c = p[i], p[k1], p[k2]
        return float(np.linalg.norm(a - b) + np.linalg.norm(a - c) + np.linalg.norm(b - c))

    for i in range(12):
        k1, k2 = neighbours[0, i, :2].tolist()
        triplet = (p[k1] - p[i]) + (p[k2] - p[i])
        for j in range(12):
            if i == j:
                assert embedding[:, i, i].abs().max() < 1e-6
                continue
            to_j = p[j] - p[i]
            angle = np.arccos(triplet @ to_j / np.linalg.norm(triplet) / np.linalg.norm(to_j))
            expected = [np.linalg.norm(to_j), angle, perimeter(i) - perimeter(j)]
            np.testing.assert_allclose(embedding[:, i, j].numpy(), expected, atol=2e-3)


def test_attention_adds_the_embedding_to_the_scores():
    torch.manual_seed(0)
    layer = AttentionLayer(8, heads=2, relations=3)
    torch.nn.init.normal_(layer.relation)
    features, embedding = torch.randn(1, 6, 8), torch.randn(1, 3, 6, 6)
    query = layer.query(features).view(6, 2, 4)
    key, value = layer.key_value(features).view(6, 2, 2, 4).permute(1, 0, 2, 3)
    heads = []
    for head in range(2):
        scores = query[:, head] @ key[:, head].T / 2.0
        scores = scores + torch.einsum("r,rij->ij", layer.relation[head], embedding[0])
        heads.append(torch.softmax(scores, dim=1) @ value[:, head])
    message = torch.cat(heads, dim=1)
    hidden = layer.attention_norm(features + layer.merge(message))
    expected = layer.output_norm(hidden + layer.feed_forward(hidden))
    torch.testing.assert_close(layer(features, features, embedding), expected, atol=1e-5, rtol=1e-4)


def test_sinkhorn_equals_the_log_domain_form():
    torch.manual_seed(0)
    affinity = 3.0 * torch.randn(2, 7, 5)
    scores = sinkhorn(affinity, 20)
    padded = torch.nn.functional.pad(affinity, (0, 1, 0, 1))  # slack entries of affinity 0
    row, column = torch.zeros(2, 8), torch.zeros(2, 6)
    for _ in range(20):
        row[:, :-1] = -torch.logsumexp(padded + column[:, None], dim=2)[:, :-1]
        column[:, :-1] = -torch.logsumexp(padded + row[..., None], dim=1)[:, :-1]
    expected = (padded + row[..., None] + column[:, None]).exp()
    torch.testing.assert_close(scores[:, :-1, :-1], expected[:, :-1, :-1], atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(scores[:, :, :-1].sum(dim=1), torch.ones(2, 5))
    rows = sinkhorn(affinity, 500)[:, :-1].sum(dim=2)  # rows sum to one in the limit
    torch.testing.assert_close(rows, torch.ones(2, 7), atol=1e-4, rtol=0)


def test_uncertainty_is_normalised_over_the_pair_and_flat_is_zero():
    source, target = torch.tensor([[1.0, 3.0]]), torch.tensor([[5.0, 2.0, 1.0]])
    normalised = normalise_uncertainty(source, target)
    assert normalised[0].tolist() == [[0.0, 0.5]]
    assert normalised[1].tolist() == [[1.0, 0.25, 0.0]]
    flat = normalise_uncertainty(torch.full((1, 4), 0.2), torch.full((1, 3), 0.2))
    assert flat[0].tolist() == [[0.0] * 4] and flat[1].tolist() == [[0.0] * 3]


def test_uncertain_points_lose_their_features():
    torch.manual_seed(0)
    weighting = UncertaintyWeighting(4)
    features, other, scores = torch.randn(1, 3, 4), torch.randn(1, 5, 4), torch.rand(1, 3, 5)
    plain = weighting(features, other, scores, None, None)
    faded = weighting(features, other, scores, torch.tensor([[0.0, 0.5, 1.0]]), None)
    torch.testing.assert_close(faded, plain * torch.tensor([1.0, 0.5, 0.0]).view(1, 3, 1))


def test_padding_of_a_patch_is_never_seen():
    torch.manual_seed(0)
    config = ModelConfig(**SMALL)
    encoder = LocalGeometryEncoder(8)
    cloud = cloud_input(bumpy_points(200, 0), config)
    assert not all(mask.all() for mask in cloud.patch_masks), "the case needs some padding"
    poisoned = cloud._replace(
        patches=tuple(
            patch.masked_fill(~mask[..., None], 7.0)
            for patch, mask in zip(cloud.patches, cloud.patch_masks, strict=True)
        )
    )
    torch.testing.assert_close(encoder(cloud), encoder(poisoned))


def test_edge_invariants_of_a_plane_and_a_step():
    up = torch.tensor([0.0, 0.0, 1.0])
    flat = edge_invariants(torch.tensor([0.6, 0.8, 0.0]), up, up)
    torch.testing.assert_close(
        flat, torch.tensor([1.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), atol=1e-4, rtol=0
    )
    raised = edge_invariants(torch.tensor([0.0, 0.0, 0.5]), up, up)
    assert raised[1] == 0.5 and raised[8] == 0.25


def test_attention_without_gradients_equals_attention_with_them():
    torch.manual_seed(2)
    layer = AttentionLayer(8, 2, 3)
    torch.nn.init.normal_(layer.relation)
    features, embedding = torch.randn(2, 7, 8), torch.randn(2, 3, 7, 7)
    valid = torch.arange(7) < torch.tensor([[7], [4]])
    plain = layer(features, features, embedding, valid)
    assert plain.requires_grad
    with torch.no_grad():
        fused = layer(features, features, embedding, valid)
    torch.testing.assert_close(fused, plain.detach(), atol=1e-6, rtol=1e-5)
