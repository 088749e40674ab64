from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from utopic_cli.benchmark import synthetic
from utopic_cli.benchmark.answers import FLOOR, REFINED, SOLVED, answer_pair
from utopic_cli.benchmark.contestants import Contestants
from utopic_cli.benchmark.curves import PARAMETERS, CurveProtocol, SweepProtocol
from utopic_cli.benchmark.fpfh import Fpfh
from utopic_cli.benchmark.held_out import held_out
from utopic_cli.benchmark.method import Trial
from utopic_cli.benchmark.protocols import AnyProtocol, CropProtocol, RangeProtocol, RoomProtocol
from utopic_cli.benchmark.reports import render
from utopic_cli.benchmark.result_page import page
from utopic_cli.benchmark.synthetic import Report, run
from utopic_cli.bridge import NetworkView
from utopic_cli.errors import InputError, UsageError
from utopic_cli.estimation.prior import ANYWHERE
from utopic_cli.geometry.rigid import apply, rigid
from utopic_cli.preprocess import prepare
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.shapes import ShapeLibrary, pack
from utopic_cli.synthesis.surface_pairs import surface_pair

SHARED = CropProtocol("modelnet", 0.7, "shared", "euler45")
SCANS = RangeProtocol(bands=((0.5, 0.9),), pairs=replace(PairSettings(), points=(2000, 3000)))


@pytest.fixture(scope="module")
def shapes() -> ShapeLibrary:
    rng = np.random.default_rng(3)
    meshes = [procedural_mesh(rng, 32) for _ in range(3)]
    return pack(meshes, list("abc"), ["train", "val", "val"], ["one"] * 3)


class Oracle:
    """Knows the matches, and changes its mind about overlap once it is shown a transformation."""

    name, tells_overlap, looks_again = "oracle", True, True

    def __init__(self, gt: np.ndarray) -> None:
        self.gt = gt

    def settings(self) -> dict[str, str]:
        return {}

    def look(self, prepared) -> NetworkView:
        return self.told(prepared, 0.0)

    def look_again(self, prepared, first, hypothesis, odds) -> NetworkView:
        assert hypothesis.shape == (4, 4) and np.isfinite(odds) and not first.source_overlap.any()
        return self.told(prepared, 1.0)

    def told(self, prepared, overlap: float) -> NetworkView:
        moved = apply(prepared.normalise(self.gt), prepared.source.points)
        distance = np.linalg.norm(moved[:, None] - prepared.target.points[None], axis=2)
        scores = np.exp(-0.5 * (distance / (0.3 * prepared.spacing)) ** 2)
        n, m = scores.shape
        both = np.full(n, overlap), np.full(m, overlap)
        return NetworkView(scores, *both, np.zeros(n), np.zeros(m), np.zeros(n), np.zeros(m))


def test_an_oracle_is_measured_as_one(shapes: ShapeLibrary) -> None:
    pair = SCANS.pair(shapes, 0, 0)
    oracle = Oracle(pair.gt_T_target_source)
    solved, refined = answer_pair(pair, 0, SCANS, Contestants((oracle,)), 400)
    assert (solved.stage, refined.stage, solved.group) == (SOLVED, REFINED, "0.5-0.9")
    for answer in (solved, refined):
        assert answer.pose is not None and answer.pose.within((5.0, 0.05)) and answer.pose.symmetric
        assert answer.matches is not None and answer.matches.hit_rate == 1.0
        first, final = answer.first_overlap, answer.final_overlap
        assert first is not None and final is not None
        assert (first.recall, final.recall) == (0.0, 1.0)
        assert first.accuracy == pytest.approx(1.0 - final.accuracy)
    assert solved.cpu_seconds.keys() == {"look", "solve", "look_again"}
    assert refined.cpu_seconds.keys() == {"look", "solve", "refine", "look_again"}


def test_the_floor_of_a_pair_without_noise_is_zero(shapes: ShapeLibrary) -> None:
    clean = surface_pair(shapes.mesh(1), np.random.default_rng(0), "shared", 0.7, noise=0.0, whole=True)
    (floor,) = answer_pair(clean, 0, SHARED, Contestants(), 1024)
    assert floor.stage == FLOOR and floor.pose is not None
    assert floor.pose.rotation_deg < 1e-5 and floor.pose.translation < 1e-9
    noisy = SHARED.pair(shapes, 0, 0)
    (floor,) = answer_pair(noisy, 0, SHARED, Contestants(), 1024)
    assert floor.pose is not None and 0.01 < floor.pose.rotation_deg < 1.0


