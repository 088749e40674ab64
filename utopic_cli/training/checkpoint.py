"""Checkpoints: the whole state of a run in one file, replaced atomically."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.output import write_atomically


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint so that a kill or a full disk leaves the old one intact.

    Raises:
        OutputError: the folder can't be written or has no space.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    try:
        write_atomically(path, buffer.getvalue(), overwrite=True)
    except OutputError as error:
        if not path.is_file():
            raise
        raise OutputError(f"{error}, then go on with --resume: the checkpoint before is intact") from None


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint (tensors and plain data only).

    Raises:
        InputError: there is none, or it is damaged.
    """
    if not path.is_file():
        raise InputError(f"{path}: no checkpoint to resume from; run without --resume to start")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        raise InputError(f"{path}: not a readable checkpoint ({type(error).__name__})") from error
    if not isinstance(state, dict) or "model" not in state:
        raise InputError(f"{path}: not a checkpoint of a training run")
    return state


def describe_difference(old: Mapping[str, Any], new: Mapping[str, Any], most: int = 3) -> str:
    """Say how two sets of settings or of tensors differ, in one line.

    Args:
        old: settings by section, or tensors by name (``state_dict``).
        new: the same of what is to go on from them. Tensors are compared by shape only.
        most: how many differences to spell out.

    Returns:
        Such as ``model.layers: 2, now 3; schedule.clip: 1.0, now absent; and 4 more``; empty if they
        agree.
    """
    found = list(_differences(old, new, ""))
    rest = [f"and {len(found) - most} more"] if len(found) > most else []
    return "; ".join(found[:most] + rest)


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], section: str) -> Iterator[str]:
    for name in dict.fromkeys([*old, *new]):
        before, after = old.get(name), new.get(name)
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            yield from _differences(before, after, f"{section}{name}.")
            continue
        said = [_said(values, name) for values in (old, new)]
        if said[0] != said[1]:
            yield f"{section}{name}: {said[0]}, now {said[1]}"


def _said(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "absent"
    value = values[name]
    if isinstance(value, torch.Tensor):
        return "x".join(map(str, value.shape)) or "one number"
    if isinstance(value, Mapping):
        return "a section"
    return str(list(value) if isinstance(value, tuple) else value)
