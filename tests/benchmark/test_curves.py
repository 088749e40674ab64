from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from utopic_cli.benchmark.answers import FLOOR, REFINED, Answer
from utopic_cli.benchmark.curve_report import CurveReport, by_overlap
from utopic_cli.benchmark.curves import (
    CLEAN,
    KEPT,
    PARAMETERS,
    QUOTED_OVERLAPS,
    CurveProtocol,
    SweepProtocol,
    cropped,
    with_density,
    with_noise,
    with_outliers,
    with_rotation,
)
from utopic_cli.benchmark.pair_metrics import PoseMeasures
from utopic_cli.benchmark.protocols import CropProtocol
from utopic_cli.benchmark.reports import render
from utopic_cli.benchmark.result_page import page
from utopic_cli.benchmark.synthetic import run
from utopic_cli.errors import UsageError
from utopic_cli.geometry.rigid import apply, relative_rotation_error_deg
from utopic_cli.synthesis.pairs import evaluation_pair
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.scan_pair import ScanPair
from utopic_cli.synthesis.shapes import ShapeLibrary, pack

FEW = replace(CLEAN, points=(2000, 2000))


@pytest.fixture(scope="module")
def shapes() -> ShapeLibrary:
    rng = np.random.default_rng(3)
    meshes = [procedural_mesh(rng, 32) for _ in range(3)]
    return pack(meshes, list("abc"), ["train", "val", "val"], ["one"] * 3)


@pytest.fixture(scope="module")
def clean(shapes: ShapeLibrary) -> ScanPair:
    return evaluation_pair(shapes, 5, 0, ((0.5, 0.9),), FEW, whole=True)


def test_noise_lies_along_the_rays_and_is_cut_off(clean: ScanPair) -> None:
    pair = with_noise(clean, 0.02, np.random.default_rng(1))
    for before, after, ray in (
        (clean.source, pair.source, clean.source_viewpoint),
        (clean.target, pair.target, clean.target_viewpoint),
    ):
        assert ray is not None
        error = (after.points - before.points) / clean.extent
        depth = error @ ray
        np.testing.assert_allclose(error, depth[:, None] * ray, atol=1e-12)
        assert depth.std() == pytest.approx(0.02, rel=0.1)
        assert np.abs(depth).max() <= 0.06 + 1e-12
    assert not np.any(with_noise(clean, 0.0, np.random.default_rng(1)).source.points - clean.source.points)


def test_density_thins_the_source_alone(clean: ScanPair) -> None:
    pair = with_density(clean, 5.0, np.random.default_rng(1))
    assert len(pair.source.points) == round(len(clean.source.points) / 5)
    assert pair.target is clean.target
    finer = with_density(clean, 2.0, np.random.default_rng(1))
    assert {*map(tuple, pair.source.points)} < {*map(tuple, finer.source.points)}


def test_outliers_take_the_place_of_as_many_points(clean: ScanPair) -> None:
    pair = with_outliers(clean, 0.2, np.random.default_rng(1))
    for before, after in ((clean.source, pair.source), (clean.target, pair.target)):
        moved = np.any(before.points != after.points, axis=1)
        assert moved.mean() == pytest.approx(0.2, abs=0.001)
        reach = np.linalg.norm(after.points[moved] - before.points[moved], axis=1)
        assert np.median(reach) > 0.02 * clean.extent


@pytest.mark.parametrize("degrees", [0.0, 30.0, 135.0, 180.0])
def test_rotation_is_as_asked_and_the_answer_still_right(clean: ScanPair, degrees: float) -> None:
    pair = with_rotation(clean, degrees, np.random.default_rng(1))
    assert relative_rotation_error_deg(pair.gt_T_target_source, np.eye(4)) == pytest.approx(degrees, abs=1e-5)
    for cloud in ("source", "object_points"):
        before, after = (getattr(one, cloud) for one in (clean, pair))
        if cloud == "source":
            before, after = before.points, after.points
        where, there = apply(clean.gt_T_target_source, before), apply(pair.gt_T_target_source, after)
        np.testing.assert_allclose(there, where, atol=1e-9)
    assert pair.target is clean.target


def test_levels_share_their_pairs_and_take_turns(shapes: ShapeLibrary) -> None:
    protocol = CurveProtocol(name="noise", pairs=FEW)
    levels = len(PARAMETERS["noise"].levels)
    first, second, other = (protocol.pair(shapes, 1, number) for number in (0, 1, levels))
    assert (first.shape, len(first.source.points)) == (second.shape, len(second.source.points))
    assert np.abs(first.source.points - second.source.points).max() > 0
    assert not np.array_equal(first.source.points[:100], other.source.points[:100])
    assert [protocol.group(number) for number in (0, 1, levels)] == ["0", "0.005", "0"]
    assert 0.5 <= first.smaller_overlap < 0.9
    with pytest.raises(UsageError, match="outliers"):
        CurveProtocol(name="weather")


@pytest.mark.parametrize("name", PARAMETERS)
def test_each_curve_is_defined_in_its_settings(name: str) -> None:
    protocol = CurveProtocol(name=name)
    settings = json.loads(json.dumps(protocol.settings()))
    assert settings["name"] == name and len(settings["levels"]) == len(protocol.groups)
    assert protocol.cleans and not SweepProtocol().cleans


