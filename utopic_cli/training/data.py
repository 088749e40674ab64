"""Pairs made on the fly: pair number i of a run depends on the run's seed and i alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from utopic_cli.bridge import to_cloud_input
from utopic_cli.preprocess import prepare
from utopic_cli.synthesis.pairs import PairSettings, ScanPair, random_pair
from utopic_cli.training.network import TrainingPair

if TYPE_CHECKING:
    from utopic_cli.synthesis.shapes import ShapeLibrary


def to_training_pair(pair: ScanPair, points: int, neighbours: int) -> TrainingPair:
    """Sample a pair for the network and take its known answer to normalised units."""
    prepared = prepare(pair.source, pair.target, points)
    gt = prepared.normalise(pair.gt_T_target_source)
    return TrainingPair(
        to_cloud_input(prepared.source, prepared.spacing, neighbours),
        to_cloud_input(prepared.target, prepared.spacing, neighbours),
        torch.from_numpy(gt.astype(np.float32))[None],
    )


class SynthesisedPairs(Dataset[TrainingPair]):
    """Training pairs by number, each from its own generator."""

    def __init__(
        self, library: ShapeLibrary, settings: PairSettings, seed: int, neighbours: int
    ) -> None:
        """Draw from a library of shapes."""
        self.library, self.settings, self.seed, self.neighbours = library, settings, seed, neighbours

    def __getitem__(self, key: Any) -> TrainingPair:
        """Make pair number ``key[0]`` with between ``key[1]`` and ``key[2]`` points a cloud."""
        number, fewest, most = key
        rng = np.random.default_rng([self.seed, number])
        points = int(rng.integers(fewest, most + 1))
        return to_training_pair(random_pair(self.library, rng, self.settings), points, self.neighbours)


class PairNumbers:
    """Sampler: pair numbers from ``start`` on, with the range of points each is to have."""

    def __init__(self, start: int, stop: int, points_of: Any) -> None:
        """Count from ``start`` to ``stop``; ``points_of(number)`` gives (fewest, most)."""
        self.start, self.stop, self.points_of = start, stop, points_of

    def __iter__(self) -> Iterator[tuple[int, int, int]]:
        """Yield (number, fewest, most)."""
        for number in range(self.start, self.stop):
            fewest, most = self.points_of(number)
            yield number, fewest, most


def pair_loader(pairs: SynthesisedPairs, numbers: PairNumbers, workers: int) -> DataLoader[TrainingPair]:
    """Load pairs in order, made by worker processes ahead of need."""
    return DataLoader(
        pairs,
        batch_size=None,
        sampler=numbers,  # type: ignore[arg-type]
        num_workers=workers,
        prefetch_factor=8 if workers else None,
        collate_fn=_as_it_is,
        worker_init_fn=_one_thread,
    )


def _as_it_is(pair: TrainingPair) -> TrainingPair:
    return pair


def _one_thread(_: int) -> None:
    torch.set_num_threads(1)
