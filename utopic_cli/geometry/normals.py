"""Surface normals of unordered points: direction by local PCA, sign by propagation."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from utopic_cli.geometry.nearest import nearest

BLOCK = 4096  # points looked at at a time: what they take stays in the cache


def estimate_normals(
    points: np.ndarray,
    neighbours: int = 30,
    softness: float = np.inf,
    *,
    tree: cKDTree | None = None,
    at: np.ndarray | None = None,
) -> np.ndarray:
    """Fit a plane to each point's neighbourhood.

    Args:
        points: (N, 3) float64.
        neighbours: most neighbours used, the point itself included.
        softness: standard deviation of the Gaussian in the distance by which neighbours count (points'
            units); the nearest three, the point itself included, always count fully.
        tree: of the points, if there is one already.
        at: (K,) rows of the points whose normals are asked for; None for all.

    Returns:
        (N, 3), or (K, 3), float64 unit normals of arbitrary sign.
    """
    k = min(neighbours, len(points))
    tree = cKDTree(points) if tree is None else tree
    rows = np.arange(len(points)) if at is None else at
    axes = np.ascontiguousarray(points.T)  # coordinate by coordinate, each sum below runs along memory
    distances, indices = nearest(tree, points[rows], range(1, k + 1))
    covariance = np.empty((len(rows), 3, 3))
    for start in range(0, len(rows), BLOCK):
        block = slice(start, start + BLOCK)
        index = indices[block]
        weight = np.exp(-0.5 * (distances[block] / softness) ** 2)
        weight[:, : min(3, k)] = 1.0
        weight /= weight.sum(axis=1, keepdims=True)
        centred = []
        for axis in axes:
            offset = axis[index] - axis[rows[block], None]  # (B, k)
            centred.append(offset - np.einsum("nk,nk->n", weight, offset)[:, None])
        for i in range(3):
            weighted = weight * centred[i]
            for j in range(i, 3):
                entry = np.einsum("nk,nk->n", weighted, centred[j])
                covariance[block, i, j] = covariance[block, j, i] = entry
    return _smallest_eigenvector(covariance)


def orient_normals(points: np.ndarray, normals: np.ndarray, neighbours: int = 16) -> np.ndarray:
    """Make signs agree across the surface, and point away from the centroid on the whole.

    Signs are carried along a minimum spanning tree of the neighbour graph whose edges cost
    least where normals are parallel, so a sign crosses a crease only when it must. Gaps are
    bridged from the largest pieces, since one view shows all its pieces from the same side.
    What is still apart is flipped piece by piece so that the sum of n . (p - centroid) is
    positive. The rule uses nothing but the points, so two scans of one thing agree.

    Args:
        points: (N, 3) float64.
        normals: (N, 3) unit normals of any sign.
        neighbours: graph neighbours a point.

    Returns:
        (N, 3) float64 normals, each equal to the given one or its negative.
    """
    n = len(points)
    k = min(neighbours + 1, n)
    index = cKDTree(points).query(points, k=k)[1]
    rows, columns = np.repeat(np.arange(n), k - 1), index[:, 1:].ravel()
    bridge_rows, bridge_columns = _bridges(points, rows, columns)
    rows, columns = np.concatenate([rows, bridge_rows]), np.concatenate([columns, bridge_columns])
    agreement = np.einsum("nd,nd->n", normals[rows], normals[columns])
    cost = 1.0 - np.abs(agreement) + 1e-6  # a stored zero would read as "no edge"
    graph = csr_matrix((cost, (rows, columns)), shape=(n, n))
    tree = minimum_spanning_tree(graph.maximum(graph.T))
    tree = tree + tree.T
    pieces, piece = connected_components(tree, directed=False)
    parent = np.arange(n)
    for number in range(pieces):
        root = int(np.argmax(piece == number))
        order, predecessor = breadth_first_order(tree, root, directed=False)
        parent[order[1:]] = predecessor[order[1:]]
    sign = np.where(np.einsum("nd,nd->n", normals, normals[parent]) < 0, -1.0, 1.0)
    while not np.array_equal(parent, parent[parent]):  # pointer jumping: log2(depth) rounds
        sign = sign * sign[parent]
        parent = parent[parent]
    oriented = normals * sign[:, None]
    outward = np.bincount(
        piece, np.einsum("nd,nd->n", oriented, points - points.mean(axis=0)), minlength=pieces
    )
    return oriented * np.where(outward < 0, -1.0, 1.0)[piece][:, None]


def _bridges(
    points: np.ndarray, rows: np.ndarray, columns: np.ndarray, most: int = 32, width: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Join each of the largest pieces of a graph to the rest at the ``width`` narrowest gaps."""
    n = len(points)
    graph = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    pieces, piece = connected_components(graph, directed=False)
    bridges: list[np.ndarray] = [np.empty((2, 0), dtype=np.int64)]
    if pieces > 1:
        for number in np.argsort(-np.bincount(piece), kind="stable")[:most]:
            inside, outside = np.flatnonzero(piece == number), np.flatnonzero(piece != number)
            gap, nearest = cKDTree(points[outside]).query(points[inside])
            narrowest = np.argsort(gap, kind="stable")[:width]
            bridges.append(np.stack([inside[narrowest], outside[nearest[narrowest]]]))
    joined = np.concatenate(bridges, axis=1)
    return joined[0], joined[1]


def orient_towards(points: np.ndarray, normals: np.ndarray, viewpoint: np.ndarray) -> np.ndarray:
    """Flip (N, 3) normals to face a viewpoint (3,), as a scanner there sees the surface."""
    facing = np.einsum("nd,nd->n", normals, viewpoint - points)
    return normals * np.where(facing < 0, -1.0, 1.0)[:, None]


def _smallest_eigenvector(matrices: np.ndarray) -> np.ndarray:
    """Eigenvector of the smallest eigenvalue of (N, 3, 3) symmetric matrices -> (N, 3).

    The eigenvalue comes from the trigonometric solution of the cubic, the vector from the
    largest cross product of rows: several times faster than a general solver. Where two
    eigenvalues coincide the cross products vanish, and the general solver decides.
    """
    scale = np.trace(matrices, axis1=1, axis2=2) / 3.0
    scaled = matrices / np.maximum(scale, 1e-300)[:, None, None]
    shifted = scaled - np.eye(3)  # trace zero, since the mean eigenvalue is now 1
    half = np.sqrt(np.maximum(np.einsum("nij,nij->n", shifted, shifted) / 6.0, 1e-60))
    cosine = np.clip(np.linalg.det(shifted) / (2.0 * half**3), -1.0, 1.0)
    smallest = 1.0 + 2.0 * half * np.cos((np.arccos(cosine) + 2.0 * np.pi) / 3.0)
    rows = scaled - smallest[:, None, None] * np.eye(3)
    crosses = np.stack(
        [
            np.cross(rows[:, 0], rows[:, 1]),
            np.cross(rows[:, 1], rows[:, 2]),
            np.cross(rows[:, 2], rows[:, 0]),
        ],
        axis=1,
    )  # (N, 3, 3)
    lengths = np.linalg.norm(crosses, axis=2)
    best = lengths.argmax(axis=1)
    each = np.arange(len(matrices))
    vector, length = crosses[each, best], lengths[each, best]
    poor = ~(length > 1e-6)
    vector = np.where(poor[:, None], 0.0, vector) / np.maximum(length, 1e-6)[:, None]
    if poor.any():
        vector[poor] = np.linalg.eigh(matrices[poor])[1][:, :, 0]
    return vector
