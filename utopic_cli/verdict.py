"""The verdict: how likely the answer is right, whether to trust it, and why, in plain words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.estimation.candidates import LEAST_SUPPORT
from utopic_cli.estimation.confidence import Calibration
from utopic_cli.estimation.evidence import Evidence
from utopic_cli.estimation.observability import DISPLACED, FREE
from utopic_cli.frame import size_ratio, sizes_in_words
from utopic_cli.geometry.rigid import relative_rotation_error_deg
from utopic_cli.result import FreeMotion, Observability

UNCALIBRATED = "these weights carry no calibration, so nothing says how far to trust them: look at the result"
UNUSUAL = "confidence is calibrated for the default solver with refinement only: look at the result"

SAME_POINTS = "both scans hold the same points: is one of them named twice?"

UNIT_MISMATCH = 8.0
"""Extents that differ by more than this factor are named as a likely mix-up of units."""

LITTLE_OVERLAP = 0.1
"""Scans of which less than this share of either finds a counterpart hardly overlap."""

DIFFERENT_SURFACES = 0.6
"""Likeness below this: where the scans meet, their surfaces differ."""

CONFLICT = -1.5
"""Log10 of how much of the scans may stand in the other's empty space, for what of them meets."""

MOST_CONTRADICTION = -1.3
"""With a larger one (log10: a twentieth) an answer is not trusted, whatever else speaks for it: nothing
else tells a body from its mirror image where most of it is symmetric. Both ways must see it, since the
place a scan was taken from is a guess: where that is wrong, one way sees much conflict and the other
hardly any. What the verifier finds ``PLAUSIBLE`` all the same is let pass."""

PLAUSIBLE = 2.0
"""Log-odds of a verifier that has learned from mirror images, too: of the demo's, in four samplings, it gave
-5.5 to -6."""

LIMP = 0.02
"""A stiffness of no more: displaced by what a right answer may be off by, the source fits as well."""

FEW_EXPLAINED = -1.2
"""A log10 of the share of matches explained below this is what wrong answers reach."""

SHIFTED = 5.0
"""Rivals turned by fewer degrees against the answer differ from it by a shift."""

APART = -1.5
"""Two answers farther apart than this (log10 of the share of the size) are different answers."""


@dataclass(frozen=True)
class Verdict:
    """What to think of an answer.

    Attributes:
        confidence: calibrated probability that it is right; None without a calibration.
        trusted: whether to rely on it; never without a calibration, nor what is ``ruled_out``.
        reasons: why, most telling first.
    """

    confidence: float | None
    trusted: bool
    reasons: tuple[str, ...]

    @property
    def odds(self) -> float | None:
        """The confidence as log-odds, of at most a thousand to one."""
        if self.confidence is None:
            return None
        bounded = min(max(self.confidence, 1e-3), 1.0 - 1e-3)
        return float(np.log(bounded / (1.0 - bounded)))


def read_calibration(card: dict[str, Any]) -> Calibration | None:
    """Return the calibration of a weights' card, or None if it has none.

    Raises:
        InputError: it can't be used.
    """
    section = card.get("calibration")
    if section is None:
        return None
    name = card.get("name", "weights")
    try:
        calibration = Calibration.from_dict(section)
    except ValueError as error:
        raise InputError(f"{name}: {error}; fit another with utopic calibrate") from error
    unknown = sorted(set(calibration.signals) - {field.name for field in fields(Evidence)})
    if unknown:
        raise InputError(
            f"{name}: the calibration rests on {', '.join(unknown)}, which this version doesn't measure; "
            "fit another with utopic calibrate"
        )
    return calibration


def ruled_out(signals: dict[str, float]) -> bool:
    """Tell whether an answer is not to be trusted, however likely it is.

    Along a motion that the surfaces leave free, or that they do not notice, it is right by luck alone;
    scans that contradict each other can't both be right, unless the verifier finds that they only seem to;
    nor can two answers to two samplings of the same scans.
    """
    undetermined = signals["fixed"] < np.log10(FREE) or signals["stiffness"] <= LIMP
    contradicting = signals["contradiction"] > MOST_CONTRADICTION and signals["plausibility"] < PLAUSIBLE
    return bool(undetermined or contradicting or signals["spread"] > APART)


