"""Clouds that share their points: two jittered copies of one sample, cut differently.

Two scans of a surface sample it anew, and a point's nearest neighbour in the other scan is
merely nearby. Some clouds, and the paper's own protocol, are cut from *one* sample instead:
then a point has a true partner, which says more about the pose than the surface does, even
which of two symmetric poses it is. Whether partners exist can be read off the distances.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.geometry import rigid

BY_CHANCE = 0.2
"""Of grids and even samples: largest share of points that come within the reach of another cloud's
point by chance."""

REGULAR = 2.2
"""Median distance to the eighth over that to the first neighbour: 3.4 in a random sample of a
surface, still 2.5 where it is thin and noisy, 1.4 on a square grid."""

NEAR = 4.0
"""A point takes part if the other cloud comes within this many reaches."""

SPREADS = (1.0, 1.6, 2.5)
"""Distances, in reaches, within which partners are looked for: how large the jitter is nobody says. Farther
off, how the surface lies counts for more than the points on it."""

RING = (1.5, 2.5)
"""What lies this far off, in multiples of the distance, tells how many points chance brings near."""

BEYOND_CHANCE = 5.5
"""Standard deviations above chance from which on partners are believed. Of 50,000 transformations tried for
620 pairs of samples of their own the best had 4.6."""

REGULARLY_BEYOND = 6.5
"""The same for grids and even samples, by the bound there is for them."""

WORTH_A_FIT = 2.5
"""Standard deviations above chance from which on it is seen what a fit makes of them."""

FEWEST_NEAR = 30  # points
FEWEST_PAIRS = 60
UNSEEN = 4.0  # pairs that few points may not show by chance
EVENLY, SCATTERED = (1.0 / (RING[1] ** n - RING[0] ** n) for n in (2, 3))
"""What lies within the distance over what lies in the ring, on a surface and in space. The points of a cloud
that shows less keep their distance (it was thinned); those of two clouds don't from each other."""
SLACK = 0.1
CANDIDATES = 6
STEPS = 40


def _reach(tree: cKDTree) -> tuple[float, bool]:
    """The reach of one cloud, and whether its points keep their distance.

    Half the median distance between nearest neighbours. Points of grids and even samples keep
    their distance; there the bound is that a place has at most n * pi * r^2 points within r, for n points
    per unit of area, and n follows from the distance to the eighth neighbour.
    """
    first, eighth = np.median(tree.query(tree.data, k=[2, 9])[0], axis=0)
    if not np.isfinite(eighth):  # fewer than nine points
        return 0.0, True
    if eighth > REGULAR * first:
        return float(0.5 * first), False
    return float(np.sqrt(BY_CHANCE / 8.0) * eighth), True


