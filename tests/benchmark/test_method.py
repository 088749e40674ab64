from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmark.conftest import ScanFolder
from utopic_cli.benchmark.method import Trial, UtopicCommand
from utopic_cli.benchmark.scans import start_transformation
from utopic_cli.config import AlignOptions
from utopic_cli.geometry.rigid import apply
from utopic_cli.io.scan import read_scan
from utopic_cli.io.transformation import format_transformation


@pytest.fixture
def trial(folder: ScanFolder) -> Trial:
    source, target = read_scan(folder.path / "a.ply"), read_scan(folder.path / "b.ply")
    start = start_transformation(0, 0, 0, source.cloud.points.mean(axis=0), 3.0)
    moved = source.cloud.transformed(start)
    return Trial(moved, target.cloud, 3.0, 0, start, source, target)


def test_the_command_line_gets_the_moved_file_and_every_option(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = start_transformation(1, 2, 3, np.zeros(3), 1.0)
    calls: list[list[str]] = []

    def align(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        calls.append(command)
        source = read_scan(command[4]).cloud.points
        np.testing.assert_allclose(source, trial.source.points, atol=1e-12)
        assert Path(command[5]) == trial.target_scan.path.resolve()
        Path(command[command.index("-o") + 1]).write_bytes(format_transformation(answer, ".txt"))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", align)
    options = AlignOptions(
        points=700, refine=False, solver="svd", max_rotation=30.0, device="cpu", threads=1, seed=9
    )
    np.testing.assert_allclose(UtopicCommand(options).estimate(trial), answer, atol=1e-12)
    (command,) = calls
    assert command[:4] == [sys.executable, "-m", "utopic_cli", "align"]
    flags = " ".join(command[8:])
    assert flags == (
        "--weights utopic --points 700 --no-refine --solver svd --max-rotation 30.0 --device cpu "
        "--threads 1 --seed 9 --exit-zero -q"
    )
    assert not Path(command[4]).exists()  # the temporary folder is gone


def test_a_failing_command_passes_on_its_last_line(trial: Trial, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RuntimeError, match=r"exit code 2: .*--points"):  # the real command, refused at once
        UtopicCommand(AlignOptions(points=1)).estimate(trial)
    failed = subprocess.CompletedProcess([], 4, "", "utopic: warning: odd\nutopic: error: a.ply: empty\n\n")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(RuntimeError, match=r"^exit code 4: utopic: error: a.ply: empty$"):
        UtopicCommand(AlignOptions()).estimate(trial)


def test_the_moved_source_is_where_the_start_pose_puts_it(trial: Trial) -> None:
    np.testing.assert_allclose(trial.source.points, apply(trial.start, trial.source_scan.cloud.points))
