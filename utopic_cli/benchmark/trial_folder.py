"""Trials of a folder of real scans with known answers, pairs that don't overlap among them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from utopic_cli.benchmark.ground_truth import KnownPair, measured_overlap, read_ground_truth
from utopic_cli.benchmark.labelled import Trial
from utopic_cli.benchmark.metrics import OVERLAP_BANDS, band_name, overlap_band, pair_extent
from utopic_cli.benchmark.scans import start_transformation
from utopic_cli.geometry.rigid import invert
from utopic_cli.io.scan import read_scan

KINDS = tuple(band_name(low, high) for low, high in OVERLAP_BANDS)
"""Pairs are told apart by the overlap of their smaller side."""


@dataclass(frozen=True)
class FolderTrials:
    """The pairs of a folder in turn, then again from other start poses.

    Attributes:
        pairs: all that ``gt.json`` names, whatever their overlap.
        seed: of the start poses.
    """

    pairs: tuple[KnownPair, ...]
    seed: int

    @classmethod
    def of(cls, directory: Path, seed: int) -> FolderTrials:
        """Read a folder's ``gt.json``.

        Raises:
            InputError: it, or what it names, can't be used.
        """
        return cls(read_ground_truth(directory), seed)

    def __call__(self, number: int) -> Trial:
        """Make trial ``number``, from 0: its source as in the file, but in a random start pose.

        Raises:
            InputError: a scan can't be used.
        """
        pair = self.pairs[number % len(self.pairs)]
        source, target = (read_scan(path).cloud for path in (pair.source, pair.target))
        extent = pair_extent(source, target)
        gt = pair.gt_T_target_source
        overlap = pair.overlap_ratio or measured_overlap(source, target, gt, extent)
        start = start_transformation(
            self.seed, pair.index, number // len(self.pairs), source.points.mean(axis=0), extent
        )
        smaller = min(overlap.values())
        return Trial(
            overlap_band(smaller),
            source.transformed(start),
            target,
            np.asarray(gt @ invert(start)),
            extent,
            smaller,
            f"{pair.source.name} -> {pair.target.name}",
        )
