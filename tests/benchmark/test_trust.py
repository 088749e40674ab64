from __future__ import annotations

import json
from html.parser import HTMLParser

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from utopic_cli.benchmark import trust
from utopic_cli.benchmark.labelled import Trial
from utopic_cli.benchmark.trust_page import page
from utopic_cli.benchmark.trust_report import Outcome, TrustReport, hindsight, render
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.geometry.rigid import random_rotation, rigid
from utopic_cli.io.scan import read_scan
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import Correspondences, FitMeasures, RegistrationResult
from utopic_cli.synthesis.shapes import ShapeLibrary, pack

KINDS = ("scans", "disjoint")


@pytest.fixture(scope="module")
def shapes() -> ShapeLibrary:
    triangle = (np.eye(3), np.array([[0, 1, 2]]))
    return pack([triangle] * 12, [f"shape {i}" for i in range(12)], ["val"] * 12, ["one"] * 12)


def small_trial(library, seed, number):
    """Even ones have an answer, odd ones none."""
    rng = np.random.default_rng([seed, number])
    cloud = PointCloud(rng.standard_normal((60, 3)))
    answer = None if number % 2 else rigid(random_rotation(rng), rng.standard_normal(3))
    return Trial(
        KINDS[number % 2], cloud, cloud, answer, 5.0, 0.5 * (answer is not None), f"thing <{number}>"
    )


def result_with(T, confidence, trusted):
    ones = np.ones(60, np.float32)
    return RegistrationResult(
        T_target_source=T, confidence=confidence, trusted=trusted, reasons=("so & so",), ambiguous_with=(),
        source_overlap=ones, target_overlap=ones, source_uncertainty=ones, target_uncertainty=ones,
        raw_uncertainty={}, correspondences=Correspondences(np.arange(3), np.arange(3), np.ones(3)),
        fit=FitMeasures({"source": 1.0, "target": 1.0}, 1.0, 0.0, {}, 0.1), observability=None, timings_s={},
    )  # fmt: skip


class Oracle:
    """Knows the answers, is right on every trial that has one but number 4, and never sure of wrong ones."""

    def __init__(self, fails=(), confidence=True):
        self.fails, self.confidence, self.number = fails, confidence, -1

    def __call__(self, source, target, options):
        self.number = next(
            n for n in range(50) if np.array_equal(small_trial(None, 0, n).source.points, source.points)
        )
        if self.number in self.fails:
            raise InputError("no transformation can be found between these scans")
        made = small_trial(None, 0, self.number)
        right = made.gt_T_target_source is not None and self.number != 4
        T = made.gt_T_target_source if right else rigid(np.eye(3), np.full(3, 9.0))
        if not self.confidence:
            return result_with(T, None, None)
        return result_with(T, 0.9 + 0.001 * self.number if right else 0.2, right or self.number == 7)


@pytest.fixture
def protocol(monkeypatch, shapes):
    """The protocol with a registration of the test's own, in this process."""

    def run(oracle, **options):
        monkeypatch.setattr(trust, "trial", small_trial)
        monkeypatch.setattr(trust, "register", oracle)
        monkeypatch.setattr(trust, "load_weights", lambda name: (None, {"name": name, "sha256": "ab" * 32}))

        def in_this_process(make_task, count, workers, progress):
            task = make_task()
            progress(0, count)
            return [task(number) for number in range(count)]

        monkeypatch.setattr(trust, "each", in_this_process)
        return trust.run(shapes, "some shapes", **options)

    return run


def test_a_run_judges_every_trial(protocol):
    told = []
    report = protocol(Oracle(fails=(2,)), pairs=10, progress=lambda *said: told.append(said))
    assert told == [(0, 10, f"confidence, {report.settings['data']}")]
    assert [one.number for one in report.outcomes] == list(range(10))
    assert [one.right for one in report.outcomes] == [n in (0, 6, 8) for n in range(10)]
    failed = report.outcomes[2]
    assert (failed.confidence, failed.trusted, failed.answerable, failed.rotation_deg) == (
        0.0,
        False,
        True,
        None,
    )
    assert "no transformation" in failed.reasons[0]
    lost = report.outcomes[4]
    assert lost.translation_share is not None and lost.translation_share > 1.0
    assert report.outcomes[1].rotation_deg is None  # nothing to compare with
    kinds = report.kinds()
    assert (kinds["scans"].trials, kinds["scans"].right, kinds["scans"].accepted_right) == (5, 3, 3)
    assert (kinds["disjoint"].right, kinds["disjoint"].accepted_wrong) == (0, 1)
    summary = report.summary
    assert summary.auroc == 1.0
    assert summary.accepted.wrong is not None and (
        summary.accepted.wrong.count,
        summary.accepted.wrong.of,
    ) == (1, 4)
    assert summary.threshold == pytest.approx(0.9)
    met = {what: met for what, _, _, met in report.targets()}
    assert (
        met["AUROC"] is True and met["wrong of the trusted"] is False and met["trusted of the right"] is True
    )


def test_weights_without_calibration_can_not_be_measured(protocol):
    with pytest.raises(InputError, match=r"mine.safetensors: these weights carry no calibration"):
        protocol(Oracle(confidence=False), pairs=2, options=AlignOptions(weights="mine.safetensors"))


def test_weights_that_are_not_there_end_the_run_before_any_trial(shapes, monkeypatch):
    monkeypatch.setattr(trust, "each", lambda *_: pytest.fail("started"))
    with pytest.raises(InputError, match="no such weights file"):
        trust.run(shapes, "shapes", options=AlignOptions(weights="none.safetensors"))


