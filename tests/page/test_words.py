from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.page.conftest import SLIDING, TURNING, make_pair, with_rivals
from utopic_cli.geometry.rigid import rigid, rotation_from_vector
from utopic_cli.page.words import decimals, facts, percent, vector, verdict


@pytest.mark.parametrize(
    ("trusted", "confidence", "kind", "said", "not_said"),
    [
        (True, 0.973, "yes", "Aligned and trusted Confidence 97%", "wrong"),
        (False, 0.31, "no", "do not trust it Confidence 31%", "and trusted"),
        (False, None, "none", "No verdict", "trusted"),
        (True, None, "none", "No verdict", "trusted"),  # nothing vouches for it
    ],
)
def test_the_verdict_says_what_the_result_says_and_no_more(pair, trusted, confidence, kind, said, not_said):
    found = verdict(pair.with_result(trusted=trusted, confidence=confidence).result)
    assert found.kind == kind
    assert said in f"{found.title} {found.text}"
    assert not_said not in f"{found.title} {found.text}"


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "over 99%"), (0.9951, "over 99%"), (0.985, "98%"), (0.5, "50%"), (0.0, "under 1%")],
)
def test_a_percentage_never_claims_certainty(share, text):
    assert percent(share) == text


def test_rotation_and_translation_are_those_of_the_matrix(pair):
    turn = rigid(rotation_from_vector(np.array([0.0, 0.0, np.radians(30)])), np.array([1.0, 0.0, 0.0]))
    pair.source.points[:] -= pair.source.points.mean(axis=0)
    said = dict(facts(pair.with_result(T_target_source=turn).result, pair.source, pair.target))
    assert said["Rotation"] == "30.000° about the axis (0.000, 0.000, 1.000)"
    assert said["Translation"].startswith(
        "the source's centroid moves by 1.0000 file units: (1.0000, 0.0000,"
    )
    still = dict(facts(pair.with_result(T_target_source=np.eye(4)).result, pair.source, pair.target))
    assert still["Rotation"] == "0.000°"


@pytest.mark.parametrize(
    ("free", "said"),
    [
        ((), "nothing: the surfaces that overlap fix all six motions"),
        ((SLIDING,), "sliding along (0.000, 0.000, 1.000)"),
        (
            (TURNING, SLIDING),
            "rotation about the axis (0.000, 1.000, 0.000) through (1.0000, 2.0000, 3.0000); sliding along",
        ),
    ],
)
def test_what_is_not_determined_is_named(pair, free, said):
    pair = pair.with_result(observability=replace(pair.result.observability, free=free))
    assert dict(facts(pair.result, pair.source, pair.target))["Not determined"].startswith(said)


def test_what_was_not_measured_is_called_so(pair):
    pair = pair.with_result(observability=None)
    assert dict(facts(pair.result, pair.source, pair.target))["Not determined"].startswith("not measured")


def test_rivals_say_how_far_they_are_from_the_answer(pair):
    pair = with_rivals(pair, 1)
    text = dict(facts(pair.result, pair.source, pair.target))["Rival pose 1"]
    assert f"{np.degrees(0.9):.1f}°" in text


@pytest.mark.parametrize(("spread", "places"), [(1.0, 4), (1e-3, 7), (2e4, 0)])
def test_coordinates_have_as_many_decimals_as_the_scan_is_fine(spread, places):
    assert decimals(make_pair(50, spread=spread).target) == places


def test_no_negative_zero():
    assert vector(np.array([-0.0, -1e-9, -0.5]), 2) == "(0.00, 0.00, -0.50)"
