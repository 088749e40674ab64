"""Which scans may show the same: how often the words of a common vocabulary occur in each.

A scan's mean descriptor says how it looks on the whole, and the two sides of a plate look nothing alike.
The words, some of the batch's own descriptors, each stand for what a surface looks like in one place;
scans that overlap have those of their common part in common, whatever else there is in either.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

WORDS = 512
LENGTH = 16
"""Numbers that are left of a descriptor. With 16 of 64, and 512 words instead of 128, overlapping scans
of simulated objects were found best."""

SEED = 0


def shorten(descriptors: np.ndarray) -> np.ndarray:
    """Project unit descriptors (N, D) onto the same ``LENGTH`` random directions -> (N, LENGTH) int8."""
    width = descriptors.shape[1]
    drawn = np.random.default_rng(SEED).standard_normal((max(width, LENGTH), LENGTH))
    directions = np.linalg.qr(drawn)[0][:width]
    return np.rint(127.0 * np.clip(descriptors @ directions, -1.0, 1.0)).astype(np.int8)


def word_frequencies(descriptors: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Count the words of the batch in each scan.

    Args:
        descriptors: (N, LENGTH) int8 by scan, see ``shorten``.

    Returns:
        (WORDS,) by scan: the root of the share of its points that are nearest to each word, so that the
        Euclidean distance between two scans is Hellinger's between their frequencies.
    """
    if not descriptors:
        return {}
    rng = np.random.default_rng(SEED)
    scans = sorted(descriptors)
    drawn = [descriptors[scans[i]] for i in rng.integers(len(scans), size=WORDS)]
    words = np.stack([of_scan[rng.integers(len(of_scan))] for of_scan in drawn]).astype(np.float32)
    offset = 0.5 * np.square(words).sum(axis=1)
    frequencies = {}
    for scan in scans:
        nearest = (descriptors[scan].astype(np.float32) @ words.T - offset).argmax(axis=1)
        frequencies[scan] = np.sqrt(np.bincount(nearest, minlength=WORDS) / len(nearest))
    return frequencies
