"""What two aligned surfaces say about each of the six motions: which are fixed, and how well.

A small motion of the source is a twist (omega, v): it moves a point p by omega x p + v, as seen
from the middle of the overlap. Only what it moves along a surface's normal can be noticed, so the
normal matrix of the point-to-plane problem tells which motions the geometry fixes: an eigenvalue
near zero belongs to a motion that slides the surfaces along each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from utopic_cli.estimation.meeting import agreeing
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

DISPLACED = 0.05
"""Share of the scans' size by which a source is moved to see whether that is noticed: what a right
answer may be off by."""

LEAST_FIXED = 3
"""So many of the six motions are tried."""

STILL = 1e-6
"""A unit twist that moves the overlap by no more turns a line about itself: nothing notices that."""


@dataclass(frozen=True)
class Twists:
    """The eigenvectors of the point-to-plane problem in an overlap.

    Attributes:
        eigenvalues: (6,) per point, ascending.
        vectors: (6, 6) columns (omega * radius, v).
        centre: (3,) middle of the overlap.
        arms: (K, 3) its points from there.
        radius: root mean square length of the arms.
        offsets: (K,) signed distances of the source's points from the target's planes.
    """

    eigenvalues: np.ndarray
    vectors: np.ndarray
    centre: np.ndarray
    arms: np.ndarray
    radius: float
    offsets: np.ndarray

    @property
    def count(self) -> int:
        """K, how many points overlap."""
        return len(self.arms)


def find_twists(source: Surface, target: Surface, transformation: np.ndarray) -> Twists | None:
    """Look at the overlap of two aligned surfaces.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformation: (4, 4) T_target_source.

    Returns:
        Its twists; None if fewer than six points overlap, or all of them in one place.
    """
    moved = rigid.apply(transformation, source.points)
    turned = source.normals @ transformation[:3, :3].T
    distance, index = target.tree.query(moved, distance_upper_bound=REACH * target.voxel)
    found = np.isfinite(distance)
    found[found] = np.einsum("nd,nd->n", turned[found], target.normals[index[found]]) > AGREEING
    if found.sum() < 6:
        return None
    points, normals = target.points[index[found]], target.normals[index[found]]
    offsets = np.einsum("nd,nd->n", moved[found] - points, normals)
    centre = points.mean(axis=0)
    arms = points - centre
    radius = float(np.sqrt(np.einsum("nd,nd->n", arms, arms).mean()))
    if not radius > 0:
        return None
    rows = np.concatenate([np.cross(arms / radius, normals), normals], axis=1)  # (K, 6)
    eigenvalues, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    return Twists(eigenvalues, vectors, centre, arms, radius, offsets)


def observe(twists: Twists, voxel: float) -> Observability:
    """Tell which motions an overlap fixes, and how well.

    Args:
        twists: of the overlap.
        voxel: of the target.
    """
    eigenvalues, vectors = twists.eigenvalues, twists.vectors
    free = vectors[:, eigenvalues < FREE * eigenvalues[-1]]
    # One voxel holds one independent measurement, however many points were averaged in it.
    variance = float(np.mean(np.minimum(twists.offsets**2, (REACH * voxel) ** 2)))
    floored = np.maximum(eigenvalues, 0.1 * FREE * eigenvalues[-1])
    scale = np.concatenate([np.full(3, 1.0 / twists.radius), np.ones(3)])  # back from omega * radius to omega
    covariance = (vectors * (variance / (twists.count * floored))) @ vectors.T * np.outer(scale, scale)
    return Observability(
        np.maximum(eigenvalues, 0.0),
        _named(free, twists.radius, twists.centre),
        covariance,
        twists.centre,
        twists.count,
    )


def stiffness(
    source: Surface,
    target: Surface,
    transformation: np.ndarray,
    twists: Twists | None,
    alike: float,
) -> float:
    """Tell how much worse two surfaces agree once the source is moved by ``DISPLACED`` of their size.

    The normal matrix goes by infinitely small motions and by normals, which noise tilts; here the source
    is really moved, both ways along each of the motions that are fixed least. Compared are the points that
    meet the other surface before and after: which ones meet changes, and flat parts agree better than others.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformation: (4, 4) T_target_source.
        twists: ``find_twists`` of the three.
        alike: ``self_agreement`` of the two.

    Returns:
        The least fall of the share that lies in the other surface, in units of ``alike``: about 0 where a
        displaced source fits as well, and 0 where too little overlaps to tell.
    """
    if twists is None:
        return 0.0
    extent = max(float(np.linalg.norm(np.ptp(surface.points, axis=0))) for surface in (source, target))
    met, agree = agreeing(source, target, transformation)
    falls = []
    for twist in twists.vectors.T[:LEAST_FIXED]:
        omega, shift = twist[:3] / twists.radius, twist[3:]
        speed = np.sqrt(np.mean(np.sum((np.cross(omega, twists.arms) + shift) ** 2, axis=1)))
        if speed < STILL:
            return 0.0
        for amount in (DISPLACED * extent / speed, -DISPLACED * extent / speed):
            displaced = _screw(amount * omega, amount * (shift - np.cross(omega, twists.centre)))
            still_met, still_agree = agreeing(source, target, displaced @ transformation)
            both = met & still_met
            if both.any():  # else the displaced scans have parted, which is noticed
                falls.append(float(agree[both].mean() - still_agree[both].mean()))
    return min(falls, default=alike) / alike


def _screw(omega: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The motion (4, 4) that a twist about the origin makes in one unit of time."""
    x, y, z = omega
    generator = np.array([[0.0, -z, y, shift[0]], [z, 0.0, -x, shift[1]], [-y, x, 0.0, shift[2]], [0.0] * 4])
    return np.asarray(expm(generator))


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
