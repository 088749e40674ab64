"""Transformations to show the network in training: none, right, nearly right, plausible wrong."""

from __future__ import annotations

import numpy as np

from utopic_cli.estimation.refinement import Stage, refine_coarse
from utopic_cli.estimation.surface import make_surface
from utopic_cli.frame import DENSE_RATIO
from utopic_cli.geometry import rigid
from utopic_cli.preprocess import PreparedPair

NONE, NEARLY_RIGHT = 0.4, 0.8
"""Cumulative shares of pairs shown no hypothesis, and a right or nearly right one; the rest is wrong."""

MOST_ROTATION_DEG = 6.0
MOST_SHIFT = 1.5  # in node spacings
SETTLING = (Stage(5.0, 5, 250), Stage(2.5, 5, 400))


def draw_hypothesis(
    prepared: PreparedPair, gt_T_target_source: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """Draw what the network is shown for one pair.

    Args:
        prepared: the sampled pair.
        gt_T_target_source: (4, 4) known answer between the normalised clouds.
        rng: source of all draws.

    Returns:
        A (4, 4) transformation, and 1.0 if it is shown or 0.0 if the network sees none.
    """
    kind = rng.random()
    if kind < NONE:
        return np.eye(4), 0.0
    if kind < NEARLY_RIGHT:
        amount = rng.random() ** 2  # mostly as near as a refined answer comes
        axis = rng.standard_normal(3)
        turn = rigid.rotation_from_vector(
            np.radians(MOST_ROTATION_DEG) * amount * axis / np.linalg.norm(axis)
        )
        shift = MOST_SHIFT * prepared.spacing * amount * rng.uniform(-1, 1, 3)
        return rigid.rigid(turn, shift) @ gt_T_target_source, 1.0
    return _wrong(prepared, rng), 1.0


def _wrong(prepared: PreparedPair, rng: np.random.Generator) -> np.ndarray:
    """Let random starts settle by ICP, as a solver's wrong hypotheses do, and take the first."""
    voxel = prepared.spacing / DENSE_RATIO
    source = make_surface(prepared.source.dense, voxel)
    target = make_surface(prepared.target.dense, voxel)
    rotation = rigid.random_rotation(rng)
    onto = target.points[rng.integers(len(target.points))]
    from_point = source.points[rng.integers(len(source.points))]
    start = rigid.rigid(rotation, onto - rotation @ from_point)
    return refine_coarse(source, target, start[None], SETTLING)[0]
