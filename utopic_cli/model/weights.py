"""Weights on disk: float16 safetensors and a JSON card beside it; no pickle is ever read."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from utopic_cli.config import ModelConfig, from_dict, to_dict
from utopic_cli.errors import InputError
from utopic_cli.model.bundled import bundled_weights
from utopic_cli.model.pose_verifier import PoseVerifier
from utopic_cli.model.utopic import Utopic


def find_weights(name_or_path: str) -> Path:
    """Resolve a bundled name or a path.

    Raises:
        InputError: there is no such file or name; the bundled names are listed.
    """
    path = Path(name_or_path)
    if path.suffix == ".safetensors":
        if not path.is_file():
            raise InputError(f"{path}: no such weights file")
        return path
    if path.is_file():
        raise InputError(f"{path}: not a .safetensors file; weights are a .safetensors file with its card")
    bundled = bundled_weights()
    if name_or_path not in bundled:
        names = ", ".join(sorted(bundled)) or "none in this installation"
        raise InputError(f"{name_or_path}: no bundled weights of that name (bundled: {names})")
    return bundled[name_or_path]


def read_card(path: Path) -> dict[str, Any]:
    """Read the JSON card beside a weights file.

    Raises:
        InputError: the card is missing or is no JSON object with a ``model`` section.
    """
    card_path = path.with_suffix(".json")
    try:
        card = json.loads(card_path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{card_path}: the weights' card can't be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{card_path}: not valid JSON ({error})") from error
    if not isinstance(card, dict) or not isinstance(card.get("model"), dict):
        raise InputError(f"{card_path}: not a weights card (no 'model' section)")
    return card


VERIFIER = "verifier."
"""What the names of the verifier's tensors begin with."""


def load_weights(name_or_path: str, *, verifier: bool = True) -> tuple[Utopic, dict[str, Any]]:
    """Build a trained network for inference on the CPU, in float32.

    Args:
        name_or_path: a bundled name, or a ``.safetensors`` file with its card beside it.
        verifier: whether to load the verifier as well, if there is one; it may be of another version.

    Returns:
        The network in evaluation mode, and its card with ``name`` and ``sha256`` filled in.

    Raises:
        InputError: the file or card is missing, damaged, of another architecture, or not the
            file the card describes.
    """
    path = find_weights(name_or_path)
    card = read_card(path)
    blob = path.read_bytes()
    digest = hashlib.sha256(blob).hexdigest()
    if card.get("sha256", digest) != digest:
        raise InputError(f"{path}: the file differs from the one its card describes (sha256 {digest[:12]})")
    model = Utopic(from_dict(ModelConfig, card["model"], str(path.with_suffix(".json"))))
    model.verifier = _verifier(card, path) if verifier else None
    try:
        tensors = {name: tensor.float() for name, tensor in load_tensors(blob).items()}
        if not verifier:
            tensors = {name: tensor for name, tensor in tensors.items() if not name.startswith(VERIFIER)}
        elif model.verifier is not None and _other_version(model.verifier, tensors):
            raise InputError(
                f"{path}: its verifier is of another version; teach another: utopic teach {path} --overwrite"
            )
        model.load_state_dict(tensors, strict=True)
    except (SafetensorError, RuntimeError) as error:
        reason = " ".join(str(error).strip().splitlines()[:2])
        raise InputError(f"{path}: not weights of the architecture in its card: {reason}") from error
    return model.eval(), {**card, "name": path.stem, "sha256": digest}


def _verifier(card: dict[str, Any], path: Path) -> PoseVerifier | None:
    """Build the verifier that the card describes, if it has one.

    Raises:
        InputError: its sizes make no sense.
    """
    section = card.get("verifier")
    if section is None:
        return None
    sizes = section.get("sizes") if isinstance(section, dict) else None
    names = ("point_features", "whole_features", "width")
    if not isinstance(sizes, dict) or not all(
        type(sizes.get(name)) is int and sizes[name] > 0 for name in names
    ):
        raise InputError(f"{path.with_suffix('.json')}: the verifier's sizes can't be read")
    return PoseVerifier(*(sizes[name] for name in names))


def _other_version(verifier: PoseVerifier, tensors: dict[str, Tensor]) -> bool:
    """Tell whether a file holds a verifier, but not one that this version builds."""
    held = {name: tensor.shape for name, tensor in tensors.items() if name.startswith(VERIFIER)}
    built = {VERIFIER + name: tensor.shape for name, tensor in verifier.state_dict().items()}
    return bool(held) and held != built


def pack_weights(model: Utopic, card: dict[str, Any]) -> tuple[bytes, bytes]:
    """Return a network as the bytes of its float16 safetensors file and of its JSON card.

    Args:
        model: with its verifier, if it has one.
        card: what there is to say of it; architecture, the verifier's sizes and the hash are added.
    """
    tensors = {
        name: (tensor.half() if tensor.is_floating_point() else tensor).contiguous().cpu()
        for name, tensor in model.state_dict().items()
    }
    blob = save_tensors(tensors)
    full = {**card, "model": to_dict(model.config), "sha256": hashlib.sha256(blob).hexdigest()}
    if model.verifier is not None:
        full["verifier"] = {**card.get("verifier", {}), "sizes": model.verifier.sizes}
    text = json.dumps(full, indent=2, allow_nan=False) + "\n"
    return blob, text.encode("utf-8")


def choose_device(name: str) -> torch.device:
    """Return the device for ``auto``, ``cpu``, ``cuda`` or ``mps``.

    Raises:
        InputError: the device asked for by name is not there.
    """
    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if name == "auto":
        return torch.device("cuda" if available["cuda"] else "cpu")
    if name not in available:
        raise InputError(f"{name}: no such device; choose auto, cpu, cuda or mps")
    if not available[name]:
        raise InputError(f"{name}: this machine has no such device; use --device auto")
    return torch.device(name)
