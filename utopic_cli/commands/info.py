"""``utopic info``: versions, devices, weights, optional parts."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from utopic_cli.commands.console import DEFAULTS, Console, Debug

REQUIRED = ("torch", "numpy", "scipy", "safetensors", "trimesh", "typer", "rich")
OPTIONAL = {
    "open3d": "baselines of 'utopic bench'; needs system libraries: "
    "apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1",
    "tensorboard": "curves of 'utopic train'; pip install 'utopic-cli[train]'",
    "h5py": "ModelNet40's files; pip install 'utopic-cli[modelnet]'",
    "kiss-matcher": "a baseline of 'utopic bench'; pip install 'utopic-cli[peers]'",
    "small-gicp": "a baseline of 'utopic bench'; pip install 'utopic-cli[peers]'",
    "distributed": "'utopic batch --cluster'; pip install 'utopic-cli[cluster]'",
    "lazrs": "LAZ files; pip install 'utopic-cli[las]'",
}

VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "CUDA_VISIBLE_DEVICES",
    "NO_COLOR",
    "TERM",
)


def info(
    weights: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[WEIGHTS]...", help="Weights of your own, beside the bundled ones.", show_default=False
        ),
    ] = None,
    json_report: Annotated[bool, typer.Option("--json", help="As JSON on stdout.")] = False,
    debug: Debug = False,
) -> None:
    """Print versions, devices, the bundled weights with their hash, and what optional parts are there.

    Put its output into reports of bugs. With --json, the cards of the weights are whole: what they were
    trained on and how, their calibration.

    Example: [bold]utopic info[/bold], [bold]utopic info runs/mine/utopic.safetensors --json[/bold]
    """
    with Console().progress() as progress:
        progress("loading libraries")
        facts = collect(weights or ())
    if json_report:
        import json

        typer.echo(json.dumps(facts, indent=2, allow_nan=False))
        return
    for section, entries in facts.items():
        typer.echo(section)
        for name, value in entries.items():
            typer.echo(f"  {name:<14} {value if not isinstance(value, dict) else _lines(value)}")
        if not entries:
            typer.echo("  none")


def collect(weights: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Gather what ``info`` prints, as JSON-ready data by section.

    Args:
        weights: files to describe beside the bundled ones.

    Raises:
        InputError: there is no such file.
    """
    import platform

    import torch

    from utopic_cli import __version__

    versions = {"utopic-cli": __version__, "python": platform.python_version()}
    versions["platform"] = platform.platform()
    devices = {"cpu": f"{_counted(_cpus(), 'CPU')}, {_counted(torch.get_num_threads(), 'thread')}"}
    if torch.cuda.is_available():
        devices["cuda"] = f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"
    if torch.backends.mps.is_available():
        devices["mps"] = "available"
    return {
        "versions": versions | {name: _version(name) for name in REQUIRED},
        "devices": devices,
        "environment": _environment(),
        "weights": _weights(weights),
        "optional": {name: _optional(name) for name in OPTIONAL},
    }


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _cpus() -> int:
    """Count the CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _environment() -> dict[str, str]:
    """Return what else changes how the tool behaves."""
    found = {"encoding": f"{sys.stdout.encoding}, files {sys.getfilesystemencoding()}"}
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        found["memory"] = f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    return found | {name: os.environ[name] for name in VARIABLES if name in os.environ}


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _optional(name: str) -> str:
    """Import an optional part to see that it loads: open3d may be installed and still not work."""
    from importlib import import_module

    version = _version(name)
    if version == "not installed":
        return f"{version} ({OPTIONAL[name]})"
    try:
        import_module(name.replace("-", "_"))
    except Exception as error:  # whatever it meets: libraries it lacks, another NumPy
        return f"{version}, can't be loaded: {' '.join(str(error).split())} ({OPTIONAL[name]})"
    return version


def _weights(more: Sequence[str]) -> dict[str, Any]:
    import hashlib

    from utopic_cli.errors import InputError
    from utopic_cli.model.bundled import bundled_weights
    from utopic_cli.model.weights import find_weights, read_card

    # What is used where nothing is said comes first.
    bundled = sorted(bundled_weights().items(), key=lambda one: one[0] != DEFAULTS.weights)
    found: dict[str, Any] = {}
    for name, path in (dict(bundled) | {one: find_weights(one) for one in more}).items():
        facts: dict[str, Any] = {"path": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        try:
            card = read_card(path)
            facts |= {key: value for key, value in card.items() if key not in ("sha256", "name")}
            facts["intact"] = card.get("sha256") == facts["sha256"]
            calibration = card.get("calibration")
            facts["trusted_from"] = (
                "never: not calibrated" if calibration is None else calibration["threshold"]
            )
        except InputError as error:
            facts["card"] = str(error)
        found[name] = facts
    return found


def _lines(facts: dict[str, Any]) -> str:
    """Show what is short; the card's long sections are for --json."""
    short = [_line(key, value) for key, value in facts.items() if not isinstance(value, (dict, list))]
    long = [key for key, value in facts.items() if isinstance(value, (dict, list))]
    return ("\n" + " " * 17).join([*short, *([f"{', '.join(long)}: see --json"] if long else [])])


def _line(key: str, value: Any) -> str:
    if key == "wall_clock_s" and isinstance(value, (int, float)):
        return f"training time: {value / 3600.0:.1f} h"
    return f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}"
