"""Pairs made on the fly: pair number i of a run depends on the run's seed and i alone.

Making a pair costs about as much as learning from it, so each is shown ``repeats`` times,
one block of pairs after the other; a worker keeps the block it has made.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from utopic_cli.bridge import to_cloud_input
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import PreparedPair, prepare
from utopic_cli.synthesis.pairs import PairSettings, ScanPair, random_pair
from utopic_cli.training.hypotheses import draw_hypothesis
from utopic_cli.training.network import TrainingPair

if TYPE_CHECKING:
    from utopic_cli.synthesis.shapes import ShapeLibrary


FAR = 1e3
"""Distance of a scanner at infinity, in extents."""


class SampledPair(NamedTuple):
    """A synthesised pair as the network is to see it, still as arrays.

    Attributes:
        prepared: the sampled pair.
        gt_T_target_source: (4, 4) between the normalised clouds.
        hypothesis: (4, 4) transformation under test.
        hypothesis_present: 1.0 if the network is shown it, else 0.0.
    """

    prepared: PreparedPair
    gt_T_target_source: np.ndarray
    hypothesis: np.ndarray
    hypothesis_present: float


def sample_pair(pair: ScanPair, points: int, rng: np.random.Generator) -> SampledPair:
    """Sample a pair for the network, and take its known answer to normalised units.

    For half of the pairs normals face the scanner where it is known, which is always right;
    for the others their signs are found from the points alone, as at inference, with its
    mistakes.
    """
    views = {}
    if rng.random() < 0.5:
        views = {
            "source_viewpoint": _far_away(pair.source, pair.source_viewpoint, pair.extent),
            "target_viewpoint": _far_away(pair.target, pair.target_viewpoint, pair.extent),
        }
    prepared = prepare(pair.source, pair.target, points, **views)
    gt = prepared.normalise(pair.gt_T_target_source)
    return SampledPair(prepared, gt, *draw_hypothesis(prepared, gt, rng))


def to_training_pair(pair: SampledPair, neighbours: int) -> TrainingPair:
    """Return a sampled pair as tensors, a batch of one."""
    return TrainingPair(
        to_cloud_input(pair.prepared.source, pair.prepared.spacing, neighbours),
        to_cloud_input(pair.prepared.target, pair.prepared.spacing, neighbours),
        torch.from_numpy(pair.gt_T_target_source.astype(np.float32))[None],
        torch.from_numpy(pair.hypothesis.astype(np.float32))[None],
        torch.tensor([pair.hypothesis_present], dtype=torch.float32),
    )


def _far_away(cloud: PointCloud, direction: np.ndarray | None, extent: float) -> np.ndarray | None:
    """Return a (3,) scanner position far off in a direction, or None where there is none."""
    return None if direction is None else cloud.points.mean(axis=0) + FAR * extent * direction


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
        self._made: OrderedDict[Key, SampledPair] = OrderedDict()

    def __getitem__(self, key: Key) -> TrainingPair:
        """Make a pair, or return it again if it was made within the last block."""
        if key not in self._made:
            number, fewest, most = key
            rng = np.random.default_rng([self.seed, number])
            points = int(rng.integers(fewest, most + 1))
            pair = random_pair(self.library, rng, self.settings)
            self._made[key] = sample_pair(pair, points, rng)
            if len(self._made) > BLOCK:
                self._made.popitem(last=False)
        return to_training_pair(self._made[key], self.neighbours)


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
