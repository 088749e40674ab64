"""What must not matter to an answer, and how little it does: order, unit, place, duplicates, attributes.

Where an input changes in rounding alone (unit, place, order), the answer does too, to the accuracy
at which refinement stops. Where the sampled points become others (a turned voxel grid, swapped
scans, points counted twice), refinement at full resolution still ends in the same place, to a
fraction of the points' own noise. Each tolerance is some ten times what was measured on these
scans with three seeds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from utopic_cli.cli import app
from utopic_cli.config import AlignOptions
from utopic_cli.geometry import rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.pipeline import register
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import RegistrationResult
from utopic_cli.synthesis.demo_object import demo_pair
from utopic_cli.synthesis.scan_pair import ScanPair

OPTIONS = AlignOptions(points=400, threads=1)
ROUNDING = (1e-4, 1e-6)
"""Degrees, and shares of the extent: measured 3e-7 degrees and 2e-9."""
SAME_SURFACES = (0.01, 1e-4)
"""The grid that samples the scans turns with them: measured 3e-6 degrees and 1e-8."""
OTHER_SAMPLES = (0.2, 0.001)
"""Other points are compared in refinement: measured 0.02 degrees and 1e-4."""
ONE_NEIGHBOUR = 0.02
"""Of a point's overlap, where rounding puts one neighbour more or less into a patch: measured 0.0025."""


@pytest.fixture(scope="module")
def pair() -> ScanPair:
    return demo_pair(np.random.default_rng(0), points=4000)


@pytest.fixture(scope="module")
def result(pair: ScanPair) -> RegistrationResult:
    return register(pair.source, pair.target, OPTIONS)


def moved_by(motion: np.ndarray, cloud: PointCloud) -> PointCloud:
    return PointCloud(rigid.apply(motion, cloud.points))


def random_motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))


def assert_same(
    found: np.ndarray, expected: np.ndarray, pair: ScanPair, tolerance: tuple[float, float]
) -> None:
    """Compare two transformations of the source: angle, and where they put its centroid."""
    assert rigid.is_rigid(found, 1e-9)
    assert rigid.relative_rotation_error_deg(found, expected) < tolerance[0]
    centroid = pair.source.points.mean(axis=0)
    assert rigid.relative_translation_error(found, expected, centroid) < tolerance[1] * pair.extent


def assert_same_verdict(found: RegistrationResult, expected: RegistrationResult) -> None:
    """A verdict may not hang on rounding; None where the weights carry no calibration."""
    assert found.trusted == expected.trusted
    assert (found.confidence is None) == (expected.confidence is None)
    if found.confidence is not None and expected.confidence is not None:
        assert abs(found.confidence - expected.confidence) < 0.01


def test_the_answer_that_the_others_are_compared_with_is_right(
    pair: ScanPair, result: RegistrationResult
) -> None:
    assert_same(result.T_target_source, pair.gt_T_target_source, pair, OTHER_SAMPLES)