@pytest.mark.parametrize("sampling", ["shared", "independent"])
def test_the_sweep_keeps_fewer_points_and_less_overlap(shapes: ShapeLibrary, sampling: str) -> None:
    protocol = SweepProtocol(sampling=sampling)
    overlaps = []
    for level, count in enumerate(KEPT):
        assert protocol.group(level) == f"{count} points"
        pair = protocol.pair(shapes, 2, level)
        assert len(pair.source.points) == len(pair.target.points) == count
        overlaps.append(pair.smaller_overlap)
        if sampling == "shared":
            assert pair.shared is not None and len(pair.shared) == pytest.approx(pair.smaller_overlap * count)
            there = apply(pair.gt_T_target_source, pair.source.points[pair.shared[:, 0]])
            assert np.abs(there - pair.target.points[pair.shared[:, 1]]).max() < 0.1 + 1e-9  # twice the clip
    assert overlaps == sorted(overlaps, reverse=True) and overlaps[-1] < overlaps[0] - 0.05


def test_the_mean_overlaps_are_about_the_papers(shapes: ShapeLibrary) -> None:
    whole = [CropProtocol("whole", 1.0, "shared", "euler45").pair(shapes, 7, number) for number in range(2)]
    for count, quoted in zip(KEPT, QUOTED_OVERLAPS, strict=True):
        pairs = [cropped(whole[draw % 2], count, np.random.default_rng(draw)) for draw in range(80)]
        assert np.mean([pair.smaller_overlap for pair in pairs]) == pytest.approx(quoted, abs=0.03)


def test_crops_are_nearest_to_viewpoints_on_opposite_sides(shapes: ShapeLibrary) -> None:
    for number in range(0, 40, len(KEPT)):
        pair = SweepProtocol().pair(shapes, 7, number)
        # Both keep more than half, so opposite sides overlap by (2 k - n) / k at least.
        assert pair.smaller_overlap >= (2 * KEPT[0] - 1024) / KEPT[0] - 1e-9
        assert pair.smaller_overlap < 0.9


def _report(name: str, groups: tuple[str, ...], levels: list[float]) -> CurveReport:
    protocol = {
        "name": name, "levels": levels, "level_means": "sigma", "length_unit": "extent",
        "translation_error": "there",
    }  # fmt: skip
    settings = {
        "protocol": protocol, "data": "a <b> & [c]", "split": "val", "shapes": 2, "pairs": 4, "seed": 0,
    }  # fmt: skip
    answers = []
    for number in range(4):
        right = number != 3
        pose = PoseMeasures(0.5 if right else 90.0, 0.01, (0.1,) * 3, (0.01,) * 3, right)
        about = (number, groups[number % 2], "a", 0.35 + 0.3 * (number % 2), 1.0)
        answers += [
            Answer(*about, "floor", FLOOR, np.eye(4), np.eye(4), pose),
            Answer(*about, "utopic", REFINED, np.eye(4), np.eye(4), pose),
        ]
        if number == 0:
            answers.append(Answer(*about, "fpfh", REFINED, np.eye(4), message="none"))
    return CurveReport(settings, groups, tuple(answers))


def test_a_curve_is_told_by_level_in_table_json_and_page() -> None:
    report = _report("noise", ("0", "0.01"), [0.0, 0.01])
    curve = report.curve()["utopic", REFINED]
    assert [place for place, _ in curve] == [0.0, 0.01]
    assert [row.success.share for _, row in curve] == [1.0, 0.5]
    out = io.StringIO()
    render(report, Console(file=out, width=200))
    assert "50.0%" in out.getvalue() and "fpfh: no answer to 1 of the pairs: none" in out.getvalue()
    assert len(json.loads(report.to_json())["summary"]) == 5
    text = page(report)
    assert text.count("<svg") == 2 and "a &lt;b&gt; &amp; [c]" in text and "fpfh: no answer" in text
    assert "http" not in text and "<script" not in text and "{{" not in text


def test_the_sweep_is_also_told_by_the_overlap_of_each_pair() -> None:
    report = _report("overlap-sweep", ("768 points", "560 points"), [768, 560])
    assert [place for place, _ in report.curve()["utopic", REFINED]] == pytest.approx([0.35, 0.65])
    rows = by_overlap(report.answers)
    assert [(row.pairs, row.success.count) for _, row in rows["utopic", REFINED]] == [(2, 2), (2, 1)]
    assert ("floor", FLOOR) not in rows
    assert len(report.tables()) == 2 and page(report).count("<svg") == 3


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("noise", [0.0, 0.005]),
        ("density", [1.0, 2.0]),
        ("outliers", [0.0, 0.05]),
        ("rotation", [0.0, 30.0]),
        ("overlap-sweep", None),
    ],
)
def test_a_tiny_run_ends_in_a_curve(shapes: ShapeLibrary, name: str, places: list[float] | None) -> None:
    sweep = places is None
    protocol = SweepProtocol() if sweep else CurveProtocol(name=name, pairs=FEW)
    told = []
    report = run(
        protocol, shapes, "test", pairs=2, weights=(), baselines=("fpfh",), points=200,
        progress=lambda *words: told.append(words),
    )  # fmt: skip
    assert isinstance(report, CurveReport) and report.settings["protocol"]["name"] == name
    found = [place for place, _ in report.curve()["fpfh", REFINED]]
    assert (len(found) == 2 and 1 > found[0] > found[1] > 0.3) if sweep else found == places
    assert told[-1][:2] == (2, 2)
    assert page(report).count('class="place s0"') >= 2


def test_a_curve_with_one_step_shows_it() -> None:
    whole = _report("noise", ("0", "0.01"), [0.0, 0.01])
    first = CurveReport(whole.settings, whole.groups, whole.answers[:2])
    assert [len(points) for points in first.curve().values()] == [1, 1]
    assert page(first).count('class="place s0"') == 2 and "no answers" not in page(first)
