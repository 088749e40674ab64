"""A look at a pair: one sampling of both scans, what the network saw in it, and what followed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from utopic_cli.bridge import NetworkView
from utopic_cli.errors import InputError
from utopic_cli.estimation.evidence import SAME
from utopic_cli.estimation.prior import ANYWHERE, Prior
from utopic_cli.estimation.problem import Problem
from utopic_cli.estimation.solver import Estimate, solve
from utopic_cli.estimation.surface import Surface
from utopic_cli.geometry import rigid
from utopic_cli.preprocess import PreparedPair

CLEAR_SCORE = 0.25
"""An estimate that scores less may rest on normals whose sides were guessed differently."""

CLEAR_OUTWARDNESS = 0.1
"""Normals that point outwards less clearly than this (a flat sheet's) may have either side."""

UNCLEAR_MARGIN = (0.01, 0.5)
"""Answers whose standing exceeds their best rival's by so much deserve a second sampling."""

WEAK_MARGIN = 0.25
"""With less of a lead, a low score is not explained by little overlap alone."""

HOPELESS_SUPPORT = 0.04
"""Answers that explain a smaller share of what the network matched are hardly ever right."""


See = Callable[[PreparedPair], NetworkView]
"""What looks at a prepared pair: the network, or anything that is measured beside it."""


@dataclass(frozen=True)
class Look:
    """One look.

    Attributes:
        prepared: the sampled pair.
        view: what was seen in it.
        estimate: what the robust solve made of that, in normalised units.
        surfaces: the source's and the target's, as the solve took them.
        inside_out: whether the source's normals were reversed.
    """

    prepared: PreparedPair
    view: NetworkView
    estimate: Estimate
    surfaces: tuple[Surface, Surface]
    inside_out: bool = False

    @property
    def unclear(self) -> bool:
        """Whether another sampling of the scans could change the answer or what to think of it.

        It could not where the answer is far ahead of its rivals, nor where it is hardly ahead at all
        (two poses that fit alike) or explains next to nothing of what was matched.
        """
        least, most = UNCLEAR_MARGIN
        unclear = least < self.estimate.margin < most and self.estimate.support > HOPELESS_SUPPORT
        return unclear and not self.estimate.shared_points

    @property
    def sides_in_doubt(self) -> bool:
        """Whether the two scans may have been given normals on opposite sides."""
        sheet = min(self.prepared.source.outwardness, self.prepared.target.outwardness) < CLEAR_OUTWARDNESS
        # A low score is what little overlap looks like, too: then the lead over the rivals tells.
        weak = self.estimate.score < CLEAR_SCORE and self.estimate.margin < WEAK_MARGIN
        return not self.estimate.shared_points and (sheet or weak)

    def joined(self, other: Look) -> Look:
        """Return the better of two looks, with the other one's answer and both's rivals as its rivals.

        Both are in the same normalised frame; only the sampling differs.
        """
        best, second = (other, self) if other.estimate.outranks(self.estimate) else (self, other)
        return replace(best, estimate=best.estimate.with_rivals(second.estimate, best.prepared.source.points))

    def spread(self, other: Look) -> float:
        """Log10 of how far apart two answers put the source's nodes, as a share of the scans' size."""
        nodes = self.prepared.source.points
        moved = [rigid.apply(look.estimate.T_target_source, nodes) for look in (self, other)]
        apart = float(np.sqrt(np.mean(np.sum((moved[0] - moved[1]) ** 2, axis=1))))
        return float(np.clip(np.log10(max(apart, 1e-12)), SAME, 0.0))


def problem_of(prepared: PreparedPair, view: NetworkView) -> Problem:
    """Pose the solver's question: a prepared pair and what was seen in it."""
    return Problem(
        source_nodes=prepared.source.points,
        target_nodes=prepared.target.points,
        matching_scores=view.matching_scores,
        source_overlap=view.source_overlap,
        target_overlap=view.target_overlap,
        source_certainty=1.0 - view.source_uncertainty,
        target_certainty=1.0 - view.target_uncertainty,
        source_dense=prepared.source.dense,
        target_dense=prepared.target.dense,
        spacing=prepared.spacing,
    )


def look(see: See, prepared: PreparedPair, solver: str = "auto", prior: Prior = ANYWHERE) -> Look:
    """Look at a pair.

    Args:
        see: called with the pair.
        prepared: the pair.
        solver: see ``solve``.
        prior: what is known of the transformation beforehand, in file units.

    Raises:
        InputError: no transformation follows from what was seen.
    """
    view = see(prepared)
    problem = problem_of(prepared, view)
    try:
        if prior.initial is not None:  # scaled and shifted, but not turned
            prior = replace(prior, initial=prepared.normalise(prior.initial))
        estimate = solve(problem, solver, prior, view.verify)
    except ValueError as error:
        raise InputError(f"no transformation can be found between these scans: {error}") from error
    return Look(prepared, view, estimate, problem.surfaces)


def look_both_sides(see: See, prepared: PreparedPair, solver: str = "auto", prior: Prior = ANYWHERE) -> Look:
    """Look at a pair, and where the normals' sides are in doubt, with the source inside out as well.

    Nothing in a point cloud says which side of a surface is the outside. The rule that decides gives
    both scans the same side nearly always; where it may not have, both are tried, and verification
    chooses. Arguments and errors are those of ``look``.
    """
    first = look(see, prepared, solver, prior)
    if solver == "svd" or not first.sides_in_doubt:
        return first
    turned = replace(prepared, source=prepared.source.turned_inside_out())
    try:
        other = look(see, turned, solver, prior)
    except InputError:  # the side first taken stands
        return first
    return replace(other, inside_out=True) if other.estimate.outranks(first.estimate) else first
