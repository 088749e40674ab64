"""The verdict: trusted or not, and the reasons a person reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from utopic_cli.errors import InputError
from utopic_cli.estimation.confidence import Calibration
from utopic_cli.estimation.evidence import SAME
from utopic_cli.geometry import rigid
from utopic_cli.result import FreeMotion, Observability
from utopic_cli.verdict import (
    SAME_POINTS,
    UNCALIBRATED,
    UNUSUAL,
    Verdict,
    judge,
    motion_in_words,
    read_calibration,
)

GOOD = {
    "likeness": 1.0,
    "conflict": -2.5,
    "contradiction": -2.5,
    "spread": SAME,
    "support": -0.6,
    "margin": 0.5,
    "plausibility": 0.0,
    "fixed": -1.0,
    "stiffness": 0.5,
}
FIXED = Observability(np.full(6, 0.3), (), np.eye(6), np.zeros(3), 500)


def calibration(lead: float = 10.0) -> Calibration:
    """Confidence from the lead alone: one half at 0.25."""
    one = np.ones(1)
    return Calibration(("margin",), 0 * one, one, 0.25 * one, one, lead * one, 0.0, threshold=0.9)


def verdict(signals: dict[str, float] | None = None, rivals: Any = (), seen: Any = FIXED, share: float = 0.6):  # type: ignore[no-untyped-def]
    ratio = {"source": share, "target": share / 2}
    return judge(calibration(), {**GOOD, **(signals or {})}, np.eye(4), rivals, seen, ratio)


def test_a_clear_answer_is_trusted_and_says_why() -> None:
    found = verdict()
    assert found.trusted and found.confidence == pytest.approx(1.0 / (1.0 + np.exp(-2.5)))
    assert found.odds == pytest.approx(2.5)
    assert (
        len(found.reasons) == 1
        and "their surfaces agree as well as one scan does with itself, and no other" in found.reasons[0]
    )


def test_confidence_under_the_threshold_is_not_trusted() -> None:
    found = verdict({"margin": 0.2})
    assert not found.trusted and found.confidence is not None and found.confidence < 0.5
    assert "together they fall short of the 90%" in found.reasons[0]


def test_without_a_calibration_nothing_is_trusted() -> None:
    found = judge(None, GOOD, np.eye(4), (), FIXED, {"source": 0.7, "target": 0.7})
    assert (found.confidence, found.trusted, found.reasons) == (None, False, (UNCALIBRATED,))
    assert found.odds is None


def test_the_odds_of_a_certain_answer_are_finite() -> None:
    for confidence in (0.0, 1.0):
        odds = Verdict(confidence, False, ()).odds
        assert odds is not None and abs(odds) == pytest.approx(np.log(999.0))


@pytest.mark.parametrize(
    ("signals", "said"),
    [
        ({"likeness": 0.4}, "where the scans meet, their surfaces agree only 40% as well"),
        ({"conflict": -0.7}, "stand where the other saw empty space"),
        ({"spread": -0.4}, "another sampling of the same scans gave another answer"),
        ({"support": -2.0}, "explains only 1.0% of what the network matched"),
    ],
)
def test_each_bad_sign_is_named(signals: dict[str, float], said: str) -> None:
    found = verdict({**signals, "margin": 0.0})
    assert len(found.reasons) == 1 and said in found.reasons[0]


def test_little_overlap_is_named_with_its_scan() -> None:
    assert "only 4% of the source finds a counterpart" in verdict({"margin": 0.0}, share=0.04).reasons[0]


def test_free_motions_are_named_by_kind_and_axis() -> None:
    turn = FreeMotion("rotation", np.array([0.0, 0.0, 1.0]), np.zeros(3))
    slide = FreeMotion("translation", np.array([0.6, -0.8, 1e-9]))
    seen = Observability(np.zeros(6), (turn,), np.eye(6), np.zeros(3), 500)
    (reason,) = verdict({"margin": 0.0}, seen=seen).reasons
    assert reason == "symmetric: rotation about the axis (0, 0, 1) is not determined"
    seen = Observability(np.zeros(6), (turn, slide), np.eye(6), np.zeros(3), 500)
    (reason,) = verdict({"margin": 0.0}, seen=seen).reasons
    assert reason.endswith("(0, 0, 1) and sliding along (0.6, -0.8, 0) are not determined")
    assert (
        motion_in_words(FreeMotion("translation", np.array([-1e-9, 0.0, 1.0]))) == "sliding along (0, 0, 1)"
    )


def test_where_nothing_meets_that_is_said() -> None:
    assert "too few points lie on each other" in verdict({"margin": 0.0}, seen=None).reasons[0]


def test_rivals_are_counted_and_their_angle_told() -> None:
    quarter, half = (
        rigid.rigid(rigid.rotation_from_vector(np.array([0.0, 0.0, np.radians(angle)])), np.zeros(3))
        for angle in (90.0, 180.0)
    )
    assert "two poses fit about equally well, 90° apart" in verdict({"margin": 0.0}, [quarter]).reasons[0]
    assert (
        "3 poses fit about equally well, up to 180° apart"
        in verdict({"margin": 0.0}, [quarter, half]).reasons[0]
    )


def test_a_rival_that_is_only_shifted_is_named_so() -> None:
    along = rigid.rigid(np.eye(3), np.array([0.5, 0.0, 0.0]))
    (reason,) = verdict({"margin": 0.0}, [along]).reasons
    assert reason.startswith("two poses fit about equally well, shifted against each other")


def test_sizes_that_differ_come_first() -> None:
    ratio = {"source": 0.7, "target": 0.02}
    found = judge(calibration(), {**GOOD, "margin": 0.0}, np.eye(4), (), FIXED, ratio, sizes=(2.0, 24.0))
    assert found.reasons[0] == (
        "the scans' sizes differ by a factor of about 12 (the target is the larger, 24 against 2 file units)"
        ": are both in the same unit?"
    )


def test_a_scan_named_twice_is_told_and_stays_trusted() -> None:
    found = judge(calibration(), GOOD, np.eye(4), (), FIXED, {"source": 1.0, "target": 1.0}, same=True)
    assert found.trusted and found.reasons[1] == f"but {SAME_POINTS}"


def test_an_answer_found_another_way_than_the_calibrations_has_no_verdict() -> None:
    ratio = {"source": 0.7, "target": 0.7}
    found = judge(calibration(), GOOD, np.eye(4), (), FIXED, ratio, usual=False)
    assert found == Verdict(None, False, (UNUSUAL,))


def test_no_rotation_of_a_sphere_is_determined() -> None:
    axes = tuple(FreeMotion("rotation", axis, np.zeros(3)) for axis in np.eye(3))
    seen = Observability(np.zeros(6), axes, np.eye(6), np.zeros(3), 500)
    (reason,) = verdict({"margin": 0.0}, seen=seen).reasons
    assert reason == "symmetric: rotation is not determined about any axis, as of a sphere"


def test_a_trusted_answer_still_names_what_speaks_against_it() -> None:
    found = verdict({"conflict": -1.3})
    assert found.trusted and len(found.reasons) == 2
    assert found.reasons[1] == "but parts of one scan stand where the other saw empty space"
    (praise, doubt) = verdict({"likeness": 0.5}).reasons
    assert praise == "taken together, the signs speak for it" and "agree only 50% as well" in doubt


def test_an_answer_that_another_sampling_does_not_give_again_is_never_trusted() -> None:
    found = verdict({"spread": -0.4})
    assert not found.trusted and found.confidence == verdict().confidence
    assert found.reasons == ("another sampling of the same scans gave another answer",)


def test_scans_that_contradict_each_other_are_never_trusted_however_likely_the_answer() -> None:
    assert verdict({"conflict": -0.7}).trusted  # in one way alone: where from is a guess
    assert verdict({"conflict": -0.7, "contradiction": -1.2, "plausibility": 2.1}).trusted
    found = verdict({"conflict": -0.7, "contradiction": -1.2, "plausibility": 1.9})
    assert not found.trusted and found.confidence == verdict().confidence
    assert found.reasons == ("parts of one scan stand where the other saw empty space",)


def test_a_motion_left_free_is_never_trusted_however_likely_the_answer() -> None:
    turn = FreeMotion("rotation", np.array([0.0, 0.0, 1.0]), np.zeros(3))
    free = Observability(np.zeros(6), (turn,), np.eye(6), np.zeros(3), 500)
    for seen in (free, None):
        found = verdict({"fixed": -4.0}, seen=seen)
        assert not found.trusted and found.confidence == verdict().confidence
        assert found.reasons


def test_an_answer_that_a_displaced_source_fits_as_well_is_never_trusted() -> None:
    found = verdict({"stiffness": 0.02})
    assert not found.trusted and found.confidence == verdict().confidence
    assert found.reasons == ("moved by 5% of the scans' size, the source would fit as well",)
    assert verdict({"stiffness": 0.021}).trusted


def test_a_card_without_a_calibration_has_none_and_a_damaged_one_is_an_error() -> None:
    assert read_calibration({"name": "mine"}) is None
    assert read_calibration({"name": "mine", "calibration": None}) is None
    assert read_calibration({"calibration": calibration().as_dict()}) is not None
    with pytest.raises(InputError, match="mine: the calibration"):
        read_calibration({"name": "mine", "calibration": {"signals": ["a"]}})
    with pytest.raises(InputError, match="mine: the calibration"):
        read_calibration({"name": "mine", "calibration": "yes"})
    other = {**calibration().as_dict(), "signals": ["scor"]}
    with pytest.raises(InputError, match="rests on scor, which this version doesn't measure"):
        read_calibration({"name": "mine", "calibration": other})
