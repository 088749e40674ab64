"""Where the bundled weights are; without torch, so that a shell can complete their names at once."""

from __future__ import annotations

from pathlib import Path


def weights_folders() -> tuple[Path, Path]:
    """Where bundled weights can be: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    return package / "_weights", package.parent / "weights"


def bundled_weights() -> dict[str, Path]:
    """Return the bundled weights files by name."""
    found: dict[str, Path] = {}
    for folder in reversed(weights_folders()):
        found.update({path.stem: path for path in sorted(folder.glob("*.safetensors"))})
    return found
