from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tests.benchmark.conftest import ScanFolder
from utopic_cli.benchmark.method import Trial, Utopic
from utopic_cli.benchmark.scans import render, run, run_methods, start_transformation
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, UsageError
from utopic_cli.geometry.rigid import apply, invert, is_rigid, rigid, rotation_angle_deg


@dataclass
class FakeMethod:
    """Answers by a function of the trial, and remembers the trials."""

    answer: Callable[[Trial], np.ndarray]
    name: str = "fake"
    refines: bool = True
    trials: list[Trial] = field(default_factory=list)

    def settings(self) -> dict[str, Any]:
        return {"kind": "fake"}

    def estimate(self, trial: Trial) -> np.ndarray:
        self.trials.append(trial)
        return self.answer(trial)


def oracle(folder: ScanFolder) -> Callable[[Trial], np.ndarray]:
    return lambda trial: folder.gt_T_target_source @ invert(trial.start)


def test_start_poses_depend_on_seed_pair_and_pose_only() -> None:
    centroid = np.array([1.0, 2.0, 3.0])
    draws = {
        key: start_transformation(*key, centroid, 2.0) for key in [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)]
    }
    np.testing.assert_array_equal(draws[0, 0, 0], start_transformation(0, 0, 0, centroid, 2.0))
    different = {draw.tobytes() for draw in draws.values()}
    assert len(different) == 4
    assert all(is_rigid(draw, 1e-12) for draw in draws.values())


def test_start_rotations_are_uniform_and_shifts_bounded() -> None:
    centroid, extent = np.array([100.0, -50.0, 7.0]), 2.0
    draws = [start_transformation(0, 0, pose, centroid, extent) for pose in range(2000)]
    shifts = np.stack([apply(draw, centroid) - centroid for draw in draws])
    assert np.abs(shifts).max() <= extent and np.abs(shifts).max() > 0.95 * extent
    # Uniform on SO(3): the angle's density is (1 - cos a) / pi, so its mean is 90 + 360 / pi^2 degrees.
    angles = [rotation_angle_deg(draw[:3, :3]) for draw in draws]
    assert np.mean(angles) == pytest.approx(90.0 + 360.0 / np.pi**2, abs=2.5)


def test_the_right_answer_succeeds_from_every_pose(folder: ScanFolder) -> None:
    method = FakeMethod(oracle(folder))
    report = run_methods((method,), folder.path, poses=4)
    assert [attempt.success for attempt in report.attempts] == [True] * 4
    assert max(a.error.rre_deg for a in report.attempts if a.error) < 1e-5
    moved = [trial.source.points for trial in method.trials]
    assert not np.allclose(moved[0], moved[1])
    np.testing.assert_allclose(
        moved[0], apply(method.trials[0].start, method.trials[0].source_scan.cloud.points)
    )
    assert np.ptp([trial.extent for trial in method.trials]) == 0.0


def test_the_answer_for_the_unmoved_source_fails(folder: ScanFolder) -> None:
    report = run_methods((FakeMethod(lambda trial: folder.gt_T_target_source),), folder.path, poses=3)
    assert not any(attempt.success for attempt in report.attempts)


def test_exceptions_and_nonsense_are_failures_not_crashes(folder: ScanFolder) -> None:
    def explode(trial: Trial) -> np.ndarray:
        raise RuntimeError("too\ndifficult")

    methods = (
        FakeMethod(explode, "explodes"),
        FakeMethod(lambda trial: np.full((4, 4), np.nan), "nan"),
        FakeMethod(lambda trial: np.eye(3), "small"),
        FakeMethod(oracle(folder), "good"),
    )
    report = run_methods(methods, folder.path, poses=1)
    messages = [attempt.message for attempt in report.attempts]
    assert messages[0] == "RuntimeError: too difficult"
    assert messages[1] == messages[2] == "ValueError: the estimate is no finite 4x4 matrix"
    assert [attempt.success for attempt in report.attempts] == [False, False, False, True]


def test_an_interruption_ends_the_run(folder: ScanFolder) -> None:
    def interrupt(trial: Trial) -> np.ndarray:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_methods((FakeMethod(interrupt),), folder.path, poses=1)


def test_cpu_time_counts_the_work_of_child_processes(folder: ScanFolder) -> None:
    spin = "import time\nwhile time.process_time() < 0.3: pass"

    def work(trial: Trial) -> np.ndarray:
        subprocess.run([sys.executable, "-S", "-c", spin], check=True)
        time.sleep(0.3)
        return np.eye(4)

    (attempt,) = run_methods((FakeMethod(work),), folder.path, poses=1).attempts
    assert attempt.cpu_seconds >= 0.29
    assert attempt.seconds >= 0.59


