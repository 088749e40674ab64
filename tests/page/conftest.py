"""A small pair with a known answer, and a result that says so."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from utopic_cli.geometry.rigid import apply, invert, random_rotation, rigid, rotation_from_vector
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import Correspondences, FitMeasures, FreeMotion, Observability, RegistrationResult


@dataclass
class Pair:
    """Two clouds, the transformation between them, and a result with it."""

    source: PointCloud
    target: PointCloud
    result: RegistrationResult

    def with_result(self, **changes: Any) -> Pair:
        return replace(self, result=replace(self.result, **changes))


def make_pair(count: int = 700, offset: Any = (0.0, 0.0, 0.0), spread: float = 1.0) -> Pair:
    """Two parts of a bumpy ball of radius ``spread``; the target's around ``offset``."""
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(2 * count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ball = rays * (1.0 + 0.2 * np.sin(5 * rays[:, :1]) + 0.3 * rays[:, 1:2] ** 2) * spread
    target = ball[ball[:, 0] > -0.3 * spread] + np.asarray(offset)
    answer = rigid(random_rotation(rng), rng.normal(size=3) * spread + np.asarray(offset))
    near = ball[ball[:, 0] < 0.3 * spread] + np.asarray(offset)
    source = apply(invert(answer), near)
    overlap = [near[:, 0] - offset[0] > -0.3 * spread, target[:, 0] - offset[0] < 0.3 * spread]
    ramps = [np.linspace(0, 1, len(points), dtype=np.float32) for points in (source, target)]
    result = RegistrationResult(
        T_target_source=answer,
        confidence=None,
        trusted=False,
        reasons=("nobody checked it",),
        ambiguous_with=(),
        source_overlap=overlap[0].astype(np.float32),
        target_overlap=overlap[1].astype(np.float32),
        source_uncertainty=ramps[0],
        target_uncertainty=ramps[1],
        raw_uncertainty={},
        correspondences=Correspondences(np.arange(3), np.arange(3), np.ones(3)),
        fit=FitMeasures(
            overlap_ratio={"source": 0.41, "target": 0.52},
            inlier_ratio=0.9,
            inlier_rmse=0.0123 * spread,
            residual_percentiles={"p50": 0.011 * spread, "p95": 0.03 * spread},
            threshold=0.05 * spread,
        ),
        observability=Observability(
            eigenvalues=np.ones(6), free=(), covariance=np.eye(6), centre=np.zeros(3), points=40
        ),
        timings_s={"network": 1.25, "refine": 0.5},
        weights_name="some-weights",
        weights_sha256="0123456789abcdef" * 4,
        options={"seed": 7},
    )
    return Pair(PointCloud(source), PointCloud(target), result)


@pytest.fixture
def pair() -> Pair:
    return make_pair()


def with_rivals(pair: Pair, count: int) -> Pair:
    """Add poses turned about the target's middle."""
    middle = pair.target.points.mean(axis=0)
    rivals = []
    for number in range(count):
        rotation = rotation_from_vector(np.array([0.0, 0.0, 0.9 + number / 2]))
        rivals.append(rigid(rotation, middle - rotation @ middle) @ pair.result.T_target_source)
    return pair.with_result(ambiguous_with=tuple(rivals))


SLIDING = FreeMotion("translation", np.array([0.0, -0.0, 1.0]))
TURNING = FreeMotion("rotation", np.array([0.0, 1.0, 0.0]), np.array([1.0, 2.0, 3.0]))