def test_scores_that_lead_nowhere_are_a_counted_failure(shapes: ShapeLibrary) -> None:
    class Blind(Oracle):
        name, tells_overlap, looks_again = "blind", False, False

        def look(self, prepared) -> NetworkView:
            view = super().look(prepared)
            return replace(view, matching_scores=np.zeros_like(view.matching_scores))

    pair = SHARED.pair(shapes, 0, 0)
    blind = Contestants((Blind(pair.gt_T_target_source),))
    floor, solved, refined = answer_pair(pair, 0, SHARED, blind, 1024)
    for answer in (solved, refined):
        assert answer.pose is None and answer.message
    report = Report(settings_of(SHARED), SHARED.groups, (floor, solved, refined))
    summary = report.summaries()["keep 0.7", "blind", SOLVED]
    assert (summary.without_answer, summary.success.count) == (1, 0)
    assert "blind: no answer to 1 of the pairs" in printed(report)
    json.loads(report.to_json())


def settings_of(protocol: AnyProtocol) -> dict[str, object]:
    return {
        "protocol": protocol.settings(),
        "data": "some [shapes]",
        "split": "val",
        "shapes": 2,
        "pairs": 1,
        "seed": 0,
    }


def printed(report: Report) -> str:
    text = io.StringIO()
    render(report, Console(file=text, width=170))
    return text.getvalue()


def without_times(report: Report) -> list[dict[str, object]]:
    return [{**answer.to_dict(), "cpu_seconds": None} for answer in report.answers]


OPTIONS = {"pairs": 2, "seed": 1, "points": 200, "device": "cpu", "workers": 2}


def test_a_tiny_run_gives_the_same_for_any_number_of_workers(shapes: ShapeLibrary) -> None:
    seen: list[tuple[int, int]] = []
    two = run(SHARED, shapes, "tiny", **OPTIONS, progress=lambda done, of, what: seen.append((done, of)))
    one = run(SHARED, shapes, "tiny", **{**OPTIONS, "workers": 1})
    assert without_times(one) == without_times(two)
    assert seen == [(0, 2), (1, 2), (2, 2)]
    check_report(one, SHARED)


def test_a_tiny_run_on_range_scans(shapes: ShapeLibrary) -> None:
    check_report(run(SCANS, shapes, "tiny", **OPTIONS), SCANS)


def test_a_tiny_run_on_rooms(shapes: ShapeLibrary) -> None:
    rooms = RoomProtocol(pairs=replace(PairSettings(), room_points=(2000, 3000)))
    report = run(rooms, shapes, "tiny", **{**OPTIONS, "pairs": 1, "workers": 1})
    assert [(answer.group, answer.shape) for answer in report.answers] == [("rooms", "room")] * 2
    assert "lengths in: extent of the scene" in " ".join(printed(report).split())


@pytest.mark.parametrize(
    "protocol",
    [
        CropProtocol("modelonet", 0.5, "shared", "euler45"),
        CropProtocol("scanobjectnn", 0.7, "shared", "euler45"),
        CropProtocol("detail", 0.7, "independent", "uniform", points=5000, relief=0.04),
    ],
    ids=lambda protocol: protocol.name,
)
def test_a_tiny_run_of_the_other_crops(shapes: ShapeLibrary, protocol: CropProtocol) -> None:
    report = run(protocol, shapes, "tiny", **{**OPTIONS, "pairs": 1, "workers": 1})
    assert "1 pair of 2 'val' shapes" in report.title and report.title.startswith(protocol.name)
    stages = [FLOOR] * (protocol.sampling == "shared") + [SOLVED, REFINED]
    assert [answer.stage for answer in report.answers] == stages
    assert ("UTOPIC (quoted)" in printed(report)) == (protocol.name != "detail")


