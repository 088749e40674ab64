"""Clouds that share their points: two jittered copies of one sample, cut differently.

Two scans of a surface sample it anew, and a point's nearest neighbour in the other scan is
merely nearby. Some clouds, and the paper's own protocol, are cut from *one* sample instead:
then a point has a true partner, which says more about the pose than the surface does, even
which of two symmetric poses it is. Whether partners exist can be read off the distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import rel_entr

from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.geometry import rigid

BY_CHANCE = 0.2
"""Of grids and even samples of a surface: share of points that come within the reach of another cloud's
point by chance."""

EVEN, REGULAR = 0.027, 0.04
"""Evenness from which on points of a cloud may keep some distance from each other, and from which on they do.
Of 780 random samples of noisy surfaces it was -.04 to .055, of 95 % at most .024; of 350 grids, even samples
and means of voxels, noisy or not, .01 to .33, of 95 % of each kind but the noisiest at least .027."""

PLAIN, THICK = 0.130, 0.108
"""Evenness begins at the first: distance to the first over that to the eighth neighbour in random samples, of
the tenth of points where it is least. As noise makes the surface thick it grows by the second, times the
thickness: deviation along the normal over the mean one along the surface's narrower side."""

NEAR = 4.0
"""Of grids and even samples: a point takes part if the other cloud comes within this many reaches."""

SPREADS = (0.4, 0.63, 1.0, 1.6, 2.5)
"""Standard deviations, in reaches, of what lies between partners along an axis: how large the jitter is
nobody says."""

FARTHER = 2.0
"""How much farther off it is looked how points crowd that may keep some distance from each other."""

TAIL = 2.8
"""Deviations beyond which a point does not count."""

SHARES = (0.15, 0.4, 0.8)
"""Of the points that are near the other cloud, how many may have a partner."""

BEYOND_CHANCE = 12.0
"""Log-likelihood ratio, in nats, from which on partners are believed. Of 21,000 transformations tried for
536 pairs of samples of their own the best had 9.5."""

REGULARLY_BEYOND = 21.0
"""The same for grids and even samples, by the bound there is for them."""

OF_THE_BEST = 0.5
"""Share of the best transformation's evidence that another needs: half a turn that lays points on each other
does it to both of a pair, so that chance counts twice."""

FEWEST_NEAR = 20  # points
FEWEST_OTHERS = 0.1
"""Least that chance is taken to bring near a point: a lonely point is no evidence."""

OTHERS = 24  # nearest points that are looked at
OWN_OTHERS = 64
SMOOTHED = 16
"""Points over which it is averaged how they crowd."""

SLACK = 0.1
STEPS = 40
FIRST_STEPS = 10  # after which the evidence tells which fits are worth finishing
FINISHED = 3


def _evenness(near: np.ndarray, distance: np.ndarray) -> float:
    """Tell how far points keep their distance from each other, 0 for random samples; see ``EVEN``.

    Args:
        near: (N, 9, 3) each point and its eight nearest.
        distance: (N, 9) to them.
    """
    near = near - near.mean(axis=1, keepdims=True)
    spread = np.linalg.eigvalsh(np.einsum("nkd,nke->nde", near, near))
    thickness = np.median(np.sqrt(np.maximum(spread[:, 0], 0.0) / np.maximum(spread[:, 1], 1e-300)))
    ratio = distance[:, 1] / np.maximum(distance[:, 8], 1e-300)  # points may be there often
    return float(np.quantile(ratio, 0.1) - PLAIN - THICK * thickness)


def _reach(tree: cKDTree) -> tuple[float, float]:
    """The reach of one cloud, and its evenness.

    Half the median distance between nearest neighbours. Points of grids and even samples keep
    their distance; there the bound is that a place has at most n * pi * r^2 points within r, for n points
    per unit of area, and n follows from the distance to the eighth neighbour.
    """
    distance, index = tree.query(tree.data, k=range(1, 10))
    first, eighth = np.median(distance[:, [1, 8]], axis=0)
    if not np.isfinite(eighth) or first == 0:  # fewer than nine points, or most there twice
        return 0.0, np.inf
    evenness = _evenness(tree.data[index], distance)
    return float(0.5 * first if evenness < REGULAR else np.sqrt(BY_CHANCE / 8.0) * eighth), evenness


def _share_by_chance(tree: cKDTree, reach: float) -> np.ndarray:
    """Bound how likely another cloud has a point within the reach of each of an even cloud's -> (N,).

    As many of its own are that near as follows from its fourth and eighth neighbours: along a rod four times
    as far off there are four times as many, on a surface sixteen times.
    """
    distance, around = tree.query(tree.data, k=range(1, 10))
    fourth, eighth = np.log(np.maximum(distance[around][:, :, [4, 8]], 1e-300)).mean(axis=1).T
    dimension = np.clip(np.log(2.0) / np.maximum(eighth - fourth, 1e-9), 1.0, 2.0)
    share: np.ndarray = np.minimum(8.0 * np.exp(dimension * (np.log(reach) - eighth)), 1.0)
    return share


