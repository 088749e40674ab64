"""``utopic teach``: options in, completed weights out. The teaching itself is stubbed."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from utopic_cli.estimation.close_up import POINT_FEATURES, WHOLE_FEATURES
from utopic_cli.model.pose_verifier import PoseVerifier
from utopic_cli.model.weights import find_weights, load_weights, pack_weights


@pytest.fixture
def weights(tmp_path):
    """The bundled network without a verifier."""
    model, card = load_weights(str(find_weights("utopic")))
    model.verifier = None
    old = ("name", "sha256", "verifier")
    blob, text = pack_weights(model, {**{k: v for k, v in card.items() if k not in old}, "note": "kept"})
    path = tmp_path / "mine.safetensors"
    path.write_bytes(blob)
    path.with_suffix(".json").write_bytes(text)
    return path


@pytest.fixture
def taught(monkeypatch):
    """Stands in for the teaching; remembers what it was asked for."""
    asked = []
    counts = {"right_proposed": 30, "first_by_surfaces": 20, "first_by_verifier": 28}

    def teach(path, shapes, data, pairs, seed, workers, progress, start=None):
        asked.append((path, data, pairs, seed, workers))
        progress(0, pairs, "poses")
        about = {"pairs": pairs, "poses": 6 * pairs, "out_of_fold": {"a": counts, "b": counts}}
        if start is not None:
            asked[-1] = start
            about["as_it_started"] = {"a": {**counts, "first_by_verifier": 25}, "b": counts}
            about["kept_as_it_started"] = pairs == 40
        return PoseVerifier(POINT_FEATURES, WHOLE_FEATURES, 8), about

    monkeypatch.setattr("utopic_cli.benchmark.teaching.teach", teach)
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress=None: None)
    return asked


def two_scans(folder):
    scan = folder / "a.xyz"
    scan.write_text("\n".join(f"{i % 7} {i % 11} {i % 13}" for i in range(300)))
    return scan, shutil.copy(scan, folder / "b.xyz")


def test_the_weights_get_a_verifier_and_lose_their_calibration(cli, weights, taught):
    before = load_weights(str(weights))[0].state_dict()
    assert json.loads(weights.with_suffix(".json").read_text())["calibration"]
    result = cli("teach", weights, "--data", "shapes", "--pairs", 60, "--seed", 3, "--workers", 2)
    assert result.exit_code == 0, result.stderr
    assert taught == [(str(weights), "shapes", 60, 3, 2)]
    model, card = load_weights(str(weights))
    assert model.verifier is not None and model.verifier.sizes["width"] == 8
    assert card["verifier"]["pairs"] == 60 and card["note"] == "kept"
    assert not {"calibration", "measured"} & set(card)
    after = model.state_dict()
    assert set(before) == {name for name in after if not name.startswith("verifier.")}
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert "of 60 pairs" in result.stderr and "first in 56; the surfaces alone do in 40" in result.stderr
    assert f"utopic calibrate {weights} --data shapes" in result.stderr


def test_a_verifier_is_not_replaced_unasked(cli, weights, taught):
    assert cli("teach", weights).exit_code == 0
    result = cli("teach", weights)
    assert result.exit_code == 5 and "use --overwrite" in result.stderr
    assert len(taught) == 1
    assert cli("teach", weights, "--overwrite").exit_code == 0


def test_a_verifier_may_go_on_from_anothers(cli, weights, taught):
    result = cli("teach", weights, "--pairs", 60, "--start-from", "utopic")
    assert result.exit_code == 0, result.stderr
    model, card = load_weights("utopic")
    for name, value in taught[0].state_dict().items():
        assert torch.equal(value, model.verifier.state_dict()[name]), name
    assert "the verifier it went on from does in 53\n" in result.stderr
    told = json.loads(weights.with_suffix(".json").read_text())["verifier"]
    assert told["before"]["pairs"] == card["verifier"]["pairs"] and told["pairs"] == 60
    result = cli("teach", weights, "--pairs", 40, "--start-from", "utopic", "--overwrite")
    assert "the verifier it went on from does in 53, and is kept as it was\n" in result.stderr


def test_there_has_to_be_a_verifier_to_go_on_from(cli, weights, taught):
    result = cli("teach", weights, "--start-from", weights)
    assert result.exit_code == 4 and "no verifier to go on from" in result.stderr and not taught


def test_a_verifier_of_another_version_is_refused_but_may_be_replaced(cli, tmp_path, weights, taught):
    class Older(PoseVerifier):
        """One that could not read overlap."""

        def __init__(self):
            super().__init__(POINT_FEATURES, WHOLE_FEATURES, 8)
            del self.overlap

    model, card = load_weights(str(weights))
    model.verifier = Older()
    blob, text = pack_weights(model, {k: v for k, v in card.items() if k not in ("name", "sha256")})
    weights.write_bytes(blob)
    weights.with_suffix(".json").write_bytes(text)
    result = cli("info", weights)
    assert result.exit_code == 0
    for refused in (
        ("align", *two_scans(tmp_path), "-o", tmp_path / "T.txt", "--weights", weights),
        ("teach", weights, "--start-from", weights, "--overwrite"),
    ):
        result = cli(*refused)
        assert result.exit_code == 4, result.stderr
        assert "verifier is of another version" in result.stderr and "--overwrite" in result.stderr
        assert len(result.stderr.splitlines()[-1]) < 400
    assert cli("teach", weights, "--overwrite").exit_code == 0
    assert load_weights(str(weights))[0].verifier.sizes["width"] == 8


def test_weights_that_are_not_there_are_an_input_error(cli, tmp_path, taught):
    result = cli("teach", tmp_path / "none.safetensors")
    assert result.exit_code == 4 and "no such weights file" in result.stderr and not taught


def test_a_verifier_for_other_features_is_refused_in_one_line(cli, tmp_path, weights):
    model, card = load_weights(str(weights))
    model.verifier = PoseVerifier(POINT_FEATURES + 1, WHOLE_FEATURES, 8)
    blob, text = pack_weights(model, {k: v for k, v in card.items() if k not in ("name", "sha256")})
    other = tmp_path / "other.safetensors"
    other.write_bytes(blob)
    other.with_suffix(".json").write_bytes(text)
    scan, twin = two_scans(tmp_path)
    result = cli("align", scan, twin, "-o", tmp_path / "T.txt", "--weights", other)
    assert result.exit_code == 4 and "teach another with utopic teach" in result.stderr
