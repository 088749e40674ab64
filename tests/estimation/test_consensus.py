from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.estimation.consensus import consensus_hypotheses, distinct
from utopic_cli.geometry import rigid


def contaminated(seed: int, outliers: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    gt = rigid.rigid(rigid.random_rotation(rng), rng.normal(size=3))
    source = rng.uniform(-1, 1, (1000, 3))
    target = rigid.apply(gt, source) + rng.normal(0, 0.01, (1000, 3))
    wrong = rng.permutation(1000)[: int(1000 * outliers)]
    target[wrong] = rigid.apply(gt, rng.uniform(-1, 1, (len(wrong), 3)))
    return source, target, gt


@pytest.mark.parametrize("seed", range(3))
def test_finds_the_transformation_among_nine_tenths_outliers(seed: int) -> None:
    source, target, gt = contaminated(seed, 0.9)
    best = consensus_hypotheses(source, target, np.ones(1000), 0.05)[0]
    assert rigid.relative_rotation_error_deg(best.T_target_source, gt) < 1.0
    assert rigid.relative_translation_error(best.T_target_source, gt) < 0.01
    assert 60 < best.score < 160  # about the 100 right ones support it


def test_same_input_same_output() -> None:
    source, target, _ = contaminated(1, 0.95)
    first = consensus_hypotheses(source, target, np.ones(1000), 0.05)
    second = consensus_hypotheses(source.copy(), target.copy(), np.ones(1000), 0.05)
    assert [h.score for h in first] == [h.score for h in second]
    assert all(
        np.array_equal(a.T_target_source, b.T_target_source) for a, b in zip(first, second, strict=True)
    )


def test_hypotheses_are_sorted_distinct_and_limited() -> None:
    source, target, _ = contaminated(2, 0.97)
    found = consensus_hypotheses(source, target, np.ones(1000), 0.1, limit=15)
    assert 2 <= len(found) <= 15
    assert [h.score for h in found] == sorted((h.score for h in found), reverse=True)
    transformations = np.stack([h.T_target_source for h in found])
    assert len(distinct(transformations, source.mean(axis=0), 0.32)) == len(found)
    assert all(rigid.is_rigid(T) for T in transformations)


def test_a_doubled_object_gives_two_hypotheses() -> None:
    rng = np.random.default_rng(0)
    source = rng.uniform(-1, 1, (100, 3))
    first = rigid.rigid(rigid.random_rotation(rng), np.array([3.0, 0.0, 0.0]))
    second = rigid.rigid(rigid.random_rotation(rng), np.array([-3.0, 0.0, 0.0]))
    target = np.concatenate([rigid.apply(first, source[:50]), rigid.apply(second, source[50:])])
    found = consensus_hypotheses(source, target, np.ones(100), 0.05)[:2]
    for gt in (first, second):
        assert min(np.abs(h.T_target_source - gt).max() for h in found) < 1e-6


def test_normals_tell_two_sides_of_a_sheet_apart() -> None:
    rng = np.random.default_rng(3)
    sheet = np.column_stack([rng.uniform(-1, 1, (60, 2)), np.zeros(60)])
    up = np.tile([0.0, 0.0, 1.0], (60, 1))
    turned = rigid.rigid(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))  # half a turn about y
    target = rigid.apply(turned, sheet)
    assert consensus_hypotheses(sheet, target, np.ones(60), 0.05)[0].score > 50
    against = consensus_hypotheses(sheet, target, np.ones(60), 0.05, 40, up, up)
    assert not against or against[0].score < 10
    along = consensus_hypotheses(sheet, target, np.ones(60), 0.05, 40, up, up @ turned[:3, :3].T)
    assert np.abs(along[0].T_target_source - turned).max() < 1e-6


def test_nothing_consistent_gives_nothing() -> None:
    line = np.outer(np.linspace(0, 1, 20), [1.0, 0.0, 0.0])
    assert consensus_hypotheses(line, line * 5.0, np.ones(20), 1e-3) == []
    assert consensus_hypotheses(line, line, np.ones(20), 0.01) == []  # collinear: no rotation


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="three"):
        consensus_hypotheses(np.eye(3)[:2], np.eye(3)[:2], np.ones(2), 0.1)
    with pytest.raises(ValueError, match="tolerance"):
        consensus_hypotheses(np.eye(3), np.eye(3), np.ones(3), 0.0)


def test_distinct_keeps_what_no_better_one_kept_stands_for() -> None:
    rng = np.random.default_rng(8)
    transformations = np.stack(
        [
            rigid.rigid(rigid.rotation_from_vector(rng.uniform(-0.3, 0.3, 3)), rng.uniform(-0.2, 0.2, 3))
            for _ in range(60)
        ]
    )
    centre = np.array([0.5, -1.0, 2.0])
    kept: list[int] = []
    for i, T in enumerate(transformations):
        if not any(
            np.linalg.norm(rigid.apply(T, centre) - rigid.apply(transformations[j], centre)) < 0.5
            and rigid.relative_rotation_error_deg(T, transformations[j]) < 12.0
            for j in kept
        ):
            kept.append(i)
    assert 5 < len(kept) < 55
    assert distinct(transformations, centre, 0.5, 12.0).tolist() == kept
