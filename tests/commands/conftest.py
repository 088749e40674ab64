"""A pipeline that answers at once, so that these tests are about the command line only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from utopic_cli.cli import app
from utopic_cli.config import to_dict
from utopic_cli.result import Correspondences, FitMeasures, FreeMotion, Observability, RegistrationResult

# A quarter turn about z and a shift: every product below is exact in float64.
QUARTER_TURN = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


@dataclass
class FakePipeline:
    """Stands in for ``pipeline.register``: remembers its calls and returns what the test wants."""

    changes: dict[str, Any] = field(default_factory=dict)
    raises: BaseException | None = None
    calls: list[dict[str, Any]] = field(default_factory=list)

    def register(self, source: Any, target: Any, options: Any, *, initial: Any = None, progress: Any = None):
        self.calls.append({"source": source, "target": target, "options": options, "initial": initial})
        if progress is not None:
            progress("matching")
        if self.raises is not None:
            raise self.raises
        ramps = [np.linspace(0, 1, len(cloud), dtype=np.float32) for cloud in (source, target)]
        result = RegistrationResult(
            T_target_source=QUARTER_TURN,
            confidence=0.97,
            trusted=True,
            reasons=("the surfaces agree",),
            ambiguous_with=(),
            source_overlap=ramps[0],
            target_overlap=ramps[1],
            source_uncertainty=ramps[0][::-1],
            target_uncertainty=ramps[1][::-1],
            raw_uncertainty={"source_mean": 0.01, "target_mean": 0.02, "p50": 0.01, "p90": 0.05},
            correspondences=Correspondences(np.arange(5), np.arange(5), np.ones(5)),
            fit=FitMeasures(
                overlap_ratio={"source": 0.75, "target": 0.5},
                inlier_ratio=0.9,
                inlier_rmse=0.01,
                residual_percentiles={"p50": 0.01, "p75": 0.02, "p90": 0.03, "p95": 0.04},
                threshold=0.05,
            ),
            observability=Observability(
                eigenvalues=np.linspace(0.0, 1.0, 6),
                free=(FreeMotion("rotation", np.array([0.0, 0, 1]), np.array([1.0, 2, 0])),),
                covariance=np.eye(6),
                centre=np.zeros(3),
                points=40,
            ),
            timings_s={"network": 0.1},
            weights_name="fake",
            weights_sha256="0" * 64,
            options=to_dict(options),
        )
        return replace(result, **self.changes)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakePipeline:
    pipeline = FakePipeline()
    monkeypatch.setattr("utopic_cli.pipeline.register", pipeline.register)
    return pipeline


@pytest.fixture
def scans(tmp_path: Path) -> tuple[Path, Path]:
    """Two small ASCII PLY scans with a colour, a comment, and coordinates that text holds exactly."""
    rng = np.random.default_rng(5)
    for name, count in (("a.ply", 60), ("b.ply", 80)):
        points = rng.integers(-512, 512, (count, 3)) / 64.0
        rows = "\n".join(f"{x!r} {y!r} {z!r} {i % 256}" for i, (x, y, z) in enumerate(points.tolist()))
        (tmp_path / name).write_text(
            f"ply\nformat ascii 1.0\ncomment {name}\nelement vertex {count}\nproperty double x\n"
            f"property double y\nproperty double z\nproperty uchar red\nend_header\n{rows}\n"
        )
    return tmp_path / "a.ply", tmp_path / "b.ply"


@pytest.fixture
def cli() -> Callable[..., Any]:
    runner = CliRunner()
    return lambda *arguments: runner.invoke(app, [str(argument) for argument in arguments])
