"""Clouds that share their points: two jittered copies of one sample, cut differently.

Two scans of a surface sample it anew, and a point's nearest neighbour in the other scan is
merely nearby. Some clouds, and the paper's own protocol, are cut from *one* sample instead:
then a point has a true partner, which says more about the pose than the surface does, even
which of two symmetric poses it is. Whether partners exist can be read off the distances.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.geometry import rigid

BY_CHANCE = 0.2
"""Largest share of points that come within the reach of another cloud's point by chance."""

REGULAR = 2.2
"""Median distance to the eighth over that to the first neighbour: 3.4 in a random sample of a
surface, still 2.5 where it is thin and noisy, 1.4 on a square grid."""

NEAR = 4.0
"""A point takes part if the other cloud comes within this many reaches."""

BEYOND_CHANCE = 3.0
"""Standard deviations above that share from which on partners are believed. Samples of their own
stay below 0 (nearest neighbours are mutual half of the time only); jitter of a third of the
typical distance between neighbours leaves 8 and more."""

FEWEST_NEAR = 30
SLACK = 0.1
CANDIDATES = 6
STEPS = 40


def partner_reach(source: np.ndarray, target: np.ndarray) -> float:
    """Return the distance within which points of two clouds may be partners, in their units.

    At a reach of half the median distance s between nearest neighbours, mutual nearest
    neighbours come that near by chance for (1 - 2 ** -0.5) / 2 = 0.15 of the points of random
    samples. Points of grids and even samples keep their distance; there the bound is that a
    place has at most n * pi * r^2 points within r, for n points per unit of area, and n follows
    from the distance to the eighth neighbour.

    Args:
        source: (N, 3) points.
        target: (M, 3) points.

    Returns:
        The reach; 0 for fewer than nine points, or if most are there twice.
    """
    reaches = []
    for points in (source, target):
        first, eighth = np.median(cKDTree(points).query(points, k=[2, 9])[0], axis=0)
        if not np.isfinite(eighth):  # fewer than nine points
            return 0.0
        reaches.append(0.5 * first if eighth > REGULAR * first else np.sqrt(BY_CHANCE / 8.0) * eighth)
    return float(max(reaches))


def partner_evidence(
    source: np.ndarray, target: np.ndarray, transformations: np.ndarray, reach: float
) -> np.ndarray:
    """Say how far beyond chance points of two clouds coincide under H transformations.

    Coincide: are each other's nearest within the reach.

    Args:
        source: (N, 3) points.
        target: (M, 3) points.
        transformations: (H, 4, 4) T_target_source.
        reach: of ``partner_reach``.

    Returns:
        (H,) standard deviations above chance: 0 or less for clouds sampled each on its own,
        above ``BEYOND_CHANCE`` where partners meet; -inf where hardly a point is near.
    """
    target_tree, source_tree = cKDTree(target), cKDTree(source)
    evidence = np.full(len(transformations), -np.inf)
    for number, T in enumerate(transformations):
        _, _, distance, near = _mutual(source, target, T, source_tree, target_tree, NEAR * reach)
        if near >= FEWEST_NEAR:
            close = np.count_nonzero(distance < reach)
            evidence[number] = (close - BY_CHANCE * near) / np.sqrt(BY_CHANCE * (1 - BY_CHANCE) * near)
    return evidence


def approach_partners(
    source: np.ndarray, target: np.ndarray, T: np.ndarray, reach: float, steps: int = 5
) -> np.ndarray:
    """Fit a transformation to mutual nearest neighbours a few times over -> (4, 4).

    Cheap, and enough to tell whether partners meet nearby; ``fit_partners`` is the accurate one.
    """
    target_tree, source_tree = cKDTree(target), cKDTree(source)
    for _ in range(steps):
        index, partner, _, _ = _mutual(source, target, T, source_tree, target_tree, NEAR * reach)
        try:
            T = weighted_procrustes(source[index], target[partner], np.ones(len(index)))
        except ValueError:  # too few, or all on a line: nothing to approach
            break
    return T


def fit_partners(source: np.ndarray, target: np.ndarray, T: np.ndarray, reach: float) -> np.ndarray:
    """Fit a transformation to the partners of clouds that share points.

    Where the jitter is not small beside the points' distances, the nearest neighbour is often not the
    partner. So expectation maximisation: each point is spread over its few nearest ones by the
    likelihood of the distance, normalised both ways with some slack for points without a
    partner, Procrustes on the expected partners follows, and the jitter is estimated anew.

    Args:
        source: (N, 3) points.
        target: (M, 3) points, partly jittered copies of source points.
        T: (4, 4) T_target_source to start from, right within a few reaches.
        reach: of ``partner_reach``.

    Returns:
        (4, 4) float64 T_target_source.
    """
    target_tree, source_tree = cKDTree(target), cKDTree(source)
    distance = _mutual(source, target, T, source_tree, target_tree, NEAR * reach)[2]
    if len(distance) < 3:
        return T
    jitter = float(np.median(distance)) / 1.54  # of a coordinate, if the distance is of three
    least = 1e-6 * reach
    for _ in range(STEPS):
        jitter = max(jitter, least)
        moved = rigid.apply(T, source)
        bound = max(4.0 * jitter, reach / 2.0)
        nearest = range(1, min(CANDIDATES, len(target)) + 1)
        distance, index = target_tree.query(moved, k=nearest, distance_upper_bound=bound)
        found = np.isfinite(distance)
        index, distance = np.where(found, index, 0), np.where(found, distance, 0.0)
        likelihood = np.where(found, np.exp(-0.5 * (distance / jitter) ** 2), 0.0)
        belief = _one_to_one(likelihood, index, len(target))
        weight = belief.sum(axis=1)
        expected = np.einsum("nk,nkd->nd", belief, target[index]) / np.maximum(weight, 1e-300)[:, None]
        try:
            improved = weighted_procrustes(source, expected, weight)
        except ValueError:
            return T
        step = np.linalg.norm(rigid.apply(improved, source) - moved, axis=1).max()
        T = improved
        jitter = float(np.sqrt((belief * distance**2).sum() / (3.0 * belief.sum())))
        if step < 1e-4 * reach:
            break
    return T


def _mutual(
    source: np.ndarray,
    target: np.ndarray,
    T: np.ndarray,
    source_tree: cKDTree,
    target_tree: cKDTree,
    reach: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Mutual nearest neighbours: their rows, their distances, and how many points had any near."""
    distance, partner = target_tree.query(rigid.apply(T, source), distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(distance))
    back = rigid.apply(rigid.invert(T), target[partner[near]])
    mutual = near[source_tree.query(back)[1] == near]
    return mutual, partner[mutual], distance[mutual], len(near)


def _one_to_one(likelihood: np.ndarray, index: np.ndarray, columns: int) -> np.ndarray:
    """Normalise (N, K) likelihoods over rows and columns, with slack for points without a partner."""
    column_scale: np.ndarray = np.ones(columns)
    for _ in range(8):
        row_scale = 1.0 / (SLACK + (likelihood * column_scale[index]).sum(axis=1))
        mass = np.bincount(index.ravel(), (likelihood * row_scale[:, None]).ravel(), minlength=columns)
        column_scale = 1.0 / (SLACK + mass)
    return likelihood * row_scale[:, None] * column_scale[index]
