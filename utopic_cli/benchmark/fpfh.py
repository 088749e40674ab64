"""Matching scores from hand-made features, so that the same solver can run on them.

FPFH (Rusu et al. 2009) by Open3D at two radii, on the very points and oriented normals that the
network is shown. What is left to compare is the matches alone: solver, refinement and metrics are
the same, overlap is taken to be everywhere and every point to be certain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.benchmark.open3d_methods import load_open3d
from utopic_cli.bridge import NetworkView
from utopic_cli.frame import DENSE_RATIO
from utopic_cli.preprocess import PreparedPair, SampledCloud

RADII = (5.0, 9.0)  # in voxels
MOST_NEIGHBOURS = 200
SHARPNESS = 6.0  # of the softmax, per standard deviation of the similarities


@dataclass(frozen=True)
class Fpfh:
    """FPFH behind the interface of ``matcher.Matcher``.

    Attributes:
        name: what the tables call it.
        tells_overlap: it knows nothing of overlap.
        looks_again: it makes no use of a transformation.
    """

    name: str = "fpfh"
    tells_overlap: bool = False
    looks_again: bool = False

    def settings(self) -> dict[str, Any]:
        """Return everything needed to repeat it, JSON-ready."""
        return {
            "features": "FPFH of the prepared clouds, oriented normals",
            "radii_in_voxels": list(RADII),
            "most_neighbours": MOST_NEIGHBOURS,
            "softmax_sharpness": SHARPNESS,
            "open3d": load_open3d().__version__,
        }

    def look_again(
        self, prepared: PreparedPair, first: NetworkView, hypothesis: np.ndarray, odds: float
    ) -> NetworkView:
        """Return its first view: a transformation changes nothing."""
        return first

    def look(self, prepared: PreparedPair) -> NetworkView:
        """Return its view of a prepared pair."""
        features = [_node_features(cloud, prepared.spacing) for cloud in (prepared.source, prepared.target)]
        scores = dual_softmax(features[0] @ features[1].T)
        n, m = scores.shape
        return NetworkView(scores, np.ones(n), np.ones(m), np.zeros(n), np.zeros(m), np.zeros(n), np.zeros(m))


def dual_softmax(similarity: np.ndarray, sharpness: float = SHARPNESS) -> np.ndarray:
    """Turn similarities into matching scores: geometric mean of the softmax over rows and columns.

    Args:
        similarity: (N, M); its own mean and spread don't matter.
        sharpness: logits per standard deviation.

    Returns:
        (N, M) in [0, 1], high where both points prefer each other.
    """
    logits = sharpness * (similarity - similarity.max()) / max(float(similarity.std()), 1e-12)
    by_row = np.exp(logits - logits.max(axis=1, keepdims=True))
    by_column = np.exp(logits - logits.max(axis=0, keepdims=True))
    by_row /= by_row.sum(axis=1, keepdims=True)
    by_column /= by_column.sum(axis=0, keepdims=True)
    return np.sqrt(by_row * by_column)


def _node_features(cloud: SampledCloud, spacing: float) -> np.ndarray:
    """Describe each node by the features of the dense point nearest to it -> (N, 66)."""
    o3d = load_open3d()
    shape = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.dense.points))
    shape.normals = o3d.utility.Vector3dVector(cloud.dense.normals)
    nearest = cKDTree(cloud.dense.points).query(cloud.points)[1]
    features = []
    for radius in RADII:
        search = o3d.geometry.KDTreeSearchParamHybrid(radius * spacing / DENSE_RATIO, MOST_NEIGHBOURS)
        found = o3d.pipelines.registration.compute_fpfh_feature(shape, search)
        feature = np.asarray(found.data).T[nearest]
        features.append(feature / np.maximum(np.linalg.norm(feature, axis=1, keepdims=True), 1e-9))
    return np.concatenate(features, axis=1)
