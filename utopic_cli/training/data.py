"""Pairs made on the fly by worker processes, in batches.

What batch number i of a run holds depends on the run's seed and i alone, so a run can go on
where it stopped, and several processes can share it. Making a pair costs about as much as
learning from it, so each is shown ``repeats`` times, one block of batches after the other; a
worker keeps the block it has made.
"""

from __future__ import annotations

import signal
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from utopic_cli.bridge import to_cloud_input
from utopic_cli.model.cloud_input import stack_clouds
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import PreparedPair, prepare
from utopic_cli.synthesis.pairs import PairSettings, ScanPair, random_pair
from utopic_cli.training.hypotheses import draw_hypothesis
from utopic_cli.training.network import TrainingPair

if TYPE_CHECKING:
    from utopic_cli.synthesis.shapes import ShapeLibrary


FAR = 1e3
"""Distance of a scanner at infinity, in extents."""

BLOCK = 32
"""Batches between a pair and its repetition."""


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
    source_viewpoint = target_viewpoint = None
    if rng.random() < 0.5:
        source_viewpoint = _far_away(pair.source, pair.source_viewpoint, pair.extent)
        target_viewpoint = _far_away(pair.target, pair.target_viewpoint, pair.extent)
    prepared = prepare(
        pair.source,
        pair.target,
        points,
        source_viewpoint=source_viewpoint,
        target_viewpoint=target_viewpoint,
    )
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


def stack_pairs(pairs: list[TrainingPair]) -> TrainingPair:
    """Put batches of pairs into one batch; smaller clouds are filled up."""
    sources, targets, *answers = zip(*pairs, strict=True)
    return TrainingPair(
        stack_clouds(sources), stack_clouds(targets), *(torch.cat(answer) for answer in answers)
    )


def _far_away(cloud: PointCloud, direction: np.ndarray | None, extent: float) -> np.ndarray | None:
    """Return a (3,) scanner position far off in a direction, or None where there is none."""
    return None if direction is None else cloud.points.mean(axis=0) + FAR * extent * direction


@dataclass(frozen=True)
class Batch:
    """Which pairs a batch holds.

    Attributes:
        first: number of its first pair; the others follow.
        count: number of pairs.
        fewest: the points a cloud is to have at most are drawn from here ...
        most: ... to here, once for the batch, so that little of it is filling.
    """

    first: int
    count: int
    fewest: int
    most: int


class SynthesisedPairs(Dataset[TrainingPair]):
    """Batches of training pairs, each pair from its own generator."""

    def __init__(
        self,
        library: ShapeLibrary,
        settings: PairSettings,
        seed: int,
        neighbours: int,
    ) -> None:
        """Draw from a library of shapes."""
        self.library, self.settings, self.seed, self.neighbours = library, settings, seed, neighbours
        # Arrays, not tensors: a tensor sent to another process keeps a file open.
        self._made: OrderedDict[Batch, list[SampledPair]] = OrderedDict()

    def __getitem__(self, batch: Batch) -> TrainingPair:
        """Make a batch, or return it again if it was made within the last block."""
        if batch not in self._made:
            points = points_of(batch, self.seed)
            self._made[batch] = [self._pair(batch.first + i, points) for i in range(batch.count)]
            if len(self._made) > BLOCK:
                self._made.popitem(last=False)
        return stack_pairs([to_training_pair(pair, self.neighbours) for pair in self._made[batch]])

    def _pair(self, number: int, points: int) -> SampledPair:
        rng = np.random.default_rng([self.seed, number])
        return sample_pair(random_pair(self.library, rng, self.settings), points, rng)


def points_of(batch: Batch, seed: int) -> int:
    """Draw how many points the clouds of a batch are to have at most."""
    # The third number keeps this stream apart from those of the pairs.
    rng = np.random.default_rng([seed, batch.first, 1])
    return int(rng.integers(batch.fewest, batch.most + 1))


class BatchOrder:
    """Sampler: the batches of steps ``start`` to ``stop`` of a run.

    Step s of a run shows ``size`` pairs; of several processes, each takes its own share of them.
    """

    def __init__(
        self,
        start: int,
        stop: int,
        size: int,
        repeats: int,
        limits_of: Callable[[int], tuple[int, int]],
        share: tuple[int, int] = (0, 1),
    ) -> None:
        """Show each pair ``repeats`` times.

        Args:
            start: first step.
            stop: step after the last.
            size: pairs a step, of all processes together.
            repeats: how often each pair is shown.
            limits_of: (fewest, most) points of a cloud by number of pairs shown before.
            share: number of this process, and of all; they must divide ``size``.
        """
        self.start, self.stop, self.size, self.repeats = start, stop, size, repeats
        self.limits_of, self.share = limits_of, share

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches; a block of them is gone through ``repeats`` times before the next."""
        rank, processes = self.share
        mine = self.size // processes
        for step in range(self.start, self.stop):
            number = step // (BLOCK * self.repeats) * BLOCK + step % BLOCK
            # The settings of a batch are those of the step that shows it first.
            first_shown = number // BLOCK * BLOCK * self.repeats + number % BLOCK
            yield Batch(number * self.size + rank * mine, mine, *self.limits_of(first_shown * self.size))


def batch_loader(
    pairs: SynthesisedPairs, order: BatchOrder, workers: int, *, pinned: bool = False
) -> DataLoader[TrainingPair]:
    """Load batches in order, made by worker processes ahead of need.

    Args:
        pairs: makes them.
        order: which, in order.
        workers: processes; 0 makes them in this one.
        pinned: page-locked, for a fast way to a GPU.
    """
    return DataLoader(
        pairs,
        batch_size=None,
        sampler=order,  # type: ignore[arg-type]
        num_workers=workers,
        prefetch_factor=8 if workers else None,
        collate_fn=_as_it_is,
        worker_init_fn=_start_worker,
        pin_memory=pinned,
    )


def _as_it_is(pair: Any) -> Any:
    return pair


def _start_worker(_: int) -> None:
    """One thread, and deaf to the signals that a whole group of processes gets.

    The parent finishes its step with the workers' pairs, saves, and tells them to end; where it is
    gone, they see so by themselves.
    """
    torch.set_num_threads(1)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