class Coincidence:
    """How far beyond chance points of two clouds coincide under a transformation.

    Each point that has others near it speaks for partners or for chance. If it has a partner, that lies where
    a Gaussian has it; what chance brings near follows from how the points of either cloud crowd there, since
    they come near each other by chance only. The likelihood ratio of the two is what there is of near points,
    weighed by the Gaussian, over what chance brings: 1 on average without partners. Not every point has one.

    In grids and even samples points don't come near each other at all; there it is counted how many are
    each other's nearest within the reach.

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
        evenness = max(each for _, each in found)
        self.regular = evenness > REGULAR
        self._deviations = self.reach * np.array(SPREADS)
        self._crowding = [
            _crowding(tree, self._deviations, even=evenness > EVEN) for tree in trees if self.reach > 0
        ]
        self._even = (
            [_share_by_chance(tree, self.reach) for tree in trees] if self.regular and self.reach > 0 else []
        )

    @property
    def enough(self) -> float:
        """Evidence from which on partners are believed, in nats."""
        return REGULARLY_BEYOND if self.regular else BEYOND_CHANCE

    def evidence(self, transformations: np.ndarray) -> np.ndarray:
        """Log-likelihood ratio of partners to chance, in nats, under (H, 4, 4) T_target_source -> (H,).

        Below 0 for clouds sampled each on its own, above ``enough`` where partners meet; -inf where hardly a
        point is near.
        """
        if not self.reach > 0:
            return np.full(len(transformations), -np.inf)
        beyond = self._evenly_beyond_chance if self.regular else self._beyond_chance
        return np.array([beyond(T) for T in transformations], dtype=np.float64)

    def meet(self, transformations: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Look for transformations under which partners meet, near some of (H, 4, 4).

        Partners a few reaches apart are no evidence yet, but a fit may bring them together.

        Args:
            transformations: T_target_source, best first by what else is known.
            most: begin at so many of the first, and at so many of those with the most evidence.

        Returns:
            (K, 4, 4) T_target_source, fitted to the partners, best first, K at most ``FINISHED``; and (K,)
            which of the given ones each began at.
        """
        evidence = self.evidence(transformations)
        begun = np.union1d(np.argsort(-evidence, kind="stable")[:most], np.arange(len(evidence))[:most])
        begun = begun[np.isfinite(evidence[begun])]
        if not len(begun):
            return transformations[:0], begun
        fitted = np.stack([self.fit(transformations[i], FIRST_STEPS) for i in begun])
        best = np.argsort(-self.evidence(fitted), kind="stable")[:FINISHED]
        begun, fitted = begun[best], np.stack([self.fit(T) for T in fitted[best]])
        evidence = self.evidence(fitted)
        order = np.argsort(-evidence, kind="stable")
        order = order[evidence[order] > max(self.enough, OF_THE_BEST * evidence[order[0]])]
        return fitted[order], begun[order]

    def fit(self, T: np.ndarray, steps: int = STEPS) -> np.ndarray:
        """Fit a transformation to the partners of clouds that share points.

        Where the jitter is not small beside the points' distances, the nearest neighbour is often not the
        partner. So expectation maximisation: each point is spread over its near ones and over having no
        partner by their likelihoods, normalised both ways, Procrustes on the expected partners follows, and
        the jitter and the share of points with a partner are estimated anew.

        Args:
            T: (4, 4) T_target_source to start from, right within a few reaches.
            steps: most steps.

        Returns:
            (4, 4) float64 T_target_source; the given one where hardly a point is near.
        """
        share, jitter = SHARES[1], 0.0
        least = 1e-6 * self.reach
        for _ in range(steps):
            moved = rigid.apply(T, self.source)
            near = self._near(moved, 0)
            if near is None:
                return T
            if not jitter:
                jitter = self._deviations[np.argmax(_log_ratios(near.ratios(self._deviations)).max(axis=0))]
            distance = np.where(near.distance < max(4.0 * jitter, 0.5 * self.reach), near.distance, np.inf)
            likelihood = np.exp(-0.5 * (distance / jitter) ** 2)
            index = np.where(np.isfinite(distance), near.index, 0)
            alone = (1.0 - share) / share * near.by_chance(self._deviations, jitter)
            belief = _one_to_one(likelihood, index, alone, len(self.target))
            weight = belief.sum(axis=1)
            mass = weight.sum()
            expected = np.einsum("nk,nkd->nd", belief, self.target[index])
            try:
                T = weighted_procrustes(
                    self.source[near.rows], expected / np.maximum(weight, 1e-300)[:, None], weight
                )
            except ValueError:
                return T
            squared = np.where(belief > 0, distance, 0.0) ** 2
            jitter = max(float(np.sqrt((belief * squared).sum() / (3.0 * mass))), least)
            share = float(np.clip(mass / len(weight), 0.1, 0.95))
            if np.linalg.norm(rigid.apply(T, self.source) - moved, axis=1).max() < 1e-4 * self.reach:
                break
        return T

    def _beyond_chance(self, T: np.ndarray) -> float:
        there = self._near(rigid.apply(T, self.source), 0)
        back = self._near(rigid.apply(rigid.invert(T), self.target), 1)
        if there is None or back is None:
            return -np.inf
        both = sum(_log_ratios(near.ratios(self._deviations)) for near in (there, back))
        return float(np.max(both) / 2.0)

    def _evenly_beyond_chance(self, T: np.ndarray) -> float:
        source, target = self._trees
        distance, partner = target.query(rigid.apply(T, source.data), distance_upper_bound=NEAR * self.reach)
        near = np.flatnonzero(np.isfinite(distance))
        if len(near) < FEWEST_NEAR:
            return -np.inf
        back = rigid.apply(rigid.invert(T), target.data[partner[near]])
        mutual = near[source.query(back)[1] == near]
        share = np.count_nonzero(distance[mutual] < self.reach) / len(near)
        by_chance = min(np.maximum(self._even[0][near], self._even[1][partner[near]]).mean(), 1.0 - 1e-9)
        nats = len(near) * (rel_entr(share, by_chance) + rel_entr(1.0 - share, 1.0 - by_chance))
        return float(nats if share > by_chance else -nats)

    def _near(self, moved: np.ndarray, cloud: int) -> _Near | None:
        """Look from the points of a cloud (0: the source), moved onto the other, to what is near there."""
        other = self._trees[1 - cloud]
        nearest = range(1, min(OTHERS, other.n) + 1)
        distance, index = other.query(moved, nearest, distance_upper_bound=TAIL * self._deviations[-1])
        rows = np.flatnonzero(np.isfinite(distance[:, 0]))
        if len(rows) < FEWEST_NEAR:
            return None
        index = index[rows]
        crowding = 0.5 * (self._crowding[cloud][rows] + self._crowding[1 - cloud][index[:, 0]])
        return _Near(rows, distance[rows], index, np.maximum(crowding, FEWEST_OTHERS))