class Coincidence:
    """How far beyond chance points of two clouds coincide under a transformation.

    Of random samples the pairs of points within a distance are counted, one of each cloud. How many of them
    chance brings follows from the pairs in a ring around it: their ratio is that within either cloud, whose
    own points come near each other by chance only. It is taken where the clouds meet: along a pole it is
    another than on the flag. In grids and even samples points don't come near each other at all; there it is
    counted how many are each other's nearest within the reach.

    Attributes:
        source: (N, 3) points.
        target: (M, 3) points.
        regular: whether the points of a cloud keep their distance from each other.
        reach: a distance within which points may be partners; 0 for fewer than nine points, or if most of
            a cloud's are there twice: nothing can be said.
    """

    def __init__(self, source: np.ndarray, target: np.ndarray) -> None:
        """Measure the clouds."""
        self.source, self.target = source, target
        self._trees = trees = cKDTree(source), cKDTree(target)
        found = [_reach(tree) for tree in trees]
        self.reach = 0.0 if any(reach == 0 for reach, _ in found) else max(reach for reach, _ in found)
        self.regular = any(regular for _, regular in found)
        radii = self.reach * np.outer((1.0, *RING), () if self.regular else SPREADS).T
        self._rings = [_Ring(each, trees) for each in radii]

    def evidence(self, transformations: np.ndarray) -> np.ndarray:
        """Standard deviations above chance under (H, 4, 4) T_target_source -> (H,).

        Near 0 or below for clouds sampled each on its own, above ``BEYOND_CHANCE`` where partners meet; -inf
        where hardly a point is near.
        """
        if not self.reach > 0:
            return np.full(len(transformations), -np.inf)
        beyond = self._mutual_beyond_chance if self.regular else self._pairs_beyond_chance
        return np.array([beyond(T) for T in transformations], dtype=np.float64)

    def _pairs_beyond_chance(self, T: np.ndarray) -> float:
        moved = cKDTree(rigid.apply(T, self.source))
        widest = self._rings[-1].radii[-1]
        there, _ = self._trees[1].query(moved.data, distance_upper_bound=widest)
        back, _ = moved.query(self.target, distance_upper_bound=widest)
        return max(ring.beyond_chance(moved, there, back) for ring in self._rings)

    def _mutual_beyond_chance(self, T: np.ndarray) -> float:
        _, _, distance, near = _mutual(self.source, self.target, T, *self._trees, NEAR * self.reach)
        if near < FEWEST_NEAR:
            return -np.inf
        close = np.count_nonzero(distance < self.reach)
        return float((close - BY_CHANCE * near) / np.sqrt(BY_CHANCE * (1 - BY_CHANCE) * near))

    def meet(self, transformations: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Look for transformations under which partners meet, near some of (H, 4, 4).

        Returns:
            (K, 4, 4) T_target_source, fitted to the partners, best first, K at most ``most``; and (K,)
            which of the given ones each began at.
        """
        evidence = self.evidence(transformations)
        begun = np.argsort(-evidence, kind="stable")[:most]
        begun = begun[evidence[begun] > WORTH_A_FIT]
        if not len(begun):
            return transformations[:0], begun
        fitted = np.stack(
            [fit_partners(self.source, self.target, transformations[i], self.reach) for i in begun]
        )
        evidence = self.evidence(fitted)
        order = np.argsort(-evidence, kind="stable")
        order = order[evidence[order] > (REGULARLY_BEYOND if self.regular else BEYOND_CHANCE)]
        return fitted[order], begun[order]


class _Ring:
    """Pairs of points within a distance, and in a ring around it."""

    def __init__(self, radii: np.ndarray, trees: tuple[cKDTree, cKDTree]) -> None:
        """Take the distance and the ring's two radii (3,), and the clouds."""
        self.radii, self.trees = radii, trees

    def beyond_chance(self, moved: cKDTree, there: np.ndarray, back: np.ndarray) -> float:
        """Standard deviations by which pairs within the distance exceed what chance brings; -inf for few.

        Args:
            moved: the source under some transformation.
            there: (N,) distances of its points to the target, inf for far ones.
            back: (M,) distances of the target's points to it, likewise.
        """
        close, inner, outer = moved.count_neighbors(self.trees[1], self.radii)
        if outer < FEWEST_PAIRS:
            return -np.inf
        near = [counts[far < self.radii[-1]] for counts, far in zip(self._own, (there, back), strict=True)]
        own_close, own_inner, own_outer = np.sum([counts.sum(axis=0) for counts in near], axis=0)
        seen = own_close + UNSEEN  # each pair from both its ends
        share = seen / max(own_outer - own_inner, 1)
        expected = (share if share > SCATTERED else EVENLY) * (outer - inner)
        # Pairs that share a point come and go together; and what chance brings is itself counted.
        crowd = own_close / sum(map(len, near))
        variance = max(expected, 4.0) * (1.0 + crowd) + 2.0 * expected**2 / seen
        return float((close - expected) / np.sqrt(variance))

    @cached_property
    def _own(self) -> tuple[np.ndarray, ...]:
        """Other points of its own cloud about each point within the radii (N, 3) and (M, 3)."""
        return tuple(
            np.stack(
                [tree.query_ball_point(tree.data, radius, return_length=True) - 1 for radius in self.radii],
                axis=1,
            )
            for tree in self.trees
        )


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
        reach: of ``Coincidence``.

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
