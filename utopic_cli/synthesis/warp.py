"""Smooth random deformations: they turn plain meshes into detailed, organic surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.synthesis.surface import BLOCK

LONGEST_WAVE, SHORTEST_WAVE = 1.2, 0.08  # in extents


@dataclass(frozen=True)
class SmoothWarp:
    """The map ``x -> x + sum_k displacement_k sin(wave_k . x + phase_k)``.

    Attributes:
        waves: (K, 3) float32 wave vectors, 2 pi / wavelength long.
        phases: (K,) float32.
        displacements: (K, 3) float32 amplitudes with direction.
    """

    waves: np.ndarray
    phases: np.ndarray
    displacements: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Move (N, 3) points; returns (N, 3) float32."""
        moved = np.array(points, dtype=np.float32)
        for start in range(0, len(moved), BLOCK):
            part = moved[start : start + BLOCK]
            part += np.sin(part @ self.waves.T + self.phases) @ self.displacements
        return moved

    def normals(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the unit normals (N, 3) of the warped surface.

        Two surface tangents are pushed through the warp's derivative and crossed, which
        is exact and needs no inverse.

        Args:
            points: (N, 3) points *before* the warp.
            normals: (N, 3) unit normals before the warp.
        """
        points = np.asarray(points, dtype=np.float32)
        warped = np.empty_like(points)
        for start in range(0, len(points), BLOCK):
            block = slice(start, start + BLOCK)
            slopes = np.cos(points[block] @ self.waves.T + self.phases)  # (BLOCK, K)
            first, second = (
                tangent + (slopes * (tangent @ self.waves.T)) @ self.displacements
                for tangent in tangents(np.asarray(normals[block], dtype=np.float32))
            )
            warped[block] = unit(_cross(first, second))
        return warped


def random_warp(
    rng: np.random.Generator,
    extent: float = 2.0,
    strength: float = 0.02,
    octaves: int = 5,
    waves_per_octave: int = 4,
) -> SmoothWarp:
    """Draw a warp of ``octaves`` octaves, wavelengths 1.2 ... 0.08 of the extent.

    Args:
        rng: source of randomness.
        extent: size of the object the warp is for; wavelengths and amplitudes scale with it.
        strength: amplitude over wavelength of an octave, on average. The same for all
            octaves, so each bends the surface by a similar angle; beyond about 0.05 the
            surface starts to fold over.
        octaves: number of wavelengths, geometrically spaced.
        waves_per_octave: plane waves an octave is the sum of.
    """
    lengths = np.geomspace(LONGEST_WAVE, SHORTEST_WAVE, octaves) * extent
    octave_strength = strength * rng.uniform(0.4, 1.6, octaves)
    wavelength = np.repeat(lengths, waves_per_octave) * rng.uniform(0.85, 1.15, octaves * waves_per_octave)
    amplitude = np.repeat(octave_strength, waves_per_octave) * wavelength * np.sqrt(2.0 / waves_per_octave)
    count = len(wavelength)
    waves = unit(rng.standard_normal((count, 3))) * (2.0 * np.pi / wavelength)[:, None]
    displacements = unit(rng.standard_normal((count, 3))) * amplitude[:, None]
    phases = rng.uniform(0.0, 2.0 * np.pi, count)
    return SmoothWarp(waves.astype(np.float32), phases.astype(np.float32), displacements.astype(np.float32))


def random_stretch(rng: np.random.Generator, most: float = 1.6) -> np.ndarray:
    """Draw a (3, 3) symmetric matrix that stretches along three random orthogonal axes.

    Args:
        rng: source of randomness.
        most: each axis is scaled by a factor log-uniform in [1 / most, most].
    """
    axes, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    factors = np.exp(rng.uniform(-np.log(most), np.log(most), 3))
    return axes @ np.diag(factors) @ axes.T


def compacting_stretch(vertices: np.ndarray, most: float) -> np.ndarray:
    """Return the (3, 3) stretch that makes a rod or a plate stouter.

    Args:
        vertices: (V, 3) of the object.
        most: the principal standard deviations end up within this factor of the largest.
            An object that is stout enough already gets the identity.
    """
    centred = vertices - vertices.mean(axis=0)
    variance, axes = np.linalg.eigh(centred.T @ centred / len(centred))
    deviation = np.sqrt(np.maximum(variance, 1e-6 * variance[2]))
    factors = np.maximum(deviation[2] / most / deviation, 1.0)
    return axes @ np.diag(factors) @ axes.T


def tangents(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors (N, 3) that complete unit normals (N, 3) to right-handed frames."""
    x, y, z = normals.T
    sign = np.where(z < 0, -1.0, 1.0).astype(normals.dtype)
    a = -1.0 / (sign + z)  # the branch on the sign keeps this away from infinity
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return first, second


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale (N, 3) vectors to length 1; a zero vector stays zero."""
    lengths = np.sqrt(np.einsum("nd,nd->n", vectors, vectors))
    return vectors / np.maximum(lengths, np.finfo(vectors.dtype).tiny)[:, None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product of (N, 3) vectors; np.cross takes twice as long."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
