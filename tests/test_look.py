"""When to look again, and what two looks at one pair make together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from utopic_cli.bridge import NetworkView
from utopic_cli.errors import InputError
from utopic_cli.estimation.candidates import Candidate
from utopic_cli.estimation.evidence import SAME
from utopic_cli.estimation.meeting import Meeting
from utopic_cli.estimation.solver import SURE, Estimate
from utopic_cli.estimation.surface import Surface, make_surface
from utopic_cli.geometry import rigid
from utopic_cli.look import Look, look, look_both_sides
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import PreparedPair, prepare
from utopic_cli.result import Correspondences
from utopic_cli.synthesis.demo_object import demo_pair


@pytest.fixture(scope="module")
def prepared() -> PreparedPair:
    pair = demo_pair(np.random.default_rng(0), points=3000)
    return prepare(pair.source, pair.target, 200)


def answering(prepared: PreparedPair, score: float, rival: float | None, support: float = 0.2) -> Look:
    """A look whose answer and rival have these scores, all else alike."""

    def candidate(value: float, T: np.ndarray) -> Candidate:
        # The better it scores the closer it lies, so that its standing is as far ahead as its score.
        meeting = Meeting(1.0, 1.0, 1.0, 1.0, 0.0, 1.0 - value, 0.0, 0.0, 0.0, 0.0)
        return Candidate(T, value, value, 0.0, "consensus", support, meeting)

    turn = rigid.rigid(rigid.rotation_from_vector(np.array([0.0, 0.0, 2.0])), np.zeros(3))
    rivals = () if rival is None else (candidate(rival, turn),)
    empty = np.empty(0, dtype=np.int64)
    nobody = Correspondences(empty, empty, np.empty(0))
    estimate = Estimate(candidate(score, np.eye(4)), rivals, 40, nobody, "consensus")
    view = blind(prepared)
    return Look(prepared, view, estimate, surfaces_of(prepared))


def surfaces_of(prepared: PreparedPair) -> tuple[Surface, Surface]:
    return tuple(make_surface(scan.dense, 0.05) for scan in (prepared.source, prepared.target))  # type: ignore[return-value]


def blind(prepared: PreparedPair) -> NetworkView:
    """What sees nothing in particular says."""
    n, m = len(prepared.source.points), len(prepared.target.points)
    halves = np.full(n, 0.5), np.full(m, 0.5)
    return NetworkView(np.full((n, m), 1.0 / m), *halves, *halves, *halves)


@pytest.mark.parametrize(
    ("rival", "support", "unclear"),
    [
        (0.35, 0.2, True),
        (None, 0.2, False),  # alone
        (-0.1, 0.2, False),  # far ahead
        (0.495, 0.2, False),  # two poses fit alike: another sampling can't tell them apart
        (0.35, 0.01, False),  # explains nothing
    ],
)
def test_only_an_answer_in_doubt_is_worth_another_sampling(
    prepared: PreparedPair, rival: float | None, support: float, unclear: bool
) -> None:
    seen = answering(prepared, 0.5, rival, support)
    assert seen.unclear is unclear
    shared = replace(seen, estimate=replace(seen.estimate, shared_points=True))
    assert (seen.estimate.odds, shared.estimate.odds) == (0.0, SURE)
    assert not shared.unclear


def test_the_better_of_two_looks_is_kept_and_the_other_is_its_rival(prepared: PreparedPair) -> None:
    worse, better = answering(prepared, 0.3, None), answering(prepared, 0.5, None)
    turned = rigid.rigid(rigid.rotation_from_vector(np.array([1.5, 0.0, 0.0])), np.zeros(3))
    worse = replace(
        worse,
        estimate=replace(worse.estimate, best=replace(worse.estimate.best, T_target_source=turned)),
    )
    for joined in (worse.joined(better), better.joined(worse)):
        assert joined.estimate.score == 0.5
        assert [rival.score for rival in joined.estimate.rivals] == [0.3]
        assert joined.estimate.margin == pytest.approx(0.2)


def test_spread_is_the_log_of_how_far_answers_are_apart(prepared: PreparedPair) -> None:
    one = answering(prepared, 0.5, None)
    assert one.spread(one) == SAME
    for shift, spread in ((0.01, -2.0), (0.1, -1.0), (50.0, 0.0)):
        moved = rigid.rigid(np.eye(3), np.array([shift, 0.0, 0.0]))
        best = replace(one.estimate.best, T_target_source=moved)
        other = replace(one, estimate=replace(one.estimate, best=best))
        assert one.spread(other) == pytest.approx(spread) == other.spread(one)


def test_normals_on_the_wrong_side_are_turned(prepared: PreparedPair) -> None:
    # An oracle that matches nodes by place, whatever their normals: only verification sees the sides.
    gt = demo_pair(np.random.default_rng(0), points=3000).gt_T_target_source
    moved = rigid.apply(prepared.normalise(gt), prepared.source.points)
    apart = np.linalg.norm(moved[:, None] - prepared.target.points[None], axis=2)

    def oracle(pair: PreparedPair) -> NetworkView:
        return replace(blind(pair), matching_scores=np.exp(-((apart / prepared.spacing) ** 2)))

    wrong = replace(prepared, source=prepared.source.turned_inside_out())
    assert look(oracle, wrong).sides_in_doubt
    mended = look_both_sides(oracle, wrong)
    assert mended.inside_out and mended.estimate.score > 0.3
    assert not look_both_sides(oracle, prepared).inside_out


def test_a_pair_nothing_follows_from_is_an_input_error() -> None:
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.standard_normal((400, 3)))
    pair = prepare(cloud, cloud, 100)

    def see(pair: PreparedPair) -> NetworkView:
        nothing = blind(pair)
        return replace(nothing, matching_scores=np.zeros_like(nothing.matching_scores))

    with pytest.raises(InputError, match="no transformation can be found"):
        look(see, pair, "consensus")


def test_scans_that_face_each_other_outrank_nothing_and_are_no_rivals(prepared: PreparedPair) -> None:
    """Two sheets with their normals on opposite sides lie on each other closely, and agree nowhere."""
    plain, close = answering(prepared, 0.3, None), answering(prepared, 0.9, None)
    best = close.estimate.best
    assert close.estimate.outranks(plain.estimate) and best.meeting is not None
    facing = replace(
        best,
        T_target_source=rigid.rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3)),
        meeting=replace(best.meeting, likeness=0.0),
    )
    other = replace(close, estimate=replace(close.estimate, best=facing))
    assert not other.estimate.outranks(plain.estimate)
    joined = plain.joined(other).estimate
    assert joined.best is plain.estimate.best and joined.rivals == (facing,) and joined.margin == 1.0
