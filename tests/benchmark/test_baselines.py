from __future__ import annotations

import builtins
from typing import Any

import numpy as np
import pytest

from tests.benchmark.conftest import ScanFolder
from utopic_cli.benchmark.baselines import BASELINES, find_baselines
from utopic_cli.benchmark.scans import run_methods
from utopic_cli.errors import UsageError


@pytest.mark.parametrize("name", ["open3d-ransac", "open3d-fgr"])
def test_registers_an_easy_pair_the_same_way_twice(folder: ScanFolder, name: str) -> None:
    pytest.importorskip("open3d")
    first, second = (run_methods(find_baselines([name]), folder.path, poses=1) for _ in range(2))
    assert first.attempts[0].message is None
    assert first.attempts[0].success
    # Seeded, but Open3D's parallel sums differ in the last bits.
    estimates = [report.attempts[0].T_target_source for report in (first, second)]
    np.testing.assert_allclose(estimates[0], estimates[1], rtol=0, atol=1e-9)
    assert first.settings["methods"][name]["voxels_per_extent"] == 50


def test_features_are_told_apart_from_unknown_names() -> None:
    with pytest.raises(UsageError, match=r"'fpfh' is for synthetic pairs only, .*small-gicp"):
        find_baselines(["fpfh"])
    with pytest.raises(UsageError, match="unknown baseline 'magic'; known: open3d-ransac"):
        find_baselines(["magic"])


def test_the_settings_are_the_ones_the_tables_name() -> None:
    assert list(BASELINES) == [
        "open3d-ransac",
        "open3d-ransac-fine",
        "open3d-fgr",
        "open3d-icp",
        "kiss-matcher",
        "small-gicp",
    ]
    coarse, fine = BASELINES["open3d-ransac"], BASELINES["open3d-ransac-fine"]
    assert (coarse.voxels_per_extent, coarse.iterations) == (50, 100_000)  # type: ignore[attr-defined]
    assert (fine.voxels_per_extent, fine.iterations) == (120, 2_000_000)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ModuleNotFoundError("No module named 'open3d'"), "pip install open3d"),
        (OSError("libGL.so.1: cannot open shared object file"), "libGL.so.1.*apt-get install"),
    ],
)
def test_without_open3d_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, error: Exception, message: str
) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        if name == "open3d":
            raise error
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(UsageError, match=message):
        find_baselines(["open3d-ransac"])
    assert find_baselines([]) == ()
