from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.benchmark.answers import FLOOR, SOLVED, Answer
from utopic_cli.benchmark.pair_metrics import MatchMeasures, OverlapMeasures, PoseMeasures
from utopic_cli.benchmark.synthetic_summary import summarise, wilson


def answer(
    number: int, rotation: float | None, translation: float = 0.0, stage: str = SOLVED, **more: object
) -> Answer:
    pose = None
    if rotation is not None:
        pose = PoseMeasures(
            rotation,
            translation,
            (rotation, 0.0, 0.0),
            (0.0, translation, 0.0),
            rotation < 5 or rotation == 180,
        )
    return Answer(number, "g", None, 0.5, 1.0, "m", stage, np.eye(4), pose=pose, **more)  # type: ignore[arg-type]


def test_wilson_intervals_against_published_values() -> None:
    half = wilson(5, 10)  # 0.2366 to 0.7634, a textbook value
    assert (half.low, half.high) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    none, all_of_them = wilson(0, 10), wilson(10, 10)
    assert (none.low, none.high) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert (all_of_them.low, all_of_them.high) == pytest.approx((0.7225, 1.0), abs=1e-4)
    with pytest.raises(ValueError, match="nothing"):
        wilson(0, 0)


def test_means_medians_and_the_papers_six() -> None:
    summary = summarise([answer(0, 0.5, 0.01), answer(1, 3.5, 0.03), answer(2, 2.0, 0.20)])
    assert summary.error_r == pytest.approx(2.0) and summary.error_r_median == 2.0
    assert summary.error_t == pytest.approx(0.08) and summary.error_t_median == 0.03
    # Over pairs and axes: each pair has one angle off out of three.
    assert summary.rmse_r == pytest.approx(np.sqrt((0.25 + 12.25 + 4.0) / 9))
    assert summary.mae_r == pytest.approx(6.0 / 9)
    assert summary.mae_t == pytest.approx(0.24 / 9)
    assert (summary.fine.count, summary.success.count) == (1, 2)
    assert summary.floor_ratio_r is None


def test_pairs_without_an_answer_fail_and_are_counted() -> None:
    summary = summarise([answer(0, 1.0), answer(1, None, message="no"), answer(2, 180.0)])
    assert (summary.pairs, summary.without_answer) == (3, 1)
    assert (summary.success.count, summary.success.of, summary.symmetric_success.count) == (1, 3, 2)
    assert summary.error_r == pytest.approx(90.5)
    assert summarise([answer(0, None)]).error_r is None


def test_the_ratio_to_the_floor_is_of_means() -> None:
    floor = [answer(0, 0.1, 0.001, FLOOR), answer(1, 0.3, 0.003, FLOOR)]
    summary = summarise([answer(0, 0.2, 0.004), answer(1, 0.4, 0.004)], floor)
    assert summary.floor_ratio_r == pytest.approx(1.5)
    assert summary.floor_ratio_t == pytest.approx(2.0)


def test_one_wild_failure_leaves_the_ratio_of_the_medians_alone() -> None:
    floor = [answer(pair, 0.1, 0.001, FLOOR) for pair in range(3)]
    summary = summarise([answer(0, 0.2), answer(1, 180.0), answer(2, 0.1)], floor)
    assert summary.floor_ratio_r_median == pytest.approx(2.0)
    assert summary.floor_ratio_r is not None and summary.floor_ratio_r > 100.0


def test_what_nobody_knows_stays_unknown() -> None:
    told = OverlapMeasures(0.8, None, 0.5, 0.7)
    also = OverlapMeasures(0.6, 0.4, 0.7, 0.5)
    summary = summarise(
        [
            answer(0, 1.0, matches=MatchMeasures(None, 0.2), first_overlap=told, cpu_seconds={"look": 1.0}),
            answer(1, 1.0, matches=MatchMeasures(0.5, 0.4), first_overlap=also, cpu_seconds={"look": 3.0}),
        ]
    )
    assert summary.hit_rate == 0.5 and summary.inlier_ratio == pytest.approx(0.3)
    assert summary.first_overlap is not None and summary.final_overlap is None
    assert summary.first_overlap.accuracy == pytest.approx(0.7)
    assert (summary.first_overlap.precision, summary.first_overlap.recall) == (0.4, pytest.approx(0.6))
    assert summary.cpu_seconds == {"look": 2.0}
