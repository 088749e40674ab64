"""Shapes whose free motions are known, seen through noisy samples and estimated normals."""

from __future__ import annotations

import numpy as np
import pytest

from tests.estimation.conftest import lumpy_surface
from utopic_cli.estimation import observability
from utopic_cli.estimation.meeting import MOST_ALIKE, meet, self_agreement
from utopic_cli.estimation.observability import find_twists, observe, stiffness
from utopic_cli.estimation.surface import Surface, make_surface
from utopic_cli.geometry import rigid
from utopic_cli.geometry.normals import estimate_normals, orient_towards
from utopic_cli.geometry.voxel import voxel_downsample
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import Observability

VOXEL = 0.05


def surface(points: np.ndarray, viewpoint: np.ndarray) -> Surface:
    """A scan as the solver sees it: one point a voxel, normals from neighbours."""
    dense, _ = voxel_downsample(points, VOXEL)
    normals = orient_towards(dense, estimate_normals(dense, softness=VOXEL), viewpoint)
    return make_surface(PointCloud(dense, normals), VOXEL)


def plane(rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(-1, 1, (30_000, 3)) * [1.0, 0.8, 0.0]
    return points + rng.normal(0, 0.1 * VOXEL, points.shape)


def cylinder(rng: np.random.Generator) -> np.ndarray:
    angle, height = rng.uniform(-1.2, 1.2, 30_000), rng.uniform(-1, 1, 30_000)
    points = np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    return points + rng.normal(0, 0.1 * VOXEL, points.shape)


def sphere(rng: np.random.Generator) -> np.ndarray:
    points = rng.standard_normal((40_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points = points[points[:, 0] > 0.3]
    return points + rng.normal(0, 0.1 * VOXEL, points.shape)


def vase(rng: np.random.Generator) -> np.ndarray:
    """A surface of revolution about the z axis."""
    angle, height = rng.uniform(-1.5, 1.5, 40_000), rng.uniform(-1, 1, 40_000)
    radius = 0.6 + 0.2 * np.sin(4 * height)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def corner(rng: np.random.Generator) -> np.ndarray:
    sides = rng.uniform(0, 1, (30_000, 3))
    sides[np.arange(30_000), rng.integers(0, 3, 30_000)] = 0.0
    return sides


def seen(source: Surface, target: Surface, T: np.ndarray) -> Observability:
    twists = find_twists(source, target, T)
    assert twists is not None
    return observe(twists, target.voxel)


@pytest.fixture
def pose() -> np.ndarray:
    rng = np.random.default_rng(5)
    return rigid.rigid(rigid.random_rotation(rng), rng.standard_normal(3))


@pytest.fixture
def far() -> np.ndarray:
    return np.array([20.0, 3.0, 40.0])


@pytest.mark.parametrize(
    ("shape", "rotations", "translations"),
    [(plane, 1, 2), (cylinder, 1, 1), (sphere, 3, 0), (vase, 1, 0), (corner, 0, 0)],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_free_motions_of_known_shapes_are_counted_in_any_pose(shape, rotations, translations, pose, far):
    rng = np.random.default_rng(0)
    viewpoint = far if shape is plane else np.array([40.0, 5.0, 8.0])
    source = surface(shape(rng), viewpoint)
    target = surface(rigid.apply(pose, shape(rng)), rigid.apply(pose, viewpoint))
    found = seen(source, target, pose)
    kinds = [motion.kind for motion in found.free]
    assert (kinds.count("rotation"), kinds.count("translation")) == (rotations, translations)
    assert (np.diff(found.eigenvalues) >= 0).all()


def test_axes_are_where_they_are(pose):
    rng = np.random.default_rng(1)
    viewpoint = np.array([40.0, 5.0, 8.0])
    source = surface(cylinder(rng), viewpoint)
    target = surface(rigid.apply(pose, cylinder(rng)), rigid.apply(pose, viewpoint))
    axis, through = pose[:3, 2], pose[:3, 3]
    for motion in seen(source, target, pose).free:
        assert abs(motion.axis @ axis) > np.cos(np.radians(2.0))
        if motion.kind == "rotation":
            off = motion.point - through
            assert np.linalg.norm(off - (off @ axis) * axis) < 0.05


def test_the_covariance_is_that_of_repeated_fits():
    """Point-to-plane fits of noisy copies scatter as the covariance says."""
    rng = np.random.default_rng(2)
    cloud = lumpy_surface(6000, 0.0)
    sigma, voxel = 0.002, 0.03
    target = make_surface(cloud, voxel)
    predicted, twists = [], []
    for _ in range(60):
        noisy = PointCloud(
            cloud.points + rng.normal(0, sigma, (len(cloud), 1)) * cloud.normals, cloud.normals
        )
        found = seen(make_surface(noisy, voxel), target, np.eye(4))
        rows = np.concatenate([np.cross(cloud.points - found.centre, cloud.normals), cloud.normals], axis=1)
        offsets = np.einsum("nd,nd->n", cloud.points - noisy.points, cloud.normals)
        twists.append(np.linalg.lstsq(rows, offsets, rcond=None)[0])
        predicted.append(found.covariance)
    measured = np.cov(np.array(twists).T)
    ratio = np.sqrt(np.diag(np.mean(predicted, axis=0)) / np.diag(measured))
    assert ((ratio > 0.7) & (ratio < 1.4)).all()


def test_surfaces_that_do_not_meet_have_no_answer():
    cloud = make_surface(lumpy_surface(3000, 0.0), 0.03)
    assert find_twists(cloud, cloud, rigid.rigid(np.eye(3), np.array([50.0, 0, 0]))) is None


def felt(source: Surface, target: Surface, T: np.ndarray, alike: float) -> float:
    return stiffness(source, target, T, find_twists(source, target, T), alike)


def stiffness_of(shape, **how) -> float:  # type: ignore[no-untyped-def]
    source, target = (
        surface(shape(np.random.default_rng(seed), **how), np.array([9.0, 2.0, 9.0])) for seed in (1, 2)
    )
    alike = self_agreement(source, target)
    return felt(source, target, np.eye(4), alike)


@pytest.mark.parametrize("shape", [plane, cylinder])
def test_a_surface_displaced_along_itself_fits_as_well(shape) -> None:  # type: ignore[no-untyped-def]
    assert stiffness_of(shape) < 0.005


def profile(rng: np.random.Generator, notch: float = 0.0) -> np.ndarray:
    """A wavy bar along y; a notch across it, ``notch`` deep, ends its freedom to slide."""
    x, y = rng.uniform(-1, 1, (2, 60_000))
    z = 0.4 * np.sin(3 * x) - notch * (np.abs(y) < 0.15)
    return np.stack([x, y, z], axis=1) + rng.normal(0, 0.1 * VOXEL, (60_000, 3))


def test_a_bar_slides_along_itself_and_a_notch_stops_it() -> None:
    assert stiffness_of(profile) < 0.005
    assert stiffness_of(profile, notch=0.1) > 0.1


def test_rough_scans_that_agree_better_than_with_themselves_are_stiff_as_well() -> None:
    """Their likeness is cut off at its largest, here and displaced: what falls is the agreement."""
    source, target = (
        surface(profile(np.random.default_rng(seed), notch=0.2), np.array([9.0, 2.0, 9.0])) for seed in (1, 2)
    )
    along = rigid.rigid(np.eye(3), np.array([0.0, 0.1, 0.0]))
    assert meet(source, target, np.eye(4), 0.3).likeness == MOST_ALIKE
    assert meet(source, target, along, 0.3).likeness == MOST_ALIKE
    assert felt(source, target, np.eye(4), 0.3) > 0.1


def test_points_that_meet_only_once_displaced_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rough points of four meet, one agrees; displaced, the two flat ones meet as well, and agree."""
    here = np.array([True, True, False, False]), np.array([True, False, False, False])
    there = np.array([True, True, True, True]), np.array([False, False, True, True])
    monkeypatch.setattr(
        observability, "agreeing", lambda source, target, T: here if np.array_equal(T, np.eye(4)) else there
    )
    one = surface(profile(np.random.default_rng(1)), np.array([9.0, 2.0, 9.0]))
    assert felt(one, one, np.eye(4), 0.4) == 1.25


def test_where_nothing_overlaps_nothing_is_stiff() -> None:
    one = surface(plane(np.random.default_rng(1)), np.array([0.0, 0.0, 9.0]))
    assert felt(one, one, rigid.rigid(np.eye(3), np.array([50.0, 0.0, 0.0])), 1.0) == 0.0


def test_a_line_turns_about_itself_unnoticed() -> None:
    """Twelve points on a line overlap; turning about it moves none of them."""
    line = np.zeros((12, 3))
    line[:, 0] = np.linspace(0.0, 1.0, 12)
    for along in (np.eye(3), rigid.rotation_from_vector(np.array([0.3, 0.5, 0.7]))):
        normals = np.tile(along @ [0.0, 0.0, 1.0], (12, 1))
        one = make_surface(PointCloud(line @ along.T, normals), VOXEL)
        assert felt(one, one, np.eye(4), 1.0) <= 0.0
