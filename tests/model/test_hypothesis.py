"""The second look: evidence of a transformation under test."""

from __future__ import annotations

import numpy as np
import torch

from tests.model.conftest import SMALL, bumpy_points, cloud_input
from utopic_cli.config import ModelConfig
from utopic_cli.geometry import rigid
from utopic_cli.model.hypothesis import hypothesis_features, inverse
from utopic_cli.model.utopic import Utopic

CONFIG = ModelConfig(**SMALL)


def as_tensor(transformation: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(transformation.astype(np.float32))[None]


def test_a_right_hypothesis_finds_every_point_near_and_a_wrong_one_does_not(pose):
    points = bumpy_points(400, 0)
    source = cloud_input(rigid.apply(rigid.invert(pose), points), CONFIG)
    target = cloud_input(points, CONFIG)
    right = hypothesis_features(source, target, as_tensor(pose), torch.ones(1))[0]
    torch.testing.assert_close(right[:, :3], torch.ones(400, 3), atol=1e-3, rtol=0)
    far = rigid.rigid(np.eye(3), [9.0, 0, 0]) @ pose
    wrong = hypothesis_features(source, target, as_tensor(far), torch.ones(1))[0]
    assert wrong[:, :3].max() < 1e-3
    assert (right[:, 8] == 1).all()  # there is a hypothesis, right or wrong


def test_no_hypothesis_is_all_zero_and_changes_nothing(pose):
    torch.manual_seed(0)
    model = Utopic(CONFIG).eval()
    torch.nn.init.normal_(model.hypothesis.weight)
    source, target = (cloud_input(bumpy_points(100, seed), CONFIG) for seed in (0, 1))
    assert not hypothesis_features(source, target, as_tensor(pose), torch.zeros(1)).any()

    def overlap(**hypothesis) -> torch.Tensor:
        with torch.no_grad():
            return model(
                source, target, generator=torch.Generator().manual_seed(0), **hypothesis
            ).source_overlap

    none = overlap()
    absent = overlap(hypothesis=as_tensor(pose), hypothesis_present=torch.zeros(1))
    torch.testing.assert_close(none, absent)
    assert not torch.allclose(none, overlap(hypothesis=as_tensor(np.eye(4))))


def test_the_inverse_is_the_inverse(pose):
    torch.testing.assert_close(
        inverse(as_tensor(pose)) @ as_tensor(pose), torch.eye(4)[None], atol=1e-5, rtol=0
    )