def test_swapped_scans_give_the_inverse(pair: ScanPair, result: RegistrationResult) -> None:
    found = register(pair.target, pair.source, OPTIONS)
    assert_same(rigid.invert(found.T_target_source), result.T_target_source, pair, OTHER_SAMPLES)
    assert np.abs(found.target_overlap - result.source_overlap).mean() < 0.05


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_another_unit_scales_the_translation_and_nothing_else(
    pair: ScanPair, result: RegistrationResult, scale: float
) -> None:
    found = register(PointCloud(pair.source.points * scale), PointCloud(pair.target.points * scale), OPTIONS)
    expected = result.T_target_source
    np.testing.assert_allclose(found.T_target_source[:3, :3], expected[:3, :3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.T_target_source[:3, 3] / scale, expected[:3, 3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.source_overlap, result.source_overlap, rtol=0, atol=ONE_NEIGHBOUR)
    assert found.fit.inlier_rmse == pytest.approx(scale * result.fit.inlier_rmse, rel=1e-6)
    assert_same_verdict(found, result)


def test_twice_the_unit_doubles_the_translation_to_the_last_bit(
    pair: ScanPair, result: RegistrationResult
) -> None:
    # A power of two changes no digit of any number on the way.
    found = register(PointCloud(pair.source.points * 2), PointCloud(pair.target.points * 2), OPTIONS)
    assert np.array_equal(found.T_target_source[:3, :3], result.T_target_source[:3, :3])
    assert np.array_equal(found.T_target_source[:3, 3], 2 * result.T_target_source[:3, 3])
    assert np.array_equal(found.source_overlap, result.source_overlap)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_moved_source_composes(pair: ScanPair, result: RegistrationResult, seed: int) -> None:
    motion = random_motion(seed)
    found = register(moved_by(motion, pair.source), pair.target, OPTIONS)
    assert_same(found.T_target_source @ motion, result.T_target_source, pair, SAME_SURFACES)


def test_a_moved_target_composes(pair: ScanPair, result: RegistrationResult) -> None:
    motion = random_motion(3)
    found = register(pair.source, moved_by(motion, pair.target), OPTIONS)
    assert_same(rigid.invert(motion) @ found.T_target_source, result.T_target_source, pair, SAME_SURFACES)


@pytest.mark.parametrize("both", [True, False])
def test_map_coordinates_cost_their_rounding_only(
    pair: ScanPair, result: RegistrationResult, both: bool
) -> None:
    # Easting, northing and height in metres: doubles are 1e-9 apart there.
    shift = rigid.rigid(np.eye(3), np.array([5e5, 4.6e6, 300.0]))
    target = moved_by(shift, pair.target) if both else pair.target
    found = register(moved_by(shift, pair.source), target, OPTIONS)
    back = (rigid.invert(shift) if both else np.eye(4)) @ found.T_target_source @ shift
    assert_same(back, result.T_target_source, pair, ROUNDING)
    assert_same_verdict(found, result)


def test_the_order_of_the_points_does_not_matter(pair: ScanPair, result: RegistrationResult) -> None:
    rng = np.random.default_rng(4)
    orders = [rng.permutation(len(cloud)) for cloud in (pair.source, pair.target)]
    found = register(
        PointCloud(pair.source.points[orders[0]]), PointCloud(pair.target.points[orders[1]]), OPTIONS
    )
    assert_same(found.T_target_source, result.T_target_source, pair, ROUNDING)
    for side, order in zip(("source_overlap", "target_overlap"), orders):
        overlap, before = getattr(found, side), getattr(result, side)[order]
        np.testing.assert_allclose(overlap, before, rtol=0, atol=ONE_NEIGHBOUR)
    assert_same_verdict(found, result)


@pytest.mark.parametrize("both", [True, False])
def test_points_that_are_there_twice_count_once(
    pair: ScanPair, result: RegistrationResult, both: bool
) -> None:
    clouds = [PointCloud(np.concatenate([cloud.points] * 2)) for cloud in (pair.source, pair.target)]
    found = register(clouds[0], clouds[1] if both else pair.target, OPTIONS)
    assert_same(found.T_target_source, result.T_target_source, pair, OTHER_SAMPLES)
    first, second = np.split(found.source_overlap, 2)
    assert np.array_equal(first, second)
    assert np.abs(first - result.source_overlap).mean() < 0.05


# Through the command line, on files.


@pytest.fixture(scope="module")
def files(pair: ScanPair, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("files")
    paths = [folder / "a.ply", folder / "b.ply"]
    for path, cloud in zip(paths, (pair.source, pair.target)):
        path.write_bytes(scalar_cloud_ply(cloud.points, np.zeros((len(cloud), 3), np.uint8), {}))
    return paths


def arguments(scans: list[Path], out: Path, threads: int) -> list[str]:
    options = {"--out-dir": out, "--points": 400, "--seed": 5, "--threads": threads}
    flat = [str(part) for item in options.items() for part in item]
    return ["align", *map(str, scans), *flat, "--exit-zero", "--quiet"]


def align_here(scans: list[Path], out: Path, threads: int = 1) -> dict[str, bytes]:
    done = CliRunner().invoke(app, arguments(scans, out, threads))
    assert done.exit_code == 0, done.output
    return contents(out)


def align_apart(scans: list[Path], out: Path, threads: int) -> dict[str, bytes]:
    package = str(Path(__file__).parents[1])
    path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-m", "utopic_cli", *arguments(scans, out, threads)]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": path})
    return contents(out)


def contents(out: Path) -> dict[str, bytes]:
    """Every file's bytes; of the report all but the threads and the seconds that the steps took.

    The page for people shows the same and says these seconds too.
    """
    found = {path.name: path.read_bytes() for path in out.iterdir() if path.suffix != ".html"}
    report = json.loads(found["report.json"])
    assert report.pop("timings_s")
    assert report["options"].pop("threads")
    found["report.json"] = json.dumps(report).encode()
    return found


def test_the_same_seed_gives_the_same_bytes_with_any_number_of_threads(
    files: list[Path], tmp_path: Path
) -> None:
    first = align_apart(files, tmp_path / "apart", threads=2)
    assert len(first) >= 7
    for number, threads in enumerate((2, 1, 3)):
        again = align_here(files, tmp_path / f"here{number}", threads)
        assert again.keys() == first.keys()
        assert [name for name in first if again[name] != first[name]] == []


@pytest.mark.slow
def test_a_thousand_points_give_the_same_bits_with_any_number_of_threads() -> None:
    dense = demo_pair(np.random.default_rng(1), points=12_000)
    found = [register(dense.source, dense.target, AlignOptions(threads=threads)) for threads in (1, 2, 3)]
    for result in found[1:]:
        for name in ("T_target_source", "source_overlap", "source_uncertainty", "target_overlap"):
            assert np.array_equal(getattr(result, name), getattr(found[0], name)), name


def columns_of(ply: bytes) -> dict[str, np.ndarray]:
    vertices = trimesh.load(BytesIO(ply), file_type="ply", process=False).metadata["_ply_raw"]["vertex"]
    return {name: vertices["data"][name] for name in vertices["properties"]}


def test_attributes_of_the_points_change_nothing(pair: ScanPair, files: list[Path], tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    dressed = []
    for path, cloud in zip(files, (pair.source, pair.target)):
        colours = rng.integers(0, 256, cloud.points.shape).astype(np.uint8)
        normals = rng.standard_normal(cloud.points.shape)  # nonsense, as in many files
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        scalars = {name: column.astype(np.float32) for name, column in zip(("nx", "ny", "nz"), normals.T)}
        scalars["intensity"] = rng.random(len(cloud)).astype(np.float32)
        dressed.append(tmp_path / path.name)
        dressed[-1].write_bytes(scalar_cloud_ply(cloud.points, colours, scalars))
    plain, rich = align_here(files, tmp_path / "plain"), align_here(dressed, tmp_path / "rich")
    assert rich.keys() == plain.keys()
    changed = {name for name in plain if rich[name] != plain[name]}
    clouds = {f"{side}_{field}.ply" for side in ("source", "target") for field in ("overlap", "uncertainty")}
    # The clouds and the aligned scan keep the attributes, the report the hash.
    assert changed == {"aligned.ply", "report.json"} | clouds
    for name in clouds:
        without, with_them = (columns_of(out[name]) for out in (plain, rich))
        assert set(with_them) > set(without) > {"x", "y", "z", "red", "quality"}
        for column, values in without.items():
            if not column.startswith("scalar_original_"):  # colours are attributes, too
                np.testing.assert_array_equal(with_them[column], values, err_msg=column)
    reports = [json.loads(out["report.json"]) for out in (plain, rich)]
    for report in reports:
        for side in ("source", "target"):
            del report[side]
    assert reports[0] == reports[1]
