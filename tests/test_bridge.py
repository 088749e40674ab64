from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.distance import cdist

from tests.model.conftest import SMALL, bumpy_points
from utopic_cli.bridge import Eye, predict, weigh
from utopic_cli.config import ModelConfig
from utopic_cli.geometry import rigid
from utopic_cli.model.pose_verifier import MEETING_REACH, PoseVerifier
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


def test_what_is_seen_is_weighed_with_the_odds_of_the_pose() -> None:
    torch.manual_seed(0)
    model = Utopic(ModelConfig(**SMALL)).eval()
    pair = prepare(*(PointCloud(bumpy_points(400, seed)) for seed in (0, 1)), 120)
    T = rigid.rigid(rigid.rotation_from_vector(np.array([0.4, -0.9, 0.3])), np.array([0.2, -0.1, 0.05]))
    first, shown = predict(model, pair, 3), predict(model, pair, 3, T)
    assert first.source_gap is None and first.target_gap is None
    assert weigh(model, first, shown, 2.0) is shown  # nothing has learned to read it

    model.verifier = PoseVerifier(3, 2, 4)
    model.verifier.overlap.copy_(torch.tensor([3.0, -0.5, 0.25]))
    distance = cdist(rigid.apply(T, pair.source.points), pair.target.points) / pair.spacing
    np.testing.assert_allclose(shown.source_gap, distance.min(axis=1))
    np.testing.assert_allclose(shown.target_gap, distance.min(axis=0))
    met = 1.0 / (1.0 + (distance.min(axis=1) / MEETING_REACH) ** 6)
    for odds, right in ((30.0, 1.0), (0.0, 0.5), (-np.log(3.0), 0.25), (-30.0, 0.0)):
        view = weigh(model, first, shown, odds)
        expected = right / (1.0 + np.exp(-(3.0 * met - 0.5))) + (1.0 - right) * 0.25
        np.testing.assert_allclose(view.source_overlap, expected, atol=1e-6)
        raw = [
            right * there + (1.0 - right) * before
            for there, before in ((shown.source_raw, first.source_raw), (shown.target_raw, first.target_raw))
        ]
        np.testing.assert_allclose(view.source_raw, raw[0], rtol=1e-6)
        both = np.concatenate(raw)
        np.testing.assert_allclose(view.target_uncertainty, (raw[1] - both.min()) / np.ptp(both), atol=1e-6)
        np.testing.assert_array_equal(view.matching_scores, shown.matching_scores)
    np.testing.assert_allclose(view.target_overlap, 0.25, atol=1e-6)
