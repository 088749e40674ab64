from __future__ import annotations

import numpy as np
import torch

from tests.model.conftest import SMALL, bumpy_points
from utopic_cli.bridge import Eye, predict
from utopic_cli.config import ModelConfig
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
