"""``utopic calibrate``: options in, a completed card out. The fit itself is stubbed."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from utopic_cli.estimation.confidence import fit_calibration
from utopic_cli.model.weights import find_weights, load_weights
from utopic_cli.verdict import read_calibration


@pytest.fixture
def weights(tmp_path):
    """A copy of the bundled weights without their calibration."""
    bundled = find_weights("utopic")
    path = tmp_path / "mine.safetensors"
    shutil.copy(bundled, path)
    card = json.loads(bundled.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps({**card, "calibration": None, "note": "kept"}))
    return path


@pytest.fixture
def fitted(monkeypatch):
    """Stands in for the fit; remembers what it was asked for."""
    asked = []
    values = np.linspace(-1, 1, 50)[:, None]
    seen = {"auroc": 0.98, "brier": 0.04, "expected_calibration_error": 0.03}
    about = {"answers": 50, "right": 25, "out_of_fold": seen}
    model = fit_calibration(("margin",), values, values[:, 0] > 0, threshold=0.9, description=about)

    def fit(shapes, data, trials, seed, options, workers, progress):
        asked.append((data, trials, seed, options.weights, workers))
        progress(0, trials, "trials")
        return model

    monkeypatch.setattr("utopic_cli.benchmark.calibration.calibrate", fit)
    monkeypatch.setattr("utopic_cli.synthesis.packing.open_shapes", lambda data, progress=None: None)
    return asked


def test_the_card_is_completed_and_only_what_was_measured_before_goes(cli, weights, fitted):
    before = json.loads(weights.with_suffix(".json").read_text())
    result = cli("calibrate", weights, "--data", "shapes", "--trials", 60, "--seed", 3, "--workers", 2)
    assert result.exit_code == 0
    assert fitted == [("shapes", 60, 3, str(weights), 2)]
    after = json.loads(weights.with_suffix(".json").read_text())
    assert before.pop("measured") and {**after, "calibration": None} == before
    _, card = load_weights(str(weights))
    found = read_calibration(card)
    assert found is not None and found.threshold == 0.9
    assert "AUROC 0.980" in result.stderr and "trusted from a confidence of 90%" in result.stderr


def test_a_calibration_is_not_replaced_unasked(cli, weights, fitted):
    assert cli("calibrate", weights).exit_code == 0
    result = cli("calibrate", weights)
    assert result.exit_code == 5 and "use --overwrite" in result.stderr
    assert len(fitted) == 1
    assert cli("calibrate", weights, "--overwrite").exit_code == 0


def test_weights_that_are_not_there_are_an_input_error(cli, tmp_path, fitted):
    result = cli("calibrate", tmp_path / "none.safetensors")
    assert result.exit_code == 4 and "no such weights file" in result.stderr and not fitted
