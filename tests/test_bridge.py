from __future__ import annotations

import numpy as np
import torch

from tests.model.conftest import SMALL, bumpy_points
from utopic_cli.bridge import Eye, predict, read_overlap
from utopic_cli.config import ModelConfig
from utopic_cli.model.pose_verifier import PoseVerifier
from utopic_cli.model.utopic import Utopic
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import prepare


def test_looking_again_finds_a_cloud_once_and_sees_the_same(monkeypatch) -> None:
    torch.manual_seed(0)
    model = Utopic(ModelConfig(**SMALL)).eval()
    pair = prepare(*(PointCloud(bumpy_points(400, seed)) for seed in (0, 1)), 120)
    expected = predict(model, pair, 3), predict(model, pair, 3, np.eye(4))

    encoded = []
    encode = model.encode
    monkeypatch.setattr(model, "encode", lambda cloud: encoded.append(cloud) or encode(cloud))
    eye = Eye(model, 3)
    for view, plain in zip((eye(pair), eye(pair, np.eye(4))), expected, strict=True):
        for name, values in vars(plain).items():
            np.testing.assert_array_equal(getattr(view, name), values)
    assert len(encoded) == 2


def test_overlap_is_weighed_with_the_odds_of_the_pose() -> None:
    torch.manual_seed(0)
    model = Utopic(ModelConfig(**SMALL)).eval()
    pair = prepare(*(PointCloud(bumpy_points(400, seed)) for seed in (0, 1)), 120)
    plain = predict(model, pair, 3, np.eye(4))
    assert read_overlap(model, plain, 2.0) is plain  # nothing has learned to read it

    model.verifier = PoseVerifier(3, 2, 4)
    model.verifier.reading.copy_(torch.tensor([1.5, -0.5, 0.25]))
    np.testing.assert_array_equal(predict(model, pair, 3, np.eye(4)).source_overlap, plain.source_overlap)
    odds = np.log(plain.source_overlap / (1.0 - plain.source_overlap))
    for plausibility, right in ((30.0, 1.0), (0.0, 0.5), (-np.log(3.0), 0.25), (-30.0, 0.0)):
        read = read_overlap(model, plain, plausibility)
        expected = right / (1.0 + np.exp(-(1.5 * odds - 0.5))) + (1.0 - right) * 0.25
        np.testing.assert_allclose(read.source_overlap, expected, atol=1e-5)
        np.testing.assert_array_equal(read.source_raw, plain.source_raw)
    np.testing.assert_allclose(read.target_overlap, 0.25, atol=1e-5)
