"""Pairs that are hard for a reason, from random start poses, with the options as they come."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from utopic_cli.benchmark.ground_truth import read_ground_truth
from utopic_cli.benchmark.metrics import pair_extent, pose_error
from utopic_cli.benchmark.scans import start_transformation
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError
from utopic_cli.geometry.rigid import invert
from utopic_cli.io.scan import read_scan
from utopic_cli.pipeline import register
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import RegistrationResult
from utopic_cli.synthesis.demo_object import demo_mesh, demo_pair
from utopic_cli.synthesis.scan_pair import ScanPair, posed_pair
from utopic_cli.synthesis.scanner import range_scan
from utopic_cli.synthesis.surface import bounding_diagonal, sample_surface

pytestmark = pytest.mark.slow

SCANS = Path(__file__).parents[2] / "shared" / "scans"
OPTIONS = AlignOptions(threads=1)


def assert_aligned(
    source: PointCloud, target: PointCloud, gt_T_target_source: np.ndarray
) -> RegistrationResult:
    """Register, and ask for under 5 degrees and under 5 % of the extent at the source's centroid."""
    result = register(source, target, OPTIONS)
    extent = pair_extent(source, target)
    error = pose_error(result.T_target_source, gt_T_target_source, source.points.mean(axis=0), extent)
    assert error.success, f"{error.rre_deg:.3g} degrees, {error.rte_share:.3g} of the extent"
    return result


@pytest.mark.parametrize("name", ["indoor", "lidar"])
@pytest.mark.parametrize("pose", [0, 1])
def test_a_real_pair_from_a_random_start_pose(name: str, pose: int) -> None:
    if not (SCANS / name / "gt.json").is_file():
        pytest.skip(f"there is no {SCANS / name}")
    (known,) = read_ground_truth(SCANS / name)
    source, target = read_scan(known.source).cloud, read_scan(known.target).cloud
    extent = pair_extent(source, target)
    start = start_transformation(4, known.index, pose, source.points.mean(axis=0), extent)
    assert_aligned(source.transformed(start), target, known.gt_T_target_source @ invert(start))


def scanned(
    mesh: tuple[np.ndarray, np.ndarray],
    views: tuple[list[float], list[float]],
    counts: tuple[int, int],
    rng: np.random.Generator,
) -> ScanPair:
    """Scan a mesh from two sides, each time from a sample of its own, with noise of 0.06 % of the extent."""
    extent = bounding_diagonal(mesh[0])
    clouds = []
    for view, count in zip(views, counts):
        surface, normals = sample_surface(*mesh, 300_000, rng)
        towards = np.array(view) / np.linalg.norm(view)
        scan = range_scan(
            surface, normals, towards, rng, cell=extent / 200, count=count, noise=0.0006 * extent
        )
        assert len(scan) > 0.9 * count
        clouds.append(scan.points)
    return posed_pair(clouds[0], clouds[1], "range_scan", extent, rng, translation=1.0)


def thin_plate(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A plate of 2 x 1.4 with a thickness of 0.04, and reliefs up to 0.08 high on both faces."""
    across, up = 121, 85
    x, y = np.meshgrid(np.linspace(-1, 1, across), np.linspace(-0.7, 0.7, up), indexing="ij")
    sides = []
    for side in (1.0, -1.0):
        height = np.full(x.shape, 0.02)
        for _ in range(14):
            at, size = rng.uniform([-0.9, -0.6], [0.9, 0.6]), rng.uniform(0.04, 0.2, 2)
            bump = np.exp(-(((x - at[0]) / size[0]) ** 2) - ((y - at[1]) / size[1]) ** 2)
            height += rng.uniform(0.02, 0.06) * bump
        sides.append(np.stack([x, y, side * np.minimum(height, 0.1)], axis=-1).reshape(-1, 3))
    number = np.arange(across * up).reshape(across, up)
    a, b, c, d = (
        part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    )
    front = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    rim = np.concatenate([number[:, 0], number[-1, 1:], number[-2::-1, -1], number[0, -2:0:-1]])
    after, back = np.roll(rim, -1), across * up
    edge = [np.stack([rim + back, after + back, after], 1), np.stack([rim + back, after, rim], 1)]
    return np.concatenate(sides), np.concatenate([front, front[:, ::-1] + back, *edge])


def test_a_thin_plate_seen_from_its_front() -> None:
    rng = np.random.default_rng(1)
    pair = scanned(thin_plate(rng), ([0.7, 0.1, 1.0], [-0.6, 0.3, 1.0]), (15_000, 15_000), rng)
    assert_aligned(pair.source, pair.target, pair.gt_T_target_source)


def test_a_thin_plate_seen_edge_on_by_one_scan() -> None:
    rng = np.random.default_rng(2)
    pair = scanned(thin_plate(rng), ([0.1, 0.2, 1.0], [1.0, 0.3, 0.3]), (15_000, 6_000), rng)
    assert_aligned(pair.source, pair.target, pair.gt_T_target_source)


@pytest.mark.parametrize("counts", [(20_000, 2_000), (2_000, 20_000)], ids=["sparse target", "sparse source"])
def test_scans_of_ten_times_different_density(counts: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    pair = scanned(demo_mesh(), ([0.85, -0.35, 0.4], [0.75, 0.65, 0.15]), counts, rng)
    assert_aligned(pair.source, pair.target, pair.gt_T_target_source)


@pytest.mark.parametrize("seed", [4, 5])
def test_twenty_percent_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = demo_pair(rng, points=12_000)
    clouds = []
    for cloud in (pair.source, pair.target):
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        margin = 0.1 * (high - low)
        outliers = rng.uniform(low - margin, high + margin, (len(cloud) // 4, 3))  # a fifth of all
        clouds.append(PointCloud(np.concatenate([cloud.points, outliers])))
    assert_aligned(clouds[0], clouds[1], pair.gt_T_target_source)


@pytest.mark.parametrize("larger", ["source", "target"])
def test_millimetres_against_metres_are_refused(larger: str) -> None:
    pair = demo_pair(np.random.default_rng(5), points=8_000)
    clouds = {"source": pair.source, "target": pair.target}
    clouds[larger] = PointCloud(1000 * clouds[larger].points)
    with pytest.raises(InputError) as caught:
        register(clouds["source"], clouds["target"], OPTIONS)
    message = str(caught.value)
    assert "bring both to the same unit" in message
    named = re.search(r"sizes differ by a factor of about ([0-9.e+]+)", message)
    extents = {name: float(np.linalg.norm(np.ptp(cloud.points, axis=0))) for name, cloud in clouds.items()}
    assert named is not None and f"the {larger} is the larger, " in message
    assert float(named[1]) == pytest.approx(max(extents.values()) / min(extents.values()), rel=0.01)
