"""One small interface for everything that is measured, and `utopic` itself behind it."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from utopic_cli.config import AlignOptions
from utopic_cli.estimation.refinement import refine
from utopic_cli.estimation.surface import point_spacing
from utopic_cli.geometry.rigid import nearest_rotation, rigid
from utopic_cli.io.scan import Scan
from utopic_cli.io.transformation import read_transformation
from utopic_cli.point_cloud import PointCloud

IDENTITY = "identity"
"""Value of the setting ``start`` of a method that starts from where the scans lie."""

LOCAL_REACH = (10.0, 3.0, 1.0)
"""Reach of the rounds of such methods, in voxels: 20, 6 and 2 % of the extent of dense scans."""

NOTHING_NEAR = "no correspondence within reach of where the scans lie"


@dataclass(frozen=True)
class Trial:
    """One pair in one start pose.

    Attributes:
        source: the scan that moves, already in its start pose.
        target: the scan that stays.
        extent: the pair's extent in the points' units, the same in every start pose, for
            methods that must be told a length.
        seed: seed of the method's own random draws.
        start: (4, 4) what brought the source from its file into the start pose.
        source_scan: the file the source was read from; None of scans that were simulated.
        target_scan: the file the target was read from; None likewise.
    """

    source: PointCloud
    target: PointCloud
    extent: float
    seed: int
    start: np.ndarray = field(default_factory=lambda: np.eye(4))
    source_scan: Scan | None = None
    target_scan: Scan | None = None

    def voxel(self, voxels_per_extent: float, spacings_per_voxel: float) -> float:
        """Return the length a method that asks for one is given.

        It is the extent divided by the first number, but at least the second times the spacing of the
        sparser scan's points: below that there is nothing to see.
        """
        spacing = max(point_spacing(cloud.points) for cloud in (self.source, self.target))
        return max(self.extent / voxels_per_extent, spacings_per_voxel * spacing)


class Method(Protocol):
    """Anything that can be measured."""

    @property
    def name(self) -> str:
        """What the tables call it."""
        ...

    @property
    def refines(self) -> bool:
        """Whether it ends with `utopic_cli.estimation.refinement.refine` by itself."""
        ...

    def settings(self) -> dict[str, Any]:
        """Return everything needed to repeat it, JSON-ready; called once, before any trial.

        Raises:
            UtopicError: it can't run here at all, which is no failure on a pair.
        """
        ...

    def estimate(self, trial: Trial) -> np.ndarray:
        """Return T_target_source, (4, 4) float64; any exception is a failure on this trial."""
        ...


def checked(transformation: np.ndarray) -> np.ndarray:
    """Return a method's estimate with its rotation made exact, (4, 4) float64.

    Raises:
        ValueError: it is no finite (4, 4) matrix.
    """
    if np.shape(transformation) != (4, 4) or not np.isfinite(transformation).all():
        raise ValueError("the estimate is no finite 4x4 matrix")
    return rigid(nearest_rotation(transformation[:3, :3]), transformation[:3, 3])


def refined(trial: Trial, estimate: np.ndarray) -> np.ndarray:
    """Give an estimate the refinement at full resolution that ``utopic`` ends with, (4, 4)."""
    return refine(trial.source, trial.target, estimate).T_target_source


def remarks(methods: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Say what must be known of methods to read their figures.

    Args:
        methods: settings by name, as a report has them.
    """
    local = [name for name, settings in methods.items() if settings.get("start") == IDENTITY]
    if not local:
        return []
    return [f"{', '.join(local)}: local; started from the identity, that is where the scans lie"]


@dataclass(frozen=True)
class Utopic:
    """`utopic_cli.pipeline.register` called in this process.

    Attributes:
        options: the pipeline's options.
    """

    options: AlignOptions
    name: str = "utopic"
    refines: bool = True

    def settings(self) -> dict[str, Any]:
        """Return the options and the weights' name and hash (see `Method.settings`)."""
        return {**asdict(self.options), **_weights(self.options), "how": "in process"}

    def estimate(self, trial: Trial) -> np.ndarray:
        """Register the clouds of a trial."""
        from utopic_cli.pipeline import register

        return register(trial.source, trial.target, self.options).T_target_source


@dataclass(frozen=True)
class UtopicCommand:
    """``utopic align`` on files, each time in a process of its own, as a user runs it.

    The moved source is written in its own format, so the file's rounding is part of the
    measurement, and so are the start of Python and the reading of both files part of the time.

    Attributes:
        options: passed on the command line.
    """

    options: AlignOptions
    name: str = "utopic"
    refines: bool = True

    def settings(self) -> dict[str, Any]:
        """Return the options and the weights' name and hash (see `Method.settings`)."""
        command = ["utopic", "align", "SOURCE", "TARGET", "-o", "T.txt", *self._flags()]
        return {**asdict(self.options), **_weights(self.options), "how": " ".join(command)}

    def estimate(self, trial: Trial) -> np.ndarray:
        """Run the command on a trial.

        Raises:
            RuntimeError: it ended with another exit code than 0; carries the last line it wrote.
            ValueError: the trial has no files.
        """
        if trial.source_scan is None or trial.target_scan is None:
            raise ValueError("there are no files to run the command on")
        with tempfile.TemporaryDirectory(prefix="utopic-bench-") as folder:
            source = Path(folder, f"source{trial.source_scan.path.suffix}")
            source.write_bytes(trial.source_scan.moved(trial.start))
            output = Path(folder, "T.txt")
            files = [str(source), str(trial.target_scan.path.resolve()), "-o", str(output)]
            command = [sys.executable, "-m", "utopic_cli", "align", *files, *self._flags()]
            done = subprocess.run(command, cwd=folder, env=_environment(), capture_output=True, text=True)
            if done.returncode != 0:
                said = [line.strip() for line in done.stderr.splitlines() if any(map(str.isalnum, line))]
                last = said[-1] if said else "no message"
                raise RuntimeError(f"exit code {done.returncode}: {last}")
            return read_transformation(output)

    def _flags(self) -> list[str]:
        options = self.options
        weights = options.weights if not Path(options.weights).is_file() else Path(options.weights).resolve()
        return [
            *("--weights", str(weights)),
            *("--points", str(options.points)),
            "--refine" if options.refine else "--no-refine",
            *("--solver", options.solver),
            *("--max-rotation", str(options.max_rotation)),
            *("--device", options.device),
            *("--threads", str(options.threads)),
            *("--seed", str(options.seed)),
            *("--exit-zero", "-q"),
        ]


def _weights(options: AlignOptions) -> dict[str, Any]:
    """Load the weights once, so that a missing file ends the run instead of failing every pair."""
    from utopic_cli.model.weights import load_weights

    card = load_weights(options.weights)[1]
    return {"weights_name": card["name"], "weights_sha256": card["sha256"]}


def _environment() -> dict[str, str]:
    """Let the child process import this very package, installed or not."""
    package = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}