def check_report(one: Report, protocol: CropProtocol | RangeProtocol) -> None:
    content = json.loads(one.to_json())
    assert content["protocol"]["name"] == protocol.name and content["shapes"] == 2
    assert len(content["methods"]["utopic"]["weights_sha256"]) == 64
    stages = [SOLVED, REFINED] if protocol is SCANS else [FLOOR, SOLVED, REFINED]
    assert [answer["stage"] for answer in content["answers"]] == stages * 2
    assert {answer["shape"] for answer in content["answers"]} <= {
        "b",
        "c",
    }  # never one of the training shapes
    assert [row["stage"] for row in content["summary"]] == stages
    assert ("UTOPIC" in content["quoted"]) == (protocol is SHARED)

    text = printed(one)
    assert "2 pairs of 2 'val' shapes, tiny" in text
    assert f"weights utopic (sha256 {content['methods']['utopic']['weights_sha256'][:12]})" in text
    assert "only 2 pairs: too few to mean much" in text
    assert ("no lower bound" in text) == (protocol is SHARED)
    assert ("(not the paper's data)" in text) == (protocol is SHARED)
    assert ("UTOPIC (quoted)" in text) == ("statistical floor" in text) == (protocol is SHARED)


def test_only_shapes_held_out_are_measured_on(shapes: ShapeLibrary) -> None:
    assert held_out(shapes)[0].names.tolist() == ["b", "c"]
    tests = replace(shapes, splits=np.array(["train", "val", "test"]))
    assert held_out(tests)[1] == "test" and held_out(tests)[0].names.tolist() == ["c"]
    with pytest.raises(InputError, match="no 'val' shapes"):
        held_out(replace(shapes, splits=np.array(["train"] * 3)))


def test_shapes_that_make_no_pair_end_the_run(shapes: ShapeLibrary) -> None:
    flat = pack([(np.zeros((3, 3)), np.array([[0, 1, 2]]))], ["flat"], ["val"], ["one"])
    with pytest.raises(InputError, match="tiny: no usable pair"):
        synthetic.answers_to(SHARED, flat, "tiny", 0, 100, ANYWHERE, Contestants(), 0)


def test_numbers_that_make_no_sense(shapes: ShapeLibrary) -> None:
    for wrong in ({"pairs": 0}, {"workers": 0}, {"seed": -1}):
        with pytest.raises(UsageError, match="at least 1"):
            run(SHARED, shapes, "tiny", **wrong)


def test_fpfh_is_measured_beside(shapes: ShapeLibrary) -> None:
    pytest.importorskip("open3d")
    pair = SCANS.pair(shapes, 0, 0)
    solved, _ = answer_pair(pair, 0, SCANS, Contestants((Fpfh(),)), 400)
    assert solved.first_overlap is None and solved.final_overlap is None
    assert solved.cpu_seconds.keys() == {"look", "solve"}
    assert len(prepare(pair.source, pair.target, 400).source.points) <= 400
    assert solved.matches is not None and solved.matches.hit_rate is not None
    assert solved.matches.hit_rate > 0.05


class Off:
    """A whole method that is off by a known angle and shift, at the source's origin."""

    name, refines = "off", False

    def __init__(self, gt: np.ndarray, degrees: float = 0.0) -> None:
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        self.answer = gt @ rigid(turn, np.array([0.03, 0.0, 0.0]))

    def settings(self) -> dict[str, str]:
        return {"start": "identity"}

    def estimate(self, trial: Trial) -> np.ndarray:
        if trial.seed < 0 or trial.extent <= 0:
            raise AssertionError("not the trial that was meant")
        return self.answer


def test_a_whole_method_is_measured_as_it_answers_and_refined(shapes: ShapeLibrary) -> None:
    pair = SHARED.pair(shapes, 0, 0)
    off = Contestants(methods=(Off(pair.gt_T_target_source, 3.0),))
    floor, own, refined = answer_pair(pair, 0, SHARED, off, 1024)
    assert (own.method, own.stage, own.matches, own.first_overlap) == ("off", SOLVED, None, None)
    assert own.pose is not None and refined.pose is not None and floor.pose is not None
    assert own.pose.rotation_deg == pytest.approx(3.0, abs=1e-6)
    assert own.pose.translation == pytest.approx(0.03, abs=1e-9)
    assert refined.pose.rotation_deg < 1.5
    assert own.cpu_seconds.keys() == {"method"} and refined.cpu_seconds.keys() == {"method", "refine"}
    settings = {**settings_of(SHARED), "methods": off.settings()}
    text = printed(Report(settings, SHARED.groups, (floor, own, refined)))
    assert "off + refinement" in text and "off: local; started from the identity" in text
    assert text.count("│ off") + text.count("off  ") >= 2  # poses and the paper's metrics, not the matches


