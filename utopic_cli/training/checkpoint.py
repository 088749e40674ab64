"""Checkpoints: the whole state of a run in one file, replaced atomically."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch

from utopic_cli.errors import InputError
from utopic_cli.io.output import write_atomically


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint so that a kill or a full disk leaves the old one intact.

    Raises:
        OutputError: the folder can't be written or has no space.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue(), overwrite=True)


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
