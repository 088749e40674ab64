"""Whether raw uncertainty means something: where on a pair it is high, and on which pairs.

The paper's claim (Sec. 3.3.2) is that overlap is uncertain at the border of the overlap and
where a surface shows nothing to go by. Raw variance is compared, not the min-max normalised one,
which can't say that a whole pair is bad. Beside it stands how often the matches are right, by place: an
uncertainty that means something is high where they are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.benchmark.pair_metrics import KnownNodes, hit
from utopic_cli.bridge import NetworkView
from utopic_cli.preprocess import PreparedPair, SampledCloud

BORDER_REACH = 2.2
"""A node is at the border if one of the other kind lies within this many node spacings."""

PLACES = ("border", "inside", "outside", "plain", "rich")
"""At the border of the overlap; in it, off the border; out of it, off the border; and of the nodes
in the overlap, off the border, the quarter with the least and that with the most relief."""

MATCHED = ("border", "inside", "plain", "rich")
"""Places with nodes that overlap, so that a match of theirs can be right."""


@dataclass(frozen=True)
class UncertaintyByPlace:
    """Mean raw uncertainty of one pair by place.

    Attributes:
        mean: over all nodes of both clouds.
        places: mean by place of ``PLACES``; None where a pair has fewer than five such nodes.
        border_auc: probability that a node at the border is more uncertain than one inside (half
            for ties); None without both.
        plain_auc: the same of a plain one against a rich one.
        wrong_auc: the same, of the overlapping nodes, of one whose best match is wrong against one whose is
            right.
        hits: hit rate (see ``MatchMeasures``) of the overlapping nodes by place of ``MATCHED``; None where
            there are fewer than five.
    """

    mean: float
    places: dict[str, float | None]
    border_auc: float | None
    plain_auc: float | None
    wrong_auc: float | None
    hits: dict[str, float | None]


@dataclass(frozen=True)
class UncertaintySummary:
    """Raw uncertainty of one method over many pairs.

    Attributes:
        places: mean over pairs of the mean by place of ``PLACES``; None where no pair has such nodes.
        border_auc: mean over pairs; see ``UncertaintyByPlace``.
        plain_auc: likewise.
        wrong_auc: likewise.
        hits: mean over pairs of the hit rate by place of ``MATCHED``.
        failed: mean over the pairs whose answer is wrong; None without such a pair.
        right: mean over the others.
        failed_auc: probability that a pair that fails is more uncertain than one that doesn't.
    """

    places: dict[str, float | None]
    border_auc: float | None
    plain_auc: float | None
    wrong_auc: float | None
    hits: dict[str, float | None]
    failed: float | None
    right: float | None
    failed_auc: float | None


def summarise_uncertainty(pairs: Sequence[UncertaintyByPlace], right: Sequence[bool]) -> UncertaintySummary:
    """Summarise pairs, of which ``right`` tells whether their answer is."""
    means = np.array([pair.mean for pair in pairs])
    good = np.array(right, dtype=bool)
    return UncertaintySummary(
        {place: _mean([pair.places[place] for pair in pairs]) for place in PLACES},
        _mean([pair.border_auc for pair in pairs]),
        _mean([pair.plain_auc for pair in pairs]),
        _mean([pair.wrong_auc for pair in pairs]),
        {place: _mean([pair.hits[place] for pair in pairs]) for place in MATCHED},
        _mean(means[~good].tolist()),
        _mean(means[good].tolist()),
        area_under_curve(means[~good], means[good]),
    )


def measure_uncertainty(prepared: PreparedPair, view: NetworkView, known: KnownNodes) -> UncertaintyByPlace:
    """Sort the nodes of a pair by place and compare their raw uncertainty.

    Args:
        prepared: the pair.
        view: what the network said of it.
        known: the known answer at its nodes.
    """
    found: dict[str, list[np.ndarray]] = {place: [] for place in PLACES}
    hits: dict[str, list[np.ndarray]] = {place: [] for place in MATCHED}
    wrong: list[np.ndarray] = []
    right: list[np.ndarray] = []
    scores, distance = view.matching_scores, known.distance
    sides = (
        (prepared.source, known.source_overlap, view.source_raw, hit(scores, distance, known.spacing)),
        (prepared.target, known.target_overlap, view.target_raw, hit(scores.T, distance.T, known.spacing)),
    )
    for cloud, overlap, raw, matched in sides:
        border = _at_border(cloud.points, overlap, BORDER_REACH * prepared.spacing)
        inside = overlap & ~border
        plain, rich = _quarters(relief(cloud), inside)
        where = {
            "border": border,
            "inside": inside,
            "outside": ~overlap & ~border,
            "plain": plain,
            "rich": rich,
        }
        for place, chosen in where.items():
            found[place].append(raw[chosen])
        for place in MATCHED:
            hits[place].append(matched[where[place] & overlap])
        wrong.append(raw[overlap & ~matched])
        right.append(raw[overlap & matched])
    values = {place: np.concatenate(parts) for place, parts in found.items()}
    return UncertaintyByPlace(
        float(np.concatenate([view.source_raw, view.target_raw]).mean()),
        {place: _mean_of(raw) for place, raw in values.items()},
        area_under_curve(values["border"], values["inside"]),
        area_under_curve(values["plain"], values["rich"]),
        area_under_curve(np.concatenate(wrong), np.concatenate(right)),
        {place: _mean_of(np.concatenate(parts)) for place, parts in hits.items()},
    )


def relief(cloud: SampledCloud) -> np.ndarray:
    """How much the surface bends around each node: 1 - length of the mean normal of its neighbours (N,)."""
    around = cloud.normals[cloud.neighbours].mean(axis=1)
    return 1.0 - np.linalg.norm(around, axis=1)


def area_under_curve(
    positives: Sequence[float] | np.ndarray, negatives: Sequence[float] | np.ndarray
) -> float | None:
    """Probability that a positive's value is larger than a negative's, ties counting half.

    Returns:
        In [0, 1]; None if either is empty.
    """
    high, low = np.asarray(positives, dtype=np.float64), np.sort(np.asarray(negatives, dtype=np.float64))
    if not len(high) or not len(low):
        return None
    below = np.searchsorted(low, high, side="left") + np.searchsorted(low, high, side="right")
    return float(below.mean() / (2.0 * len(low)))


def _mean_of(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) >= 5 else None


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _at_border(points: np.ndarray, overlap: np.ndarray, reach: float) -> np.ndarray:
    """Nodes near one of the other kind (N,) bool."""
    border = np.zeros(len(points), dtype=bool)
    if overlap.any() and not overlap.all():
        for kind in (overlap, ~overlap):
            distance, _ = cKDTree(points[~kind]).query(points[kind], distance_upper_bound=reach)
            border[kind] = np.isfinite(distance)
    return border


def _quarters(values: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the chosen nodes, the quarter with the smallest and that with the largest values."""
    if among.sum() < 4:
        return np.zeros_like(among), np.zeros_like(among)
    low, high = np.quantile(values[among], [0.25, 0.75])
    return among & (values <= low), among & (values >= high) & (values > low)
