"""What a user installs: the built wheel, away from the checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest

from utopic_cli.geometry.rigid import relative_rotation_error_deg
from utopic_cli.synthesis.demo_object import demo_pair

ROOT = Path(__file__).resolve().parent.parent


def run(*command, cwd, **kwargs):
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=clean,
        capture_output=True,
        text=True,
        timeout=300,
        **kwargs,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A fresh environment with the wheel in it; its dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("installed")
    venv.EnvBuilder(with_pip=False, symlinks=os.name != "nt").create(folder)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    python = next(scripts.glob("python*"))
    query = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = Path(run(python, "-c", query, cwd=folder).stdout.strip())
    # A path file, not an environment variable: what the wheel brings comes first, and path files
    # in there (an editable install of the checkout) are not followed.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index"]
    run(*pip, "--force-reinstall", wheel, cwd=folder)
    return scripts


def files_in(folder, name):
    """The files of a folder of the checkout, under another name of it."""
    paths = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {f"{name}/{path.relative_to(folder).as_posix()}" for path in paths}


def test_the_wheel_holds_the_package_with_its_pages_and_weights_and_no_tests(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    package = {name for name in names if name.startswith("utopic_cli/")}
    expected = files_in(ROOT / "utopic_cli", "utopic_cli") | files_in(ROOT / "weights", "utopic_cli/_weights")
    assert package == expected
    assert {Path(name).suffix for name in package} >= {".py", ".typed", ".safetensors", ".html", ".toml"}
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "weights/"))]


def test_two_builds_give_the_same_bytes(wheel, tmp_path):
    """Whenever, wherever, and whatever the times of the files."""
    copy = tmp_path / "copy"
    caches = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "runs", "demo")
    shutil.copytree(ROOT, copy, ignore=caches, copy_function=shutil.copyfile)
    for path in copy.rglob("*.py"):
        os.utime(path, (1e9, 1e9))
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, copy]
    run(*command, cwd=tmp_path)
    assert (tmp_path / wheel.name).read_bytes() == wheel.read_bytes()


def test_the_installed_package_is_not_the_checkout(installed, tmp_path):
    where = "import utopic_cli; print(utopic_cli.__file__)"
    found = Path(run(installed / "python", "-c", where, cwd=tmp_path).stdout.strip())
    assert ROOT not in found.parents


def test_align_works_from_another_folder(installed, tmp_path):
    pair = demo_pair(np.random.default_rng(0))
    for name, cloud in (("a.ply", pair.source), ("b.ply", pair.target)):
        points = cloud.points[:6000]
        rows = "".join(f"{x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points)
        (tmp_path / name).write_text(
            f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
            f"property float z\nend_header\n{rows}"
        )
    run(installed / "utopic", "align", "a.ply", "b.ply", "--out-dir", "out", cwd=tmp_path)
    matrix = np.loadtxt(tmp_path / "out" / "transformation.txt")
    assert relative_rotation_error_deg(matrix, pair.gt_T_target_source) < 2
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["T_target_source"] == matrix.tolist()
    assert report["weights"]["name"] == "utopic"