@pytest.mark.parametrize(
    "wrong", [np.full((4, 4), np.nan), np.eye(3), RuntimeError("lost its way")], ids=["nan", "3x3", "raises"]
)
def test_what_a_method_does_wrong_is_its_failure(shapes: ShapeLibrary, wrong: object) -> None:
    class Wrong(Off):
        def estimate(self, trial: Trial) -> np.ndarray:
            if isinstance(wrong, Exception):
                raise wrong
            return wrong  # type: ignore[return-value]

    pair = SHARED.pair(shapes, 0, 0)
    _, own, refined = answer_pair(pair, 0, SHARED, Contestants(methods=(Wrong(np.eye(4)),)), 1024)
    assert own.pose is None and refined.pose is None and own.message == refined.message
    assert "Error" in str(own.message)


TINY_RELIEF = CropProtocol("detail", 0.7, "shared", "euler45", points=5000, relief=0.04)


@pytest.mark.parametrize(
    ("protocol", "words"),
    [
        (CropProtocol("modelonet", 0.5, "independent", "uniform"), "keep 0.5"),
        (CropProtocol("scanobjectnn", 0.7, "shared", "euler45"), "ScanObjectNN in F"),
        (TINY_RELIEF, "with relief added"),
        (SweepProtocol(), "quoted overlaps: about 0.69, 0.58, 0.47, 0.4, 0.32"),
        *((CurveProtocol(name=name, pairs=SCANS.pairs), "under 5 degrees") for name in PARAMETERS),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_tiny_run_of_each_protocol(shapes: ShapeLibrary, protocol: AnyProtocol, words: str) -> None:
    """Pairs, measures, tables, JSON and page, with a method that knows the answer."""
    answers = []
    for number in range(2):
        gt = protocol.pair(shapes, 3, number).gt_T_target_source
        exact = Contestants(methods=(Off(gt),))
        answers += synthetic.answers_to(protocol, shapes, "tiny", 3, 300, ANYWHERE, exact, number)
    data = "scanobjectnn:F" if protocol.name == "scanobjectnn" else "tiny"
    settings = {**settings_of(protocol), "data": data, "pairs": 2, "methods": {}}
    kind = synthetic.CurveReport if "levels" in protocol.settings() else Report
    report = kind(settings, protocol.groups, tuple(answers))
    own = [
        row for (_, method, stage), row in report.summaries().items() if (method, stage) == ("off", SOLVED)
    ]
    assert sum(row.success.count for row in own) == sum(row.pairs for row in own) == 2
    content = json.loads(report.to_json())
    assert content["protocol"]["name"] == protocol.name
    assert ("UTOPIC" in content["quoted"]) == (protocol.name in ("modelonet", "scanobjectnn"))
    assert ("floor" in {answer["method"] for answer in content["answers"]}) == (
        protocol.settings().get("sampling") == "shared"
    )
    text = " ".join(printed(report).split())
    assert words in text and protocol.name in text
    assert ("(not the paper's data)" in text) == (protocol.name == "modelonet")
    page_text = page(report)
    assert "<svg" in page_text and "{{" not in page_text and "http" not in page_text


def test_the_papers_overlap_accuracy_stands_beside_ours(shapes: ShapeLibrary) -> None:
    pair = SCANS.pair(shapes, 0, 0)
    answers = answer_pair(pair, 0, SCANS, Contestants((Oracle(pair.gt_T_target_source),)), 400)
    renamed = tuple(replace(answer, group=SHARED.groups[0]) for answer in answers)
    report = Report(settings_of(SHARED), SHARED.groups, renamed)
    assert "0.965 / - / -" in printed(report)
    assert json.loads(report.to_json())["quoted_overlap_accuracy"]["UTOPIC"] == 0.9646


@pytest.mark.slow
def test_methods_that_start_processes_run_in_workers_too(shapes: ShapeLibrary) -> None:
    """KISS-Matcher is kept in a process of its own, which a daemon may not have."""
    pytest.importorskip("kiss_matcher")
    report = run(SCANS, shapes, "tiny", pairs=1, weights=(), baselines=("kiss-matcher",), points=200)
    assert not any("daemon" in str(answer.message) for answer in report.answers)
    assert report.answers[0].cpu_seconds["method"] > 0
