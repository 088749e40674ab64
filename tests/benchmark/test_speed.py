from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from utopic_cli.benchmark import speed
from utopic_cli.benchmark.reports import render
from utopic_cli.benchmark.result_page import page
from utopic_cli.benchmark.speed import _memory_wanted, run
from utopic_cli.benchmark.speed_clock import Stopwatch, available_memory, peak_memory
from utopic_cli.benchmark.speed_report import ALIGN, FORWARD, Measurement, SpeedReport
from utopic_cli.errors import InputError, UsageError
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.shapes import ShapeLibrary, pack

SETTINGS = {
    "weights": "utopic", "weights_sha256": "ab" * 32, "data": "test", "split": "val", "shapes": 2, "pairs": 2,
    "seed": 0, "points": [100, 200],
}  # fmt: skip
MEASURED = Measurement(
    ALIGN, 100, 1, "cpu", 2, 90.0, 2.0, 1.5, 0.01, 400_000_000, 300_000_000, 2, {"refine": 0.1}
)


@pytest.fixture(scope="module")
def shapes() -> ShapeLibrary:
    rng = np.random.default_rng(3)
    meshes = [procedural_mesh(rng, 32) for _ in range(3)]
    return pack(meshes, list("abc"), ["train", "val", "val"], ["one"] * 3)


def test_the_first_lap_warms_up() -> None:
    watch = Stopwatch()
    for _ in range(3):
        with watch.lap():
            np.linalg.svd(np.ones((20, 20)))
    assert watch.laps == 2 and 0 < watch.wall_seconds < 1.0 and watch.cpu_seconds >= 0


def test_peak_memory_sees_what_was_held_for_a_while() -> None:
    # In a process of its own: this one's peak may lie far above what it holds now.
    code = (
        "import numpy as np; from utopic_cli.benchmark.speed_clock import Peak; peak = Peak()\n"
        "np.ones(10_000_000); print(peak.idle_bytes or 0, peak.peak_bytes or 0)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    idle, peak = map(int, said.split())
    if not peak:
        pytest.skip("this system doesn't tell")
    assert 60_000_000 < peak - idle < 120_000_000
    assert (peak_memory() or 0) > 0 and (available_memory() or 1) > 0


def test_what_would_not_fit_into_memory_is_foreseen_from_smaller_cases() -> None:
    small = Measurement(FORWARD, 1000, 1, "cpu", peak_bytes=300, idle_bytes=100)
    assert _memory_wanted(Measurement(FORWARD, 2000, 4, "cpu"), [small]) == 100 + 200 * 16
    assert _memory_wanted(Measurement(FORWARD, 2000, 4, "cuda"), [small]) is None
    assert _memory_wanted(Measurement(ALIGN, 2000, 1, "cpu"), [small]) is None


def test_a_case_beyond_memory_is_left_out_and_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "available_memory", lambda: 1000)
    small = Measurement(FORWARD, 1000, 1, "cpu", peak_bytes=300, idle_bytes=100)
    found = speed._measured([], "utopic", 0, FORWARD, 5000, 4, "cpu", [small])
    assert found.wall_seconds is None and "left out" in str(found.message)


def test_the_report_is_told_in_tables_json_and_page() -> None:
    forward = replace(MEASURED, what=FORWARD, batch=4, right=None, assignment_seconds=None)
    lost = Measurement(FORWARD, 200, 4, "cpu", message="left out: needs about 9.0 GB of memory")
    report = SpeedReport(SETTINGS, (forward, lost, MEASURED))
    assert forward.pairs_per_second == 2.0 and MEASURED.assignment_share == 0.005
    out = io.StringIO()
    render(report, Console(file=out, width=200))
    said = out.getvalue()
    assert "REGTR (quoted)" in said and "0.29 / 0.23" in said and "RTX 2080 Ti" in said
    assert "0.50%" in said and "2/2" in said and "batch 4, cpu: left out" in said and "400" in said
    assert report.title.endswith("seed 0, weights utopic (sha256 abababababab)")
    assert report.title in said and report.title in page(report).replace("&#x27;", "'")
    rows = json.loads(report.to_json())["measurements"]
    assert [row["pairs_per_second"] for row in rows] == [2.0, None, 0.5]
    text = page(report)
    assert text.count("<svg") == 2 and "left out" in text and "{{" not in text


def test_what_cant_be_measured(shapes: ShapeLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    for asked in (
        {"points": (10,)},
        {"points": ()},
        {"pairs": 0},
        {"batches": (0,)},
        {"baselines": ("magic",)},
    ):
        with pytest.raises(UsageError):
            run(shapes, "test", **asked)
    with pytest.raises(InputError, match="nowhere"):
        run(shapes, "test", weights="nowhere.safetensors")
    monkeypatch.setattr(speed, "BAND", (0.999, 0.9995))
    monkeypatch.setattr(speed, "CLEAN", replace(speed.CLEAN, points=(500, 500), attempts=1))
    with pytest.raises(InputError, match="give more or other shapes"):
        run(shapes, "test", device="cpu")


@pytest.mark.slow
def test_a_tiny_run_measures_network_alignment_and_a_baseline(
    shapes: ShapeLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("open3d")
    monkeypatch.setattr(speed, "CLEAN", replace(speed.CLEAN, points=(1500, 1500)))
    report = run(shapes, "test", 1, points=(100,), baselines=("open3d-ransac",), device="cpu", batches=(1, 3))
    assert [(one.what, one.batch) for one in report.measurements] == [
        (FORWARD, 1), (FORWARD, 3), (ALIGN, 1), ("open3d-ransac", 1),
    ]  # fmt: skip
    assert not report.losses()
    for one in report.measurements:
        assert one.runs == 1 and one.wall_seconds and one.wall_seconds > 0
        assert one.peak_bytes is None or (one.idle_bytes or 0) <= one.peak_bytes < 8e9
    whole = report.measurements[2]
    assert whole.steps_s and whole.assignment_share is not None and 0 < whole.assignment_share < 1
    assert whole.nodes is not None and whole.nodes <= 100
