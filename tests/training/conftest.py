"""A run small enough for tests: a few pairs, and a few shapes to make them of."""

from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.training.config import Schedule

SCHEDULE = Schedule(
    descriptor_pairs=4,
    joint_pairs=4,
    points=(60, 80),
    last_points=(60, 80),
    bfloat16=False,
    validation_pairs=1,
    masking_from=0.5,
)


@pytest.fixture(scope="module")
def shapes():
    return procedural_shapes(np.random.default_rng(0), 10)
