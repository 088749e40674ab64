"""Small clouds as network input."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from utopic_cli.bridge import to_cloud_input
from utopic_cli.config import ModelConfig
from utopic_cli.geometry import rigid
from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.preprocess import sample

SMALL = {
    "patch_width": 8,
    "channels": (8, 8, 16, 16),
    "adaptive_hidden": 8,
    "kernel_rank": 8,
    "neighbours": 6,
    "feature_width": 16,
    "descriptor_width": 8,
    "transformer_width": 16,
    "heads": 2,
    "layers": 1,
    "uncertainty_samples": 5,
}


def bumpy_points(count: int, seed: int) -> np.ndarray:
    """Points on a lumpy ellipsoid, (count, 3)."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = 1.0 + 0.2 * np.sin(4 * direction[:, 0]) * np.cos(3 * direction[:, 1] + 1)
    return direction * radius[:, None] * [1.0, 0.7, 0.5]


def cloud_input(points: np.ndarray, config: ModelConfig, spacing: float = 0.12) -> CloudInput:
    """Sample points and make them network input."""
    return to_cloud_input(sample(points, spacing, 10_000), spacing, config.neighbours)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def pose() -> np.ndarray:
    rng = np.random.default_rng(5)
    return rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))
