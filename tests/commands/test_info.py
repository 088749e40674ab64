from __future__ import annotations

import hashlib
import json
import re
import sys
from pathlib import Path

import utopic_cli
from utopic_cli.commands import info
from utopic_cli.model.bundled import bundled_weights

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


def test_info_says_versions_devices_and_the_weights_hash(cli, monkeypatch):
    monkeypatch.setattr(info, "OPTIONAL", {})  # importing open3d takes seconds
    result = cli("info", "--json")
    assert result.exit_code == 0
    facts = json.loads(result.stdout)
    assert facts["versions"]["utopic-cli"] == utopic_cli.__version__
    assert facts["versions"]["torch"][0].isdigit()
    assert "cpu" in facts["devices"]
    assert facts["weights"]
    for name, path in bundled_weights().items():
        assert facts["weights"][name]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert facts["weights"][name]["intact"] is True
    text = cli("info").stdout
    assert text.startswith("versions")
    assert all(entry["sha256"] in text for entry in facts["weights"].values())


def test_a_damaged_weights_file_is_called_so(cli, monkeypatch, tmp_path):
    (tmp_path / "broken.safetensors").write_bytes(b"not what the card says")
    (tmp_path / "broken.json").write_text(json.dumps({"model": {}, "sha256": "0" * 64}))
    (tmp_path / "lonely.safetensors").write_bytes(b"without a card")
    found = {name: tmp_path / f"{name}.safetensors" for name in ("broken", "lonely")}
    monkeypatch.setattr("utopic_cli.model.bundled.bundled_weights", lambda: found)
    monkeypatch.setattr(info, "OPTIONAL", {})
    weights = json.loads(cli("info", "--json").stdout)["weights"]
    assert weights["broken"]["intact"] is False
    assert "lonely.json" in weights["lonely"]["card"]


def test_weights_of_ones_own_are_described_beside_the_bundled_ones(cli, monkeypatch, tmp_path):
    monkeypatch.setattr(info, "OPTIONAL", {})
    bundled = bundled_weights()["utopic"]
    for suffix in (".safetensors", ".json"):
        (tmp_path / f"mine{suffix}").write_bytes(bundled.with_suffix(suffix).read_bytes())
    mine = str(tmp_path / "mine.safetensors")
    weights = json.loads(cli("info", mine, "--json").stdout)["weights"]
    assert list(weights) == ["utopic", mine]
    assert weights[mine]["intact"] is True and weights[mine]["pairs_seen"] == weights["utopic"]["pairs_seen"]
    missing = cli("info", str(tmp_path / "none.safetensors"))
    assert missing.exit_code == 4 and "none.safetensors: no such weights file" in missing.stderr


def test_an_optional_part_that_is_missing_or_broken_says_what_to_do(monkeypatch):
    def broken(name):
        raise OSError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(info, "_version", lambda name: "1.0")
    monkeypatch.setattr("importlib.import_module", broken)
    assert "libusb-1.0.so.0" in info._optional("open3d")
    assert "apt-get install" in info._optional("open3d")
    monkeypatch.setattr(info, "_version", lambda name: "not installed")
    assert "pip install" in info._optional("tensorboard")


def test_every_extra_is_named_with_the_command_that_installs_it():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for extra, packages in project["optional-dependencies"].items():
        for package in packages if extra != "dev" else ():
            name = re.split(r"[^\w-]", package)[0]
            assert f"utopic-cli[{extra}]" in info.OPTIONAL[name]


def test_the_environment_that_matters_is_shown(cli, monkeypatch):
    monkeypatch.setattr(info, "OPTIONAL", {})
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    facts = json.loads(cli("info", "--json").stdout)
    assert facts["environment"]["OMP_NUM_THREADS"] == "1"
    assert "CPUs" in facts["devices"]["cpu"]


def test_numbers_are_for_reading():
    from utopic_cli.commands.info import _counted, _line

    assert (_counted(1, "thread"), _counted(2, "CPU")) == ("1 thread", "2 CPUs")
    assert _line("wall_clock_s", 12372.8) == "training time: 3.4 h"
    assert _line("trusted_from", 0.9228266292248096) == "trusted_from: 0.9228"
