"""Checkpoints: the old one survives whatever happens to the new one."""

from __future__ import annotations

import errno
import os

import pytest
import torch

from utopic_cli.errors import OutputError
from utopic_cli.training.checkpoint import describe_difference, read_checkpoint, write_checkpoint


def state(pairs):
    return {"model": {"weight": torch.full((3,), float(pairs))}, "pairs": pairs}


def test_what_is_written_is_read(tmp_path):
    write_checkpoint(tmp_path / "checkpoint.pt", state(7))
    found = read_checkpoint(tmp_path / "checkpoint.pt")
    assert found["pairs"] == 7 and torch.equal(found["model"]["weight"], torch.full((3,), 7.0))


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_without_space_the_old_one_is_intact(tmp_path, monkeypatch, function):
    path = tmp_path / "checkpoint.pt"
    write_checkpoint(path, state(1))
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, function, full)
        with pytest.raises(OutputError, match=r"the disk is full.*--resume: the checkpoint before is intact"):
            write_checkpoint(path, state(2))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_without_space_for_the_first_none_is_promised(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"free some space$"):
        write_checkpoint(tmp_path / "checkpoint.pt", state(1))
    assert not list(tmp_path.iterdir())


def test_differences_of_settings_are_named():
    old = {"model": {"layers": 2, "channels": [32, 64]}, "schedule": {"clip": 1.0, "seed": 1}}
    new = {"model": {"layers": 3, "channels": (32, 64), "width": 8}, "schedule": {"seed": 1}}
    assert describe_difference(old, old) == ""
    assert describe_difference(old, new) == (
        "model.layers: 2, now 3; model.width: absent, now 8; schedule.clip: 1.0, now absent"
    )
    assert describe_difference(old, new, most=1) == "model.layers: 2, now 3; and 2 more"
    assert describe_difference({}, {"pairs": {"noise": 1}}) == "pairs: absent, now a section"


def test_differences_of_tensors_are_their_shapes():
    old = {"a.weight": torch.zeros(4, 2), "gain": torch.tensor(1.0), "gone": torch.zeros(3)}
    new = {"a.weight": torch.zeros(4, 3), "gain": torch.tensor(2.0)}
    assert describe_difference(old, new) == "a.weight: 4x2, now 4x3; gone: 3, now absent"
