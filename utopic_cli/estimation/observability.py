"""What two aligned surfaces say about each of the six motions: which are fixed, and how well.

A small motion of the source is a twist (omega, v): it moves a point p by omega x p + v, as seen
from the middle of the overlap. Only what it moves along a surface's normal can be noticed, so the
normal matrix of the point-to-plane problem tells which motions the geometry fixes: an eigenvalue
near zero belongs to a motion that slides the surfaces along each other.
"""

from __future__ import annotations

import numpy as np

from utopic_cli.estimation.surface import Surface
from utopic_cli.geometry import rigid
from utopic_cli.result import FreeMotion, Observability

REACH = 1.5
"""Points within this many voxels of the other surface, with agreeing normals, are in the overlap."""

AGREEING = 0.7  # cosine between normals
FREE = 0.0015
"""Below this share of the largest eigenvalue a motion counts as not fixed.

It is what normals that are off by two degrees make of a motion that is really free.
"""


def observe(source: Surface, target: Surface, transformation: np.ndarray) -> Observability:
    """Look at the overlap of two aligned surfaces.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformation: (4, 4) T_target_source.

    Raises:
        ValueError: fewer than six points overlap, or all of them in one place.
    """
    moved = rigid.apply(transformation, source.points)
    turned = source.normals @ transformation[:3, :3].T
    distance, index = target.tree.query(moved, distance_upper_bound=REACH * target.voxel)
    found = np.isfinite(distance)
    found[found] = np.einsum("nd,nd->n", turned[found], target.normals[index[found]]) > AGREEING
    if found.sum() < 6:
        raise ValueError(f"only {int(found.sum())} points overlap")
    points, normals = target.points[index[found]], target.normals[index[found]]
    offsets = np.einsum("nd,nd->n", moved[found] - points, normals)
    centre = points.mean(axis=0)
    arms = points - centre
    radius = float(np.sqrt(np.einsum("nd,nd->n", arms, arms).mean()))
    if not radius > 0:
        raise ValueError("all overlapping points coincide")
    rows = np.concatenate([np.cross(arms / radius, normals), normals], axis=1)  # (K, 6)
    eigenvalues, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    free = vectors[:, eigenvalues < FREE * eigenvalues[-1]]
    # One voxel holds one independent measurement, however many points were averaged in it.
    variance = float(np.mean(np.minimum(offsets**2, (REACH * target.voxel) ** 2)))
    floored = np.maximum(eigenvalues, 0.1 * FREE * eigenvalues[-1])
    scale = np.concatenate([np.full(3, 1.0 / radius), np.ones(3)])  # back from omega * radius to omega
    covariance = (vectors * (variance / (len(rows) * floored))) @ vectors.T * np.outer(scale, scale)
    return Observability(
        np.maximum(eigenvalues, 0.0), _named(free, radius, centre), covariance, centre, len(rows)
    )


def _named(free: np.ndarray, radius: float, centre: np.ndarray) -> tuple[FreeMotion, ...]:
    """Sort a space of free twists (6, k), rotations times ``radius``, into translations and rotations.

    Eigenvectors of equal eigenvalues come mixed; translations are the part of the space without
    rotation, and what is left turns about axes.
    """
    if not free.shape[1]:
        return ()
    # Right singular vectors of the rotational part: the last ones, without any, are translations.
    _, strength, mixed = np.linalg.svd(free[:3])
    strength = np.concatenate([strength, np.zeros(free.shape[1] - len(strength))])
    twists = free @ mixed.T
    motions = []
    for twist, rotational in zip(twists.T, strength, strict=True):
        omega, shift = twist[:3] / radius, twist[3:]
        if rotational < 0.2:
            motions.append(FreeMotion("translation", _upright(shift / np.linalg.norm(shift))))
        else:
            axis = omega / np.linalg.norm(omega)
            # The axis runs where omega x p + v has no part across it.
            point = centre + np.cross(omega, shift) / float(omega @ omega)
            motions.append(FreeMotion("rotation", _upright(axis), point))
    return tuple(motions)


def _upright(axis: np.ndarray) -> np.ndarray:
    """Choose the sign of an axis so that its largest coordinate is positive."""
    return axis * (1.0 if axis[np.abs(axis).argmax()] > 0 else -1.0)
