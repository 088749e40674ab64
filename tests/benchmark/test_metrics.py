from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.benchmark.metrics import PoseError, overlap_band, pair_extent, pose_error, summarise
from utopic_cli.geometry.rigid import rigid
from utopic_cli.point_cloud import PointCloud


def about_z(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def test_the_right_answer_has_no_error() -> None:
    gt = rigid(about_z(73.0), np.array([1.0, 2.0, 3.0]))
    error = pose_error(gt, gt, np.array([4.0, 5.0, 6.0]), extent=2.0)
    assert error.rre_deg == pytest.approx(0.0, abs=1e-6)
    assert error.rte == error.rte_share == 0.0
    assert error.success


@pytest.mark.parametrize("degrees", [1e-4, 4.0, 90.0, 179.9, 180.0])
def test_known_angles_and_no_translation_error_at_the_centroid(degrees: float) -> None:
    centroid = np.array([10.0, -3.0, 2.0])
    rotation = about_z(degrees)
    spun = rigid(rotation, centroid - rotation @ centroid)  # about the centroid: it stays in place
    error = pose_error(spun, np.eye(4), centroid, extent=1.0)
    assert error.rre_deg == pytest.approx(degrees, rel=1e-6)
    assert error.rte == pytest.approx(0.0, abs=1e-12)
    assert error.success == (degrees < 5.0)


def test_translation_counts_in_shares_of_the_extent() -> None:
    shifted = rigid(np.eye(3), np.array([0.0, 3.0, 4.0]))
    assert pose_error(shifted, np.eye(4), np.zeros(3), extent=200.0).rte_share == pytest.approx(0.025)
    assert not pose_error(shifted, np.eye(4), np.zeros(3), extent=50.0).success


def test_the_bounds_themselves_are_failures() -> None:
    assert PoseError(4.999, 0.0, 0.0499).success
    assert not PoseError(5.0, 0.0, 0.0).success
    assert not PoseError(0.0, 0.0, 0.05).success


def test_extent_is_the_larger_scans_diagonal() -> None:
    small = PointCloud(np.array([[0.0, 0, 0], [1, 1, 1]]))
    large = PointCloud(np.array([[100.0, 0, 0], [103, 4, 12]]))
    assert pair_extent(small, large) == pair_extent(large, small) == 13.0


@pytest.mark.parametrize(
    ("overlap", "band"),
    [
        (1.0, ">= 0.5"),
        (0.5, ">= 0.5"),
        (0.4999, "0.3-0.5"),
        (0.3, "0.3-0.5"),
        (0.1, "0.1-0.3"),
        (0.0, "< 0.1"),
    ],
)
def test_bands_include_their_lower_end(overlap: float, band: str) -> None:
    assert overlap_band(overlap) == band


def test_no_band_for_a_missing_overlap() -> None:
    with pytest.raises(ValueError, match="nan"):
        overlap_band(float("nan"))


def test_a_missing_estimate_counts_as_infinitely_wrong() -> None:
    good, better, bad = PoseError(1.0, 0.1, 0.01), PoseError(0.5, 0.1, 0.02), PoseError(120.0, 9.0, 0.9)
    summary = summarise([good, None, better, bad], [1.0, 2.0, 3.0, 6.0], [4.0, 0.0, 0.0, 4.0])
    assert (summary.attempts, summary.successes, summary.success_rate) == (4, 2, 0.5)
    assert summary.median_rre_deg_of_successes == 0.75
    assert summary.median_rre_deg == pytest.approx(60.5)
    assert summary.median_rte_share_of_successes == pytest.approx(0.015)
    assert (summary.mean_seconds, summary.mean_cpu_seconds) == (3.0, 2.0)


def test_medians_without_a_value_are_none() -> None:
    summary = summarise([None, None, PoseError(90.0, 1.0, 1.0)], [1.0] * 3, [1.0] * 3)
    assert summary.median_rre_deg is None
    assert summary.median_rre_deg_of_successes is None
    with pytest.raises(ValueError, match="nothing"):
        summarise([], [], [])
