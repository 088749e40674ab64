"""Every command in the documentation is run and does what the page says.

The commands of a page are run in their order, in one folder, as a reader would; only what they are run on
is smaller, by the table SMALLER and the folder that ``furnish`` makes. So one in the middle may need those
before it. A command must end with its exit code, leave the files that it names, and those that the table
below it names. What is no ``utopic`` has a check of its own in OTHERS.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.command_line import parse
from tests.commands.test_bench_variants import TINY
from tests.documentation import ROOT, Command, commands, fences
from utopic_cli.benchmark import calibration, synthetic, trial_scans, trial_solids, trust, variant_pairs
from utopic_cli.cli import app
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.synthesis import packing
from utopic_cli.synthesis.demo_object import demo_pair
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.training import trainer

SMALLER = {
    r"^utopic batch .*": r"\g<0> --points 256 --workers 1",
    r"^(utopic|torchrun .*) train .*": r"\g<0> --config tiny.toml",  # six pairs: ends before --minutes
    r"^torchrun .*": r"\g<0> --data DIR --workers 0",
    r"^utopic calibrate .*": r"\g<0> --trials 42 --points 50",
    r"^utopic bench (ablation|attention|uncertainty) .*": r"\g<0> --config tiny.toml --pairs 2",
    r"^utopic bench (?!scans).*": r"\g<0> --points 100",
    r"^utopic bench scans DIR --poses 3": r"utopic bench scans scans --poses 1",
    r"--pairs \d+": "--pairs 2",
    r"^utopic teach .*": r"\g<0> --pairs 70 --workers 2",
    r"--train-pairs \d+": "--train-pairs 4",
}
"""By regular expressions, what stands for a part of a command; all that match are applied, in this order."""

EXIT_CODES = {
    # Weights of six pairs: the answer need not be one to trust.
    "utopic align a.ply b.ply --weights runs/mine/utopic.safetensors": (0, 3),
}
"""By how a command begins, the exit codes that the page speaks of; of all others 0."""

SLOW = ("utopic bench", "utopic calibrate", "utopic teach", "torchrun")

NEEDED = {"open3d": "open3d", "kiss-matcher": "kiss_matcher", "small-gicp": "small_gicp"}
"""By how their names begin, the modules that baselines need; without them a command is skipped."""

SHOWN = "utopic align demo/source.ply demo/target.ply --out-dir result"
"""Its output is shown, too: run, and compared, by a test of its own."""


def _make_knows(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)


def _pip_takes(command: str) -> None:
    """All but the network and the installing, which ``test_wheel.py`` does."""
    offline = ["--dry-run", "--no-deps", "--no-index", "--no-build-isolation"]
    done = subprocess.run(
        [sys.executable, "-m", *shlex.split(command), *offline],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert done.returncode == 0 and "Would install utopic-cli" in done.stdout, done.stderr


def _torchrun(command: str) -> None:
    arguments = shlex.split(smaller(command))[1:]
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    _check_files(Command("", command, ("utopic.safetensors", "utopic.json")), {})


OTHERS: dict[str, Callable[[str], None]] = {
    "make demo": lambda _: _make_knows("demo"),
    "make test": lambda _: _make_knows("test"),
    "pip install -c constraints.txt .": _pip_takes,
    "torchrun --nproc-per-node 2 -m utopic_cli train --out runs/two": _torchrun,
    SHOWN: lambda _: None,
}
"""Commands that are not run like the others, and how they are checked."""


def smaller(command: str) -> str:
    """Return what is run for a command; files that another one wrote before are replaced."""
    for part, instead in SMALLER.items():
        command = re.sub(part, instead, command)
    return command + (" --overwrite" if re.search(r"^utopic (?!train).* (-o|--out-dir) ", command) else "")


def furnish(folder: Path) -> None:
    """Put stand-ins for the files that the documentation speaks of into a folder."""
    pair = demo_pair(np.random.default_rng(0))
    for cloud, names, step in (
        (pair.source, ("a.ply", "in.ply", "demo/source.ply"), 4),
        (pair.target, ("b.ply", "demo/target.ply"), 4),
        (pair.source, ("scans/scan-7.ply",), 8),
        (pair.target, ("scans/scan-8.ply",), 8),
    ):
        points = cloud.points[::step]
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(scalar_cloud_ply(points, np.zeros(points.shape, np.uint8), {}))
    np.savetxt(folder / "T.txt", pair.gt_T_target_source)
    rows = pair.gt_T_target_source.tolist()
    answer = {"source": "scan-7.ply", "target": "scan-8.ply", "T_target_source": rows}
    (folder / "scans" / "gt.json").write_text(json.dumps(answer))
    (folder / "model").mkdir()
    placed = {"scans": [{"scan": "scan-7", "T_world_scan": rows}]}
    (folder / "model" / "poses.json").write_text(json.dumps(placed))
    (folder / "tiny.toml").write_text(TINY)
    rng = np.random.default_rng(1)
    for number in range(8):  # by these names, two are held out, in the half for calibrating
        vertices, faces = procedural_mesh(rng, 16)
        lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
        for name in ("shapes", "DIR"):
            (folder / name).mkdir(exist_ok=True)
            (folder / name / f"mesh{number}.obj").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A furnished folder for each page."""
    root = tmp_path_factory.mktemp("workshops")
    (root / "furnished").mkdir()
    furnish(root / "furnished")

    def place(page: str) -> Path:
        folder = root / page.replace("/", "-")
        if not folder.exists():
            shutil.copytree(root / "furnished", folder)
        return folder

    return place


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Make what no option does smaller, and stay in this process.

    That starts no Python and torch for each command; the processes have tests of their own.
    """

    def each(make_task: Any, count: int, *_: Any) -> list[Any]:
        task = make_task()
        return [task(number) for number in range(count)]

    def train(*arguments: Any, **options: Any) -> Any:
        return real(*arguments, **{**options, "workers": 0})

    real = trainer.train
    monkeypatch.setattr(trainer, "train", train)
    for module in (calibration, synthetic, trust, variant_pairs):
        monkeypatch.setattr(module, "each", each)
    monkeypatch.setattr(packing, "PROCEDURAL_SHAPES", 20)
    monkeypatch.setattr(packing, "PROCEDURAL_RESOLUTION", 16)
    sizes = {"points": (600, 1000), "patch_points": (600, 1000), "surface_points": (500, 600)}
    monkeypatch.setattr(trial_scans, "SETTINGS", replace(trial_scans.SETTINGS, **sizes))
    monkeypatch.setattr(trial_solids, "MOST_POINTS", 2_500)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(one, id=str(one), marks=[pytest.mark.slow] if one.line.startswith(SLOW) else [])
        for one in commands()
    ],
)
def test_every_command_does_what_it_says(
    command: Command, places: Callable[[str], Path], small: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(places(command.page))
    if command.line in OTHERS:
        OTHERS[command.line](command.line)
        return
    parse(command.line)  # as it stands
    _skip_without_baselines(command.line)
    before = {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
    result = CliRunner().invoke(app, shlex.split(smaller(command.line))[1:])
    codes = next((codes for part, codes in EXIT_CODES.items() if command.line.startswith(part)), (0,))
    assert result.exit_code in codes, result.output
    _check_files(command, before)


def _skip_without_baselines(command: str) -> None:
    for name in re.findall(r"[\w-]+", " ".join(re.findall(r"--baselines (\S+)", command))):
        for beginning, module in NEEDED.items():
            if name.startswith(beginning):
                pytest.importorskip(module)


def _check_files(command: Command, before: dict[Path, int]) -> None:
    """Make sure that the files named by the command, and by the table below it, were written just now."""
    named = [Path(name) for name in re.findall(r"(?:-o|--html|--json) ([^\s-]\S*)", command.line)]
    for folder in re.findall(r"(?:--out-dir|--out) (\S+)", command.line):
        named += [Path(folder) / _pattern(name) for name in command.files if _can_be_there(name)]
        assert any(Path(folder).iterdir()), folder
    for path in named:
        found = list(Path().glob(path.as_posix()))
        assert found, f"{path}: not written"
        assert all(before.get(one) != one.stat().st_mtime_ns for one in found), f"{path}: is an old one"


def _pattern(name: str) -> str:
    return re.sub(r"\b[A-Z]+\b", "*", name)


def _can_be_there(name: str) -> bool:
    return name != "tensorboard/" or importlib.util.find_spec("tensorboard") is not None


def test_the_tables_name_nothing_that_is_gone() -> None:
    lines = [one.line for one in commands()]
    for part in SMALLER:
        assert any(re.search(part, line) for line in lines), f"{part}: in no fenced block"
    for part in (*EXIT_CODES, *SLOW, *OTHERS):
        assert any(line.startswith(part) for line in lines), f"{part}: in no fenced block"


def test_the_output_in_the_readme_is_that_of_its_command(
    places: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the numbers, which are those of the whole demo."""
    monkeypatch.chdir(places("README.md"))
    blocks = list(fences(ROOT / "README.md"))
    place = next(i for i, (_, text) in enumerate(blocks) if text.strip() == SHOWN)
    shown = blocks[place + 1][1]
    result = CliRunner().invoke(app, [*shlex.split(SHOWN)[1:], "--overwrite"])
    said = [line for line in result.stderr.splitlines() if not line.startswith("  at work: ")]
    assert [_without_numbers(line) for line in said] == [
        _without_numbers(line) for line in shown.splitlines()
    ]
    (command,) = (one for one in commands() if one.line == SHOWN)
    assert "report.html" in command.files
    _check_files(command, {})


def _without_numbers(line: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "#", line.replace("\\", "/").replace("over ", ""))
