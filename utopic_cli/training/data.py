"""Pairs made on the fly: pair number i of a run depends on the run's seed and i alone.

Making a pair costs about as much as learning from it, so each is shown ``repeats`` times,
one block of pairs after the other; a worker keeps the block it has made.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from utopic_cli.bridge import to_cloud_input
from utopic_cli.preprocess import PreparedPair, prepare
from utopic_cli.synthesis.pairs import PairSettings, ScanPair, random_pair
from utopic_cli.training.network import TrainingPair

if TYPE_CHECKING:
    from utopic_cli.synthesis.shapes import ShapeLibrary


FAR = 1e3
"""Distance of a scanner at infinity, in extents."""


def sample_pair(pair: ScanPair, points: int, known_views: bool = False) -> tuple[PreparedPair, np.ndarray]:
    """Sample a pair for the network, and take its known answer to normalised units.

    With ``known_views`` normals face the scanner where it is known, which is always right;
    without, their signs are found from the points alone, as at inference, with its mistakes.
    """
    views = {}
    if known_views:
        views = {
            f"{name}_viewpoint": None
            if view is None
            else cloud.points.mean(axis=0) + FAR * pair.extent * view
            for name, cloud, view in (
                ("source", pair.source, pair.source_viewpoint),
                ("target", pair.target, pair.target_viewpoint),
            )
        }
    prepared = prepare(pair.source, pair.target, points, **views)
    return prepared, prepared.normalise(pair.gt_T_target_source)


def to_training_pair(prepared: PreparedPair, gt: np.ndarray, neighbours: int) -> TrainingPair:
    """Return a sampled pair and its (4, 4) known answer as tensors, a batch of one."""
    return TrainingPair(
        to_cloud_input(prepared.source, prepared.spacing, neighbours),
        to_cloud_input(prepared.target, prepared.spacing, neighbours),
        torch.from_numpy(gt.astype(np.float32))[None],
    )


BLOCK = 64
"""Pairs between a pair and its repetition."""

Key = tuple[int, int, int]
"""Number of a pair, and the fewest and most points its clouds are to have."""


class SynthesisedPairs(Dataset[TrainingPair]):
    """Training pairs by key, each from its own generator."""

    def __init__(self, library: ShapeLibrary, settings: PairSettings, seed: int, neighbours: int) -> None:
        """Draw from a library of shapes."""
        self.library, self.settings, self.seed, self.neighbours = library, settings, seed, neighbours
        # Arrays, not tensors: a tensor sent to another process keeps a file open.
        self._made: OrderedDict[Key, tuple[PreparedPair, np.ndarray]] = OrderedDict()

    def __getitem__(self, key: Key) -> TrainingPair:
        """Make a pair, or return it again if it was made within the last block."""
        if key not in self._made:
            number, fewest, most = key
            rng = np.random.default_rng([self.seed, number])
            points = int(rng.integers(fewest, most + 1))
            pair = random_pair(self.library, rng, self.settings)
            self._made[key] = sample_pair(pair, points, known_views=rng.random() < 0.5)
            if len(self._made) > BLOCK:
                self._made.popitem(last=False)
        return to_training_pair(*self._made[key], self.neighbours)


class PairKeys:
    """Sampler: the keys of samples ``start`` to ``stop`` of a run."""

    def __init__(
        self, start: int, stop: int, repeats: int, points_of: Callable[[int], tuple[int, int]]
    ) -> None:
        """Show each pair ``repeats`` times; ``points_of(number)`` gives (fewest, most)."""
        self.start, self.stop, self.repeats, self.points_of = start, stop, repeats, points_of

    def __iter__(self) -> Iterator[Key]:
        """Yield keys; a block of pairs is gone through ``repeats`` times before the next."""
        for sample in range(self.start, self.stop):
            number = sample // (BLOCK * self.repeats) * BLOCK + sample % BLOCK
            # The settings of a pair are those of the sample that shows it first.
            yield number, *self.points_of(number * self.repeats)


def pair_loader(pairs: SynthesisedPairs, keys: PairKeys, workers: int) -> DataLoader[TrainingPair]:
    """Load pairs in order, made by worker processes ahead of need."""
    return DataLoader(
        pairs,
        batch_size=None,
        sampler=keys,  # type: ignore[arg-type]
        num_workers=workers,
        prefetch_factor=8 if workers else None,
        collate_fn=_as_it_is,
        worker_init_fn=_one_thread,
    )


def _as_it_is(pair: Any) -> Any:
    return pair


def _one_thread(_: int) -> None:
    torch.set_num_threads(1)
