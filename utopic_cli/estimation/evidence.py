"""What speaks for and against one transformation: dimensionless signals for the verdict.

A wrong transformation can lay two surfaces on each other over a good part, and a right one of
scans that hardly overlap explains little of either; so no single number tells them apart. These
signals look at the same answer from several sides: how well the surfaces agree *where they meet*,
whether one scan's points stand in the other's free space, how far the next best answer is behind,
which motions the geometry fixes, and what the network thinks of it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from utopic_cli.estimation.candidates import LEAST_SUPPORT
from utopic_cli.estimation.meeting import MEETING, meet, self_agreement, self_tightness
from utopic_cli.estimation.observability import Twists, stiffness
from utopic_cli.estimation.solver import Estimate
from utopic_cli.estimation.surface import Surface
from utopic_cli.geometry import rigid
from utopic_cli.result import FitMeasures


@dataclass(frozen=True)
class Evidence:
    """The signals a verdict rests on, all dimensionless; more is better unless said otherwise.

    Attributes:
        score: fit both ways minus free-space violation.
        overlap: log10 of the share, of the scan with less of it, that meets the other one.
        likeness: see ``Meeting``.
        tightness: see ``Meeting``; less is better.
        excess: log10 of ``tightness`` over how closely the scans lie on themselves; less is better.
        conflict: log10 of that of ``Meeting``, from -2.5 (none) up; less is better.
        contradiction: log10 of that of ``Meeting``, likewise; less is better.
        completeness: 0 up to an overlap of .9, 1 where all of both scans meets: scans from different
            sides share less, so it speaks for a symmetric thing seen from opposite ones; less is better.
        margin: log10 of by how much the answer's standing (see ``Candidate``) exceeds that of its best
            rival; from ``MOST_MARGIN`` on, more of it says no more.
        alone: 1 if no other candidate was found at all, else 0: then ``margin`` and ``support_lead`` are
            the most there are, and say little. Less is better.
        plausibility: log-odds of the verifier for the answer; 0 without one.
        support: log10 of the share of the correspondences' weight that the transformation explains.
        support_lead: log10 of that share over what the best supported rival explains.
        explained: natural logarithm of one plus the number of correspondences explained.
        fixed: log10 of the smallest eigenvalue of the normal matrix over the largest.
        stiffness: see ``observability.stiffness``.
        seen_overlap: mean overlap the network gives the points that meet the other scan.
        seen_contrast: ``seen_overlap`` minus the mean it gives the others.
        uncertainty: mean raw uncertainty of the points that meet the other scan; less is better.
        residual: 90th percentile over the median of the full-resolution residuals; less is better.
        spread: log10 of the distance between the answers to two samplings of the scans, as a share of
            their size; less is better. ``SAME`` where the first answer was clear enough to ask no more.
        shared: 1 if the clouds turned out to share points, else 0.
    """

    score: float
    overlap: float
    likeness: float
    tightness: float
    excess: float
    conflict: float
    contradiction: float
    completeness: float
    margin: float
    alone: float
    plausibility: float
    support: float
    support_lead: float
    explained: float
    fixed: float
    stiffness: float
    seen_overlap: float
    seen_contrast: float
    uncertainty: float
    residual: float
    spread: float
    shared: float

    def as_dict(self) -> dict[str, float]:
        """Return the signals by name."""
        return asdict(self)


EVEN = 0.003
"""Voxels, added to both sides of ``excess``: closer than that is as close as can be."""

SAME = -3.0
"""Answers a thousandth of the size apart are one and the same."""


@dataclass(frozen=True)
class Seen:
    """What the network says of the sampled points of a pair, both scans' after each other.

    Attributes:
        source: (N, 3) sampled points of the source.
        target: (M, 3) sampled points of the target.
        overlap: (N + M,) probability of lying in the overlap.
        uncertainty: (N + M,) raw.
    """

    source: np.ndarray
    target: np.ndarray
    overlap: np.ndarray
    uncertainty: np.ndarray


def collect_evidence(
    source: Surface,
    target: Surface,
    transformation: np.ndarray,
    estimate: Estimate,
    seen: Seen,
    fit: FitMeasures,
    twists: Twists | None,
    spread: float,
) -> Evidence:
    """Collect what speaks for and against an answer.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformation: (4, 4) the answer, refined, in the surfaces' frame.
        estimate: of the solver, with the answer's rivals.
        seen: by the network, shown the answer.
        fit: at full resolution.
        twists: ``find_twists`` of the two surfaces under it.
        spread: see ``Evidence``.
    """
    alike = self_agreement(source, target)
    meeting = meet(source, target, transformation, alike)
    overlap = min(meeting.source_share, meeting.target_share)
    rival_support = max((rival.support for rival in estimate.rivals), default=0.0)
    reach = MEETING * source.voxel
    there = source.tree.query(rigid.apply(rigid.invert(transformation), seen.target))[0] < reach
    met = np.concatenate([target.tree.query(rigid.apply(transformation, seen.source))[0] < reach, there])
    inside = float(seen.overlap[met].mean()) if met.any() else 0.0
    outside = float(seen.overlap[~met].mean()) if not met.all() else 0.0
    median, high = fit.residual_percentiles["p50"], fit.residual_percentiles["p90"]
    support = np.log10(max(estimate.support, LEAST_SUPPORT))
    return Evidence(
        score=estimate.score,
        overlap=float(np.log10(overlap + NO_OVERLAP)),
        likeness=meeting.likeness,
        tightness=meeting.tightness,
        excess=float(np.log10((meeting.tightness + EVEN) / (self_tightness(source, target) + EVEN))),
        conflict=float(np.log10(meeting.conflict + NO_CONFLICT)),
        contradiction=float(np.log10(meeting.contradiction + NO_CONFLICT)),
        completeness=max(overlap - 0.9, 0.0) / 0.1,
        margin=float(np.log10(min(estimate.margin, MOST_MARGIN) + NO_MARGIN)),
        alone=float(not estimate.rivals),
        plausibility=estimate.best.plausibility,
        support=float(support),
        support_lead=float(support - np.log10(max(rival_support, LEAST_SUPPORT))),
        explained=float(np.log1p(len(estimate.correspondences))),
        fixed=_smallest_eigenvalue(twists),
        stiffness=stiffness(source, target, transformation, twists, alike),
        seen_overlap=inside,
        seen_contrast=inside - outside,
        uncertainty=float(seen.uncertainty[met].mean()) if met.any() else MOST_UNCERTAIN,
        residual=_spread_of_residuals(median, high),
        spread=spread,
        shared=float(estimate.shared_points),
    )


MOST_RESIDUAL = 10.0


def _spread_of_residuals(median: float, high: float) -> float:
    """The 90th percentile over the median; the most there is where nothing has a counterpart."""
    if high == 0.0:  # a perfect fit
        return 1.0
    return min(high / median, MOST_RESIDUAL) if median * MOST_RESIDUAL > high else MOST_RESIDUAL


MOST_MARGIN = 1.0
NO_MARGIN = 0.005
NO_CONFLICT = 0.003
NO_OVERLAP = 0.01
MOST_UNCERTAIN = 0.25  # the largest variance of what lies in [0, 1]


def _smallest_eigenvalue(twists: Twists | None) -> float:
    """Log10 of the smallest eigenvalue over the largest, at least -5; -5 too where nothing is known."""
    if twists is None:
        return -5.0
    eigenvalues = twists.eigenvalues
    return float(np.log10(max(eigenvalues[0] / max(eigenvalues[-1], 1e-300), 1e-5)))
