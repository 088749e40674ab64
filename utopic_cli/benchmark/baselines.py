"""What people align scans with today, by name.

Everything behind the interface of `Method`: Open3D's global registration and its ICP
(`open3d_methods`), KISS-Matcher (`kiss`), small_gicp (`gicp`).
"""

from __future__ import annotations

from collections.abc import Sequence

from utopic_cli.benchmark.gicp import SmallGicp
from utopic_cli.benchmark.kiss import KissMatcher
from utopic_cli.benchmark.matcher import FEATURES
from utopic_cli.benchmark.method import Method
from utopic_cli.benchmark.open3d_methods import Open3DGlobal, Open3DIcp
from utopic_cli.errors import UsageError

BASELINES: dict[str, Method] = {
    method.name: method
    for method in (
        Open3DGlobal("open3d-ransac", "ransac", voxels_per_extent=50, iterations=100_000),
        Open3DGlobal("open3d-ransac-fine", "ransac", voxels_per_extent=120, iterations=2_000_000),
        Open3DGlobal("open3d-fgr", "fgr", voxels_per_extent=50, iterations=64),
        Open3DIcp(),
        KissMatcher(),
        SmallGicp(),
    )
}


def find_baselines(names: Sequence[str]) -> tuple[Method, ...]:
    """Look baselines up by name, and make sure before any work that they can run.

    Raises:
        UsageError: a name is unknown (the known ones are listed) or that of features, which need a
            protocol that looks into the matching, or a library is missing.
    """
    for name in names:
        if name in FEATURES:
            raise UsageError(
                f"baseline {name!r} is for synthetic pairs only, by bench range-scans, modelnet, noise and "
                f"the like; here: {', '.join(BASELINES)}"
            )
        if name not in BASELINES:
            raise UsageError(f"unknown baseline {name!r}; known: {', '.join(BASELINES)}")
    chosen = tuple(BASELINES[name] for name in dict.fromkeys(names))
    for method in chosen:
        method.settings()  # loads its library
    return chosen
