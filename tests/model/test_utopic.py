"""The network as a whole: sizes, invariance, batches, every configured variant."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.model.conftest import SMALL, bumpy_points, cloud_input
from utopic_cli.config import ModelConfig
from utopic_cli.model.cloud_input import CloudInput, stack_clouds
from utopic_cli.model.utopic import Utopic


def build(**changes: object) -> Utopic:
    torch.manual_seed(0)
    return Utopic(ModelConfig(**{**SMALL, **changes})).eval()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"input_features": "coordinates"},
        {"kernel_rank": 0},
        {"positional_scheme": "vanilla"},
        {"positional_scheme": "absolute"},
        {"positional_scheme": "learned"},
        {"uncertainty_scheme": "sampled"},
        {"uncertainty_scheme": "predicted"},
        {"uncertainty_scheme": "none"},
        {"normalisation": "batch"},
        {"descriptor_skip": False},
    ],
    ids=str,
)
def test_every_variant_predicts_for_clouds_of_different_sizes(changes, generator):
    model = build(**changes)
    source = cloud_input(bumpy_points(150, 0), model.config)
    target = cloud_input(bumpy_points(110, 1), model.config)
    with torch.no_grad():
        prediction = model(source, target, generator=generator)
    assert prediction.matching_scores.shape == (1, 151, 111)
    assert prediction.source_overlap.shape == (1, 150)
    assert prediction.target_overlap.shape == (1, 110)
    for values in (prediction.source_uncertainty, prediction.target_uncertainty, prediction.source_overlap):
        assert ((values >= 0) & (values <= 1)).all()
    assert torch.isfinite(prediction.matching_scores).all()


def test_a_rigid_motion_of_either_cloud_changes_nothing_in_the_invariant_network(pose):
    model = build()
    source_points, target_points = bumpy_points(150, 0), bumpy_points(130, 1)
    source, target = cloud_input(source_points, model.config), cloud_input(target_points, model.config)
    rotation = torch.from_numpy(pose[:3, :3].astype(np.float32))
    moved = CloudInput(
        points=source.points @ rotation.T + torch.from_numpy(pose[:3, 3].astype(np.float32)),
        normals=source.normals @ rotation.T,
        spacing=source.spacing,
        neighbours=source.neighbours,
        patches=tuple(
            torch.cat([patch[..., :3] @ rotation.T, patch[..., 3:] @ rotation.T], dim=-1)
            for patch in source.patches
        ),
        patch_masks=source.patch_masks,
    )
    with torch.no_grad():
        before = model(source, target, generator=torch.Generator().manual_seed(1))
        after = model(moved, target, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(after.matching_scores, before.matching_scores, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(after.source_overlap, before.source_overlap, atol=1e-4, rtol=1e-3)


def test_a_mirrored_shape_looks_different():
    model = build()
    points = bumpy_points(150, 0)
    with torch.no_grad():
        here, _ = model.extractor(cloud_input(points, model.config))
        # Mirrored point by point, so the order of points is the same.
        there, _ = model.extractor(cloud_input(points * [-1.0, 1.0, 1.0], model.config))
    order = np.lexsort(points.T[::-1])  # sample() sorts its points
    mirrored = np.lexsort((points * [-1.0, 1.0, 1.0]).T[::-1])
    difference = here[0, np.argsort(order)] - there[0, np.argsort(mirrored)]
    assert difference.abs().max() > 1e-3


def test_a_filled_up_batch_gives_what_each_pair_gives_alone():
    model = build(uncertainty_scheme="predicted")  # without random draws
    torch.nn.init.normal_(model.hypothesis.weight, std=0.1)
    pairs = [
        tuple(cloud_input(bumpy_points(count, count), model.config) for count in counts)
        for counts in ((120, 90), (70, 130))
    ]
    source, target = (stack_clouds(clouds) for clouds in zip(*pairs, strict=True))
    assert source.valid.sum(dim=1).tolist() == [120, 70] and target.valid.sum(dim=1).tolist() == [90, 130]
    for cloud in (source, target):  # whatever stands in the filling rows
        cloud.points[~cloud.valid], cloud.normals[~cloud.valid] = 0.1, 7.0
        cloud.neighbours[~cloud.valid] = 3
    gt = torch.eye(4).expand(2, 4, 4)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        both = model(source, target, generator=generator, hypothesis=gt)
        for number, (first, second) in enumerate(pairs):
            alone = model(first, second, generator=generator, hypothesis=gt[:1])
            n, m = first.points.shape[1], second.points.shape[1]
            for name, count in (("source", n), ("target", m)):
                for what in ("uncertainty", "overlap_logits"):
                    filled = getattr(both, f"{name}_{what}")[number, :count]
                    expected = getattr(alone, f"{name}_{what}")[0]
                    torch.testing.assert_close(filled, expected, atol=1e-4, rtol=1e-4)
            for what in ("coarse_scores", "matching_scores"):
                filled, expected = getattr(both, what)[number], getattr(alone, what)[0]
                torch.testing.assert_close(filled[:n, :m], expected[:n, :m], atol=1e-5, rtol=1e-4)
                torch.testing.assert_close(filled[:n, -1], expected[:n, -1], atol=1e-5, rtol=1e-4)
                torch.testing.assert_close(filled[-1, :m], expected[-1, :m], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("scheme", ["sampled", "matched"])
def test_the_same_generator_gives_the_same_numbers_and_another_only_where_samples_count(scheme):
    model = build(uncertainty_scheme=scheme)
    source, target = (cloud_input(bumpy_points(100, seed), model.config) for seed in (0, 1))
    with torch.no_grad():
        runs = [
            model(source, target, generator=torch.Generator().manual_seed(seed)).source_uncertainty
            for seed in (3, 3, 4)
        ]
    assert torch.equal(runs[0], runs[1])
    assert torch.equal(runs[0], runs[2]) == (scheme == "matched")


def test_random_masking_hides_features_only_when_asked_for():
    model = build()
    source, target = (cloud_input(bumpy_points(100, seed), model.config) for seed in (0, 1))

    def scores(masking: bool) -> torch.Tensor:
        with torch.no_grad():
            return model(
                source, target, generator=torch.Generator().manual_seed(2), masking=masking
            ).matching_scores

    assert torch.equal(scores(False), scores(False))
    assert not torch.equal(scores(False), scores(True))
