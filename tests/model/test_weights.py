"""Weights on disk: what is saved is what is loaded, and nothing else passes."""

from __future__ import annotations

import json

import pytest
import torch

from tests.model.conftest import SMALL
from utopic_cli.config import ModelConfig
from utopic_cli.errors import InputError
from utopic_cli.model.bundled import bundled_weights
from utopic_cli.model.utopic import Utopic
from utopic_cli.model.weights import choose_device, find_weights, load_weights, pack_weights


@pytest.fixture
def saved(tmp_path):
    model = Utopic(ModelConfig(**SMALL))
    blob, card = pack_weights(model, {"pairs_seen": 3})
    path = tmp_path / "tiny.safetensors"
    path.write_bytes(blob)
    path.with_suffix(".json").write_bytes(card)
    return path, model


def test_what_is_saved_is_what_is_loaded_to_half_precision(saved):
    path, model = saved
    loaded, card = load_weights(str(path))
    assert not loaded.training
    assert card["pairs_seen"] == 3 and card["name"] == "tiny" and len(card["sha256"]) == 64
    for name, value in model.state_dict().items():
        torch.testing.assert_close(loaded.state_dict()[name], value.half().float())


def test_a_changed_file_is_refused(saved):
    path, _ = saved
    blob = bytearray(path.read_bytes())
    blob[-1] ^= 1
    path.write_bytes(blob)
    with pytest.raises(InputError, match="differs from the one its card describes"):
        load_weights(str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda card: card["model"].update(chanels=[1]), "unknown key chanels; known keys: .*channels"),
        (lambda card: card["model"].update(heads="two"), "heads is 'two'; expected int"),
        (lambda card: card["model"].update(feature_width=32), "not weights of the architecture"),
        (lambda card: card.pop("model"), "no 'model' section"),
    ],
    ids=["unknown key", "wrong type", "other width", "no model"],
)
def test_a_card_that_does_not_fit_is_refused(saved, change, message):
    path, _ = saved
    card = json.loads(path.with_suffix(".json").read_text())
    change(card)
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(InputError, match=message):
        load_weights(str(path))


def test_a_missing_card_file_or_name_is_named(saved, tmp_path):
    path, _ = saved
    path.with_suffix(".json").unlink()
    with pytest.raises(InputError, match=r"tiny\.json: the weights' card can't be read"):
        load_weights(str(path))
    with pytest.raises(InputError, match="no such weights file"):
        load_weights(str(tmp_path / "absent.safetensors"))
    with pytest.raises(InputError, match="no bundled weights of that name"):
        find_weights("absent")


@pytest.mark.parametrize("name", sorted(bundled_weights()))
def test_bundled_weights_say_what_they_are_for_and_where_they_come_from(name):
    model, card = load_weights(name)
    assert card["name"] == name and card["licence"] == "Apache-2.0" and card["purpose"]
    assert card["pairs_seen"] == sum(run["pairs"] for run in card["runs"])
    assert card["data"]["shapes"] == 2910 and 0 < card["validation"]["hit_rate"] < 1
    assert all({"seed", "joint_pairs"} <= set(run["training"]["schedule"]) for run in card["runs"])
    assert find_weights(name).stat().st_size < 20e6
    assert ("calibration" in card) == (name == "utopic")
    asked = {one["command"].split()[2] for one in card["measured"] if one["result"]}
    assert {"range-scans", "modelnet", "modelonet", "confidence"} <= asked
    assert model.verifier is not None


def test_devices_are_checked():
    assert choose_device("cpu").type == "cpu"
    with pytest.raises(InputError, match="no such device"):
        choose_device("tpu")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positional_scheme": "geometrc"}, "choose vanilla, absolute, learned, geometric"),
        ({"normalisation": "bach"}, "choose layer, batch"),
        ({"heads": 3}, "transformer_width 16 is no multiple of heads 3"),
        ({"neighbours": 40}, "choose 2 to 20"),
        ({"layers": 0}, "layers is 0; it must be at least 1"),
    ],
    ids=str,
)
def test_an_architecture_that_cannot_be_built_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        ModelConfig(**{**SMALL, **change})
