"""The rigid transformation that best maps one set of points onto its partners."""

from __future__ import annotations

import numpy as np


def weighted_procrustes(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Minimise sum_k w_k |R s_k + t - t_k|^2 in closed form (the paper's SVD solver).

    Args:
        source: (K, 3) points.
        target: (K, 3) their partners.
        weights: (K,) not negative; zero takes a pair out.

    Returns:
        (4, 4) float64 T_target_source with a proper rotation (never a reflection).

    Raises:
        ValueError: fewer than three weighted pairs, or the points lie on one line, so that
            the rotation is not determined.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    weights = np.asarray(weights, np.float64)
    if not np.isfinite(weights).all() or (weights < 0).any():
        raise ValueError("weights must be finite and not negative")
    if np.count_nonzero(weights) < 3:
        raise ValueError("a rigid transformation needs at least three weighted correspondences")
    T, spread = procrustes_batch(source[None], target[None], weights[None])
    if not spread[0] > 1e-9:
        raise ValueError("the correspondences lie on one line or point: no unique rotation")
    return T[0]


def procrustes_batch(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve B weighted Procrustes problems at once.

    Args:
        source: (B, K, 3).
        target: (B, K, 3).
        weights: (B, K) not negative, each row with a positive sum.

    Returns:
        transformations: (B, 4, 4) T_target_source.
        spread: (B,) second singular value of the cross-covariance over its first, in
            [0, 1]: near 0 the points are collinear and the rotation is arbitrary.
    """
    share = weights / weights.sum(axis=1, keepdims=True)
    source_mean = np.einsum("bk,bkd->bd", share, source)
    target_mean = np.einsum("bk,bkd->bd", share, target)
    centred_source = source - source_mean[:, None]
    centred_target = target - target_mean[:, None]
    covariance = (centred_source * share[..., None]).transpose(0, 2, 1) @ centred_target  # (B, 3, 3)
    return _from_covariance(covariance, source_mean, target_mean)


def procrustes_shared(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve B Procrustes problems over the same pairs, weighted differently, by one matrix product.

    Args:
        source: (K, 3).
        target: (K, 3).
        weights: (B, K) not negative, each row with a positive sum.

    Returns:
        transformations: (B, 4, 4) T_target_source.
        spread: (B,), see ``procrustes_batch``.
    """
    share = weights / weights.sum(axis=1, keepdims=True)
    # Centred on all the pairs, so that little is lost in the difference below.
    source_centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    source, target = source - source_centre, target - target_centre
    source_mean, target_mean = share @ source, share @ target
    products = (source[:, :, None] * target[:, None]).reshape(-1, 9)
    covariance = (share @ products).reshape(-1, 3, 3) - source_mean[:, :, None] * target_mean[:, None]
    return _from_covariance(covariance, source_mean + source_centre, target_mean + target_centre)


def _from_covariance(
    covariance: np.ndarray, source_mean: np.ndarray, target_mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    u, singular, vt = np.linalg.svd(covariance)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    v = vt.transpose(0, 2, 1).copy()
    v[:, :, 2] *= sign[:, None]  # a reflection would fit mirrored noise better: forbid it
    rotation = v @ u.transpose(0, 2, 1)
    transformations = np.zeros((len(covariance), 4, 4))
    transformations[:, :3, :3] = rotation
    transformations[:, :3, 3] = target_mean - np.einsum("bij,bj->bi", rotation, source_mean)
    transformations[:, 3, 3] = 1.0
    return transformations, singular[:, 1] / np.maximum(singular[:, 0], 1e-300)
