"""What a result was measured with."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from utopic_cli import __version__


def versions() -> dict[str, Any]:
    """Return the versions of everything that takes part, and a few words on the machine, JSON-ready."""
    found: dict[str, Any] = {"utopic_cli": __version__, "python": platform.python_version()}
    for package in ("numpy", "scipy", "torch", "open3d"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    found["platform"] = f"{platform.system()} {platform.machine()}"
    found["cpu_count"] = os.cpu_count()
    found["omp_num_threads"] = os.environ.get("OMP_NUM_THREADS")
    return found