def test_methods_share_trials_and_the_report_says_everything(folder: ScanFolder) -> None:
    one, other = FakeMethod(oracle(folder), "one"), FakeMethod(lambda trial: np.eye(4), "other")
    seen: list[tuple[int, int]] = []
    report = run_methods(
        (one, other),
        folder.path,
        poses=2,
        seed=5,
        progress=lambda done, total, what: seen.append((done, total)),
    )
    assert seen == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]
    for mine, yours in zip(one.trials, other.trials, strict=True):
        np.testing.assert_array_equal(mine.start, yours.start)
        assert mine.seed == yours.seed
    content = json.loads(report.to_json())
    assert content["seed"] == 5 and content["methods"]["one"] == {"kind": "fake"}
    assert [
        (row["band"], row["method"], row["successes"], row["attempts"]) for row in content["summary"]
    ] == [
        (">= 0.5", "one", 2, 2),
        (">= 0.5", "other", 0, 2),
    ]
    first = content["attempts"][0]
    assert (first["overlap"], first["source"], first["target"]) == (0.7, "a.ply", "b.ply")
    np.testing.assert_allclose(first["T_target_source"], first["gt_T_target_source"])

    text = io.StringIO()
    render(report, Console(file=text, width=120))
    assert "2/2 (100%)" in text.getvalue() and "0/2 (0%)" in text.getvalue()


def test_the_title_names_the_weights(folder: ScanFolder) -> None:
    settings = Utopic(AlignOptions()).settings()
    report = run_methods((FakeMethod(oracle(folder)),), folder.path, poses=1)
    assert "weights" not in report.title and "1 pair x 1 start pose, seed 0" in report.title
    report.settings["methods"]["utopic"] = settings
    assert report.title.endswith(f"seed 0, weights utopic (sha256 {settings['weights_sha256'][:12]})")


def test_a_rough_estimate_is_refined_unless_the_method_does_so_itself(folder: ScanFolder) -> None:
    nudge = rigid(np.eye(3), np.array([0.03, 0.0, 0.0]))
    methods = tuple(
        FakeMethod(lambda trial: nudge @ oracle(folder)(trial), name, refines)
        for name, refines in (("given", False), ("own", True))
    )
    given, own = (a.error for a in run_methods(methods, folder.path, poses=1).attempts)
    assert given is not None and own is not None
    assert own.rte == pytest.approx(0.03, rel=1e-6)
    assert given.rte < 0.006
    unrefined = run_methods(methods[:1], folder.path, poses=1, refine=False).attempts[0].error
    assert unrefined is not None and unrefined.rte == pytest.approx(0.03, rel=1e-6)


def test_pairs_are_chosen_by_overlap_and_keep_their_poses(folder: ScanFolder) -> None:
    overlaps = [0.05, 0.9, 0.2, 0.6, 0.4, 0.12]
    folder.write({"pairs": [folder.pair(overlap_source=value, overlap_target=1.0) for value in overlaps]})
    everything = FakeMethod(oracle(folder))
    report = run_methods((everything,), folder.path, poses=1)
    assert [attempt.pair for attempt in report.attempts] == [1, 2, 3, 4, 5]
    some = FakeMethod(oracle(folder))
    chosen = run_methods((some,), folder.path, pairs=3, poses=1, min_overlap=0.15).attempts
    assert len(chosen) == 3 and {1, 2} <= {attempt.pair for attempt in chosen}  # both ends of the range
    for attempt, trial in zip(chosen, some.trials, strict=True):
        np.testing.assert_array_equal(trial.start, everything.trials[attempt.pair - 1].start)


def test_overlap_is_measured_where_nobody_says_it(folder: ScanFolder) -> None:
    entry = {key: value for key, value in folder.pair().items() if not key.startswith("overlap")}
    report = run_methods((FakeMethod(oracle(folder)),), folder.write(entry), poses=1)
    assert 0.4 < report.attempts[0].overlap < 0.95


def test_nothing_left_and_bad_numbers(folder: ScanFolder) -> None:
    with pytest.raises(InputError, match="none of its 1 pairs"):
        run_methods((FakeMethod(oracle(folder)),), folder.path, min_overlap=0.9)
    with pytest.raises(UsageError, match="poses"):
        run_methods((FakeMethod(oracle(folder)),), folder.path, poses=0)
    with pytest.raises(UsageError, match="unknown baseline 'magic'; known: open3d-ransac"):
        run(folder.path, baselines=("magic",))