@pytest.mark.parametrize("wrong", [{"pairs": 0}, {"workers": 0}, {"seed": -1}])
def test_numbers_that_make_no_sense(shapes, wrong):
    with pytest.raises(UsageError, match="at least 1"):
        trust.run(shapes, "shapes", **wrong)


def test_only_the_half_that_no_calibration_saw_is_scanned(protocol, monkeypatch, shapes):
    half = trust.bench_half(shapes).names.tolist()
    monkeypatch.setattr(trust, "judge", lambda register, make, *_: make.args[0].names.tolist())
    assert protocol(Oracle(), pairs=1).outcomes == (half,)
    assert 0 < len(half) < len(shapes)


def test_every_pair_of_a_folder_is_a_trial_from_start_poses_of_its_own(protocol, folder, monkeypatch, shapes):
    none = folder.pair(overlap_source=0.0, overlap_target=0.0)
    folder.write({"pairs": [folder.pair(), none]})
    protocol(Oracle(), pairs=1)  # puts the stand-ins in place
    seen = []

    def answer(source, target, options):
        """Right for whatever start pose: the file's points tell it."""
        original = read_scan(folder.path / "a.ply").cloud.points
        seen.append(source.points)
        rotation, _ = Rotation.align_vectors(
            original - original.mean(axis=0), source.points - source.points.mean(axis=0)
        )
        back = rigid(rotation.as_matrix(), original.mean(axis=0) - rotation.apply(source.points.mean(axis=0)))
        return result_with(folder.gt_T_target_source @ back, 0.9, True)

    monkeypatch.setattr(trust, "register", answer)
    report = trust.run_folder(folder.path, seed=4)
    assert [(one.kind, one.right, one.overlap) for one in report.outcomes] == [
        (">= 0.5", True, 0.7), ("< 0.1", True, 0.0),
    ]  # fmt: skip
    assert report.outcomes[0].rotation_deg == pytest.approx(0.0, abs=1e-4)
    assert list(report.kinds()) == [">= 0.5", "< 0.1"]
    assert len(trust.run_folder(folder.path, pairs=3, seed=4).outcomes) == 3
    np.testing.assert_array_equal(seen[0], seen[2])  # the same trial in both runs
    assert not np.allclose(seen[2], seen[4])  # the same pair, from another pose


def test_a_folder_without_answers_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"gt\.json"):
        trust.run_folder(tmp_path)


def test_json_holds_every_trial_and_the_targets(protocol):
    report = protocol(Oracle(fails=(2,)), pairs=6, seed=0)
    found = json.loads(report.to_json())
    assert found["weights_sha256"] == "ab" * 32 and found["options"]["solver"] == "auto"
    assert len(found["trials"]) == 6 and found["trials"][2]["reasons"]
    assert [row["kind"] for row in found["by_kind"]] == ["scans", "disjoint"]
    assert found["summary"]["accepted"]["right"]["count"] == 1
    assert sum(one["count"] for one in found["reliability_bins"]) == 6
    assert {row["what"] for row in found["targets"]} >= {"AUROC", "expected calibration error"}


def test_tables_say_what_was_found(protocol):
    report = protocol(Oracle(), pairs=8)
    out = Console(width=160, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    render(report, out)
    text = out.export_text()
    assert "confidence: 8 trials" in text and "of some shapes, seed 0" in text
    assert "AUROC" in text and ">= 0.97" in text and "disjoint" in text and "0.9-1.0" in text


class Page(HTMLParser):
    """Collects tags and what they would load; notes whether tags close as they open."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.loads, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.loads += [value for name, value in attributes if name in ("src", "href")]
        if tag not in ("meta", "link", "line", "rect"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        if tag != "rect":
            assert self.open.pop() == tag


def test_the_page_is_complete_alone(protocol):
    text = page(protocol(Oracle(), pairs=10))
    found = Page(text)
    assert not found.open
    assert found.tags.count("svg") == 3 and "script" not in found.tags
    assert found.loads == ["data:,"] and "http" not in text and "url(" not in text
    assert "{{" not in text and "nan" not in text.lower()
    assert "thing &lt;7&gt;" in text  # trusted and wrong, its name escaped
    assert hindsight(protocol(Oracle(), pairs=10)) in text


def outcome(number, right, confidence, trusted):
    return Outcome(
        number, "scans", "a", 0.5, 10, 10, True, right, confidence, trusted, (), 1.0, 0.1, 0.5
    )  # fmt: skip


@pytest.mark.parametrize(
    "outcomes",
    [
        (outcome(0, False, 0.0, False),),
        (outcome(0, True, 1.0, True),),
        (outcome(0, False, 1.0, True), outcome(1, True, 0.0, False)),
    ],
)
def test_extreme_outcomes_are_reported_too(outcomes):
    settings = {
        "kinds": ["scans"], "data": "few", "seed": 0,
        "weights_name": "utopic", "weights_sha256": "0" * 64,
    }  # fmt: skip
    report = TrustReport(settings, outcomes)
    text = page(report)
    assert not Page(text).open
    assert report.title.endswith("seed 0, weights utopic (sha256 000000000000)") and report.title in text
    # Wrong answers alone leave no curve to draw, and one right answer a single point of it.
    words = "more than 20% wrong at every threshold"
    assert (words in text) != ('<circle class="curve"' in text)
    assert json.loads(report.to_json())["by_kind"][0]["trials"] == len(outcomes)
    with open("/dev/null", "w") as nowhere:
        render(report, Console(file=nowhere))