def judge(
    calibration: Calibration | None,
    signals: dict[str, float],
    transformation: np.ndarray,
    rivals: Sequence[np.ndarray],
    observability: Observability | None,
    overlap_ratio: dict[str, float],
    sizes: tuple[float, float] = (1.0, 1.0),
    usual: bool = True,
    same: bool = False,
) -> Verdict:
    """Weigh the signals.

    Args:
        calibration: of the weights, or None.
        signals: by name; see ``estimation.evidence.Evidence``.
        transformation: (4, 4) the answer.
        rivals: (4, 4) transformations that fit nearly as well.
        observability: which motions the overlap fixes.
        overlap_ratio: share of points with a counterpart, keys ``source`` and ``target``.
        sizes: extents of source and target, file units.
        usual: whether the answer came about as those did that the calibration was fitted on.
        same: whether both scans hold the same points.
    """
    doubts = _doubts(signals, transformation, rivals, observability, overlap_ratio)
    if size_ratio(*sizes) >= UNIT_MISMATCH:
        doubts.insert(0, f"{sizes_in_words(*sizes)}: are both in the same unit?")
    if same:
        doubts.insert(0, SAME_POINTS)
    if calibration is None or not usual:
        return Verdict(None, False, (UNCALIBRATED if calibration is None else UNUSUAL, *doubts))
    confidence = calibration.probability(signals)
    if confidence >= calibration.threshold and not ruled_out(signals):
        return Verdict(confidence, True, (_praise(signals, rivals), *(f"but {one}" for one in doubts)))
    if not doubts:
        doubts = [
            f"no single sign is bad, but together they fall short of the {calibration.threshold:.0%} "
            "from which an answer is trusted"
        ]
    return Verdict(confidence, False, tuple(doubts))


def _praise(signals: dict[str, float], rivals: Sequence[np.ndarray]) -> str:
    likeness = signals["likeness"]
    if likeness < DIFFERENT_SURFACES:
        return "taken together, the signs speak for it"
    share = "as well as" if likeness >= 1.0 else f"{likeness:.0%} as well as"
    alone = "" if rivals or signals["spread"] > APART else ", and no other transformation comes near"
    return f"where the scans meet, their surfaces agree {share} one scan does with itself{alone}"


def _doubts(
    signals: dict[str, float],
    transformation: np.ndarray,
    rivals: Sequence[np.ndarray],
    observability: Observability | None,
    overlap_ratio: dict[str, float],
) -> list[str]:
    """Say what speaks against the answer, most telling first."""
    doubts = []
    name, share = max(
        overlap_ratio.items(), key=lambda item: item[1]
    )  # a part in a whole covers little of it
    if share < LITTLE_OVERLAP:
        doubts.append(f"only {share:.0%} of the {name} finds a counterpart")
    if observability is None:
        doubts.append("too few points lie on each other to tell which motions are determined")
    elif sum(motion.kind == "rotation" for motion in observability.free) == 3:
        doubts.append("symmetric: rotation is not determined about any axis, as of a sphere")
    elif observability.free:
        said = " and ".join(motion_in_words(motion) for motion in observability.free)
        doubts.append(f"symmetric: {said} {'is' if len(observability.free) == 1 else 'are'} not determined")
    elif signals["stiffness"] <= LIMP:
        doubts.append(f"moved by {DISPLACED:.0%} of the scans' size, the source would fit as well")
    if rivals:
        count = "two poses fit" if len(rivals) == 1 else f"{len(rivals) + 1} poses fit"
        angle = max(relative_rotation_error_deg(rival, transformation) for rival in rivals)
        apart = "shifted against each other" if angle < SHIFTED else f"up to {angle:.0f}° apart"
        if len(rivals) == 1:
            apart = apart.removeprefix("up to ")
        doubts.append(f"{count} about equally well, {apart}: see ambiguous_with")
    if signals["likeness"] < DIFFERENT_SURFACES:
        doubts.append(
            f"where the scans meet, their surfaces agree only {signals['likeness']:.0%} as well as one scan "
            "does with itself"
        )
    if signals["conflict"] > CONFLICT:
        doubts.append("parts of one scan stand where the other saw empty space")
    if signals["spread"] > APART:
        doubts.append("another sampling of the same scans gave another answer")
    if signals["support"] < FEW_EXPLAINED:
        share = 10.0 ** signals["support"]
        few = f"only {share:.1%}" if share > LEAST_SUPPORT else f"less than {LEAST_SUPPORT:.1%}"
        doubts.append(f"the answer explains {few} of what the network matched")
    return doubts


def motion_in_words(motion: FreeMotion) -> str:
    """Name a motion of the source by kind and axis, e.g. ``rotation about the axis (0, 0, 1)``."""
    axis = ", ".join(f"{value:.2f}".rstrip("0").rstrip(".") for value in np.round(motion.axis, 2) + 0.0)
    return f"{'rotation about the axis' if motion.kind == 'rotation' else 'sliding along'} ({axis})"