@dataclass(frozen=True)
class _Near:
    """What lies near the points of a cloud in the other.

    Attributes:
        rows: (R,) of the points that have anything near.
        distance: (R, K) to the nearest there, inf beyond the tail.
        index: (R, K) which they are.
        crowding: (R, S) what chance brings near, weighed by Gaussians of S deviations.
    """

    rows: np.ndarray
    distance: np.ndarray
    index: np.ndarray
    crowding: np.ndarray

    def ratios(self, deviations: np.ndarray) -> np.ndarray:
        """Likelihood ratio (R, S) of having a partner at one of S deviations to having none."""
        return _weighed(self.distance, deviations) / self.crowding

    def by_chance(self, deviations: np.ndarray, deviation: float) -> np.ndarray:
        """Interpolate what chance brings near (R,) for another deviation; beyond them the last one's."""
        place = np.interp(np.log(deviation), np.log(deviations), np.arange(len(deviations)))
        below = min(int(place), len(deviations) - 2)
        low, high = np.log(self.crowding[:, below : below + 2]).T
        between: np.ndarray = np.exp(low + (place - below) * (high - low))
        return between


def _log_ratios(ratios: np.ndarray) -> np.ndarray:
    """Log-likelihood ratio of all points (R, S) -> (``SHARES``, S), if a share of them has a partner."""
    logs: np.ndarray = np.log1p(np.multiply.outer(SHARES, ratios - 1.0)).sum(axis=1)
    return logs


def _weighed(distance: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Weigh near points (R, K) by Gaussians of S deviations and sum them up -> (R, S)."""
    return np.stack(
        [np.exp(-0.5 * (distance / deviation) ** 2).sum(axis=1) for deviation in deviations], axis=1
    )


def _crowding(tree: cKDTree, deviations: np.ndarray, *, even: bool) -> np.ndarray:
    """Weigh by Gaussians of S deviations what lies near each point of a cloud in it -> (N, S), smoothed.

    Args:
        tree: of the cloud.
        deviations: (S,).
        even: whether points may keep some distance from each other (of a cloud that was thinned), which those
            of another don't keep from them. Then it is no less than what lies farther off, spread evenly.
    """
    others = range(2, min(OWN_OTHERS, tree.n - 1) + 2)
    distance = tree.query(tree.data, others, distance_upper_bound=TAIL * FARTHER * deviations[-1])[0]
    around = tree.query(tree.data, range(1, min(SMOOTHED, tree.n) + 1))[1]
    crowding: np.ndarray = _weighed(distance, deviations)[around].mean(axis=1)
    if not even:
        return crowding
    farther = _weighed(distance, FARTHER * deviations)[around].mean(axis=1)
    return np.maximum(crowding, farther / FARTHER**2)


def _one_to_one(likelihood: np.ndarray, index: np.ndarray, alone: np.ndarray, columns: int) -> np.ndarray:
    """Normalise (N, K) likelihoods over rows, with (N,) that of no partner, and over columns, with slack."""
    column_scale: np.ndarray = np.ones(columns)
    for _ in range(8):
        row_scale = 1.0 / (alone + (likelihood * column_scale[index]).sum(axis=1))
        mass = np.bincount(index.ravel(), (likelihood * row_scale[:, None]).ravel(), minlength=columns)
        column_scale = 1.0 / (SLACK + mass)
    return likelihood * row_scale[:, None] * column_scale[index]
