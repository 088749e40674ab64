"""The promise that matters most: what can't be right is never called trusted, and plain cases are.

End to end with the bundled weights. ``utopic bench confidence`` measures the same on hundreds of pairs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from utopic_cli.benchmark.solids import SYMMETRIC
from utopic_cli.cli import app
from utopic_cli.config import AlignOptions
from utopic_cli.geometry.rigid import random_rotation, relative_rotation_error_deg, rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.pipeline import register
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.demo_object import demo_mesh, demo_pair
from utopic_cli.synthesis.scanner import range_scan
from utopic_cli.synthesis.surface import bounding_diagonal, sample_surface

pytestmark = pytest.mark.slow

OPTIONS = AlignOptions(threads=1)


def seen(mesh, towards, rng, window=None) -> PointCloud:
    """Scan a mesh from a side, and put the scan into a random pose."""
    points, normals = sample_surface(*mesh, 150_000, rng)
    if window is not None:
        inside = (np.abs(points - window) < 0.8).all(axis=1)
        points, normals = points[inside], normals[inside]
    view = np.array(towards, dtype=float)
    extent = bounding_diagonal(points)
    scan = range_scan(
        points, normals, view / np.linalg.norm(view), rng, cell=extent / 150, count=8000, noise=0.001 * extent
    )
    return PointCloud(scan.points).transformed(rigid(random_rotation(rng), rng.standard_normal(3)))


def test_a_plain_pair_is_trusted() -> None:
    pair = demo_pair(np.random.default_rng(0), points=8000)
    result = register(pair.source, pair.target, OPTIONS)
    assert relative_rotation_error_deg(result.T_target_source, pair.gt_T_target_source) < 1.0
    assert result.trusted and result.confidence is not None and result.confidence > 0.95


@pytest.mark.parametrize("side", [[1.0, 0.1, 0.0], [0.0, 1.0, 0.2]], ids=["front and back", "left and right"])
def test_scans_from_opposite_sides_are_never_trusted(side: list[float]) -> None:
    rng = np.random.default_rng(1)
    front, back = seen(demo_mesh(), side, rng), seen(demo_mesh(), [-x for x in side], rng)
    # Opposite orthographic views share the outline at most.
    result = register(front, back, OPTIONS)
    assert not result.trusted and result.reasons


def test_scans_that_share_nothing_end_with_exit_code_3(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    paths = []
    for name, side in (("left", -1.0), ("right", 1.0)):
        points = sample_surface(*demo_mesh(), 60_000, rng)[0].astype(np.float64)
        points = points[side * points[:, 1] > 0.08]
        cloud = PointCloud(points[:9000]).transformed(rigid(random_rotation(rng), rng.standard_normal(3)))
        paths.append(tmp_path / f"{name}.ply")
        paths[-1].write_bytes(scalar_cloud_ply(cloud.points, np.zeros((len(cloud), 3), np.uint8), {}, ()))
    said = CliRunner().invoke(
        app, ["align", *map(str, paths), "-o", str(tmp_path / "T.txt"), "--threads", "1"]
    )
    assert said.exit_code == 3
    assert "do not trust it" in said.stderr and "because" in said.stderr
    assert (tmp_path / "T.txt").is_file()


def test_another_object_is_never_trusted() -> None:
    rng = np.random.default_rng(3)
    gear = SYMMETRIC["gear"][0](rng)
    result = register(seen(demo_mesh(), [1, 0.3, 0.2], rng), seen(gear, [0.2, 0.3, 1], rng), OPTIONS)
    assert not result.trusted


def test_a_mirror_image_is_never_trusted() -> None:
    rng = np.random.default_rng(4)
    vertices, faces = demo_mesh()
    mirrored = vertices * [1.0, -1.0, 1.0], faces[:, ::-1]
    result = register(seen(mirrored, [1, 0.6, 0.2], rng), seen(demo_mesh(), [1, 0.6, 0.2], rng), OPTIONS)
    assert not result.trusted


@pytest.mark.parametrize("name", ["plane", "sphere", "cylinder", "cube", "gear"])
def test_symmetric_things_are_never_trusted_and_the_reason_is_named(name: str) -> None:
    rng = np.random.default_rng(5)
    mesh = SYMMETRIC[name][0](rng)
    windows = ([0.0, 0.0, 0.0], [0.4, 0.3, 0.0]) if name == "plane" else (None, None)
    views = ([0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]) if name == "plane" else ([1, 0.3, 0.5], [0.3, 1, 0.5])
    result = register(*(seen(mesh, view, rng, window) for view, window in zip(views, windows)), OPTIONS)
    assert not result.trusted
    if name in ("plane", "sphere", "cylinder"):
        assert any("not determined" in reason for reason in result.reasons)
        assert result.observability is not None and result.observability.free
    else:
        assert result.ambiguous_with
        assert any("poses fit about equally well" in reason for reason in result.reasons)
