"""The verifier: a set of points in, one log-odds out."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from tests.model.conftest import SMALL
from utopic_cli.config import ModelConfig
from utopic_cli.errors import InputError
from utopic_cli.model.pose_verifier import MEETING_REACH, PoseVerifier, meeting
from utopic_cli.model.utopic import Utopic
from utopic_cli.model.weights import load_weights, pack_weights


@pytest.fixture
def verifier() -> PoseVerifier:
    torch.manual_seed(0)
    return PoseVerifier(6, 3, 8).eval()


def test_the_order_of_the_points_does_not_matter(verifier):
    points, whole = torch.randn(2, 20, 6), torch.randn(2, 3)
    again = verifier(points[:, torch.randperm(20)], whole)
    torch.testing.assert_close(again, verifier(points, whole))
    assert again.shape == (2,)


def test_features_are_brought_to_one_scale_and_cut_off(verifier):
    points, whole = torch.randn(50, 20, 6), torch.randn(50, 3)
    before = verifier(points, whole)
    stretch, shift = torch.tensor([1e3, 1.0, 1e-2, 5.0, 2.0, 7.0]), torch.arange(6.0)
    verifier.normalise(points, whole)
    plain = verifier(points, whole)
    verifier.normalise(points * stretch + shift, whole)
    # Less the thousandth that keeps a constant feature from being divided by nothing.
    torch.testing.assert_close(verifier(points * stretch + shift, whole), plain, atol=0.1, rtol=0.1)
    assert not torch.allclose(plain, before)
    far = points.clone()
    far[:, 0] = 1e12
    assert torch.isfinite(verifier(far, whole)).all()


def test_the_other_scan_is_met_within_its_reach():
    met = meeting(MEETING_REACH * np.array([0.0, 0.5, 1.0, 2.0, np.inf]))
    np.testing.assert_allclose(met, [1.0, 64.0 / 65.0, 0.5, 1.0 / 65.0, 0.0])


def test_a_verifier_is_kept_with_the_weights(tmp_path, verifier):
    model = Utopic(ModelConfig(**SMALL))
    model.verifier = verifier
    verifier.overlap.copy_(torch.tensor([2.0, -0.5, 0.25]))
    blob, card = pack_weights(model, {"verifier": {"pairs": 7}})
    path = tmp_path / "tiny.safetensors"
    path.write_bytes(blob)
    path.with_suffix(".json").write_bytes(card)
    loaded, described = load_weights(str(path))
    assert described["verifier"] == {"pairs": 7, "sizes": verifier.sizes}
    assert loaded.verifier is not None and not loaded.verifier.training
    assert loaded.verifier.overlap.tolist() == [2.0, -0.5, 0.25]
    points, whole = torch.randn(2, 20, 6), torch.randn(2, 3)
    torch.testing.assert_close(loaded.verifier(points, whole), verifier(points, whole), atol=1e-2, rtol=1e-2)
    described = json.loads(path.with_suffix(".json").read_text())
    del described["verifier"]["sizes"]["width"]
    path.with_suffix(".json").write_text(json.dumps(described))
    with pytest.raises(InputError, match=r"tiny.json: the verifier's sizes can't be read"):
        load_weights(str(path))
    del described["verifier"]
    path.with_suffix(".json").write_text(json.dumps(described))
    with pytest.raises(InputError, match="not weights of the architecture"):
        load_weights(str(path))
