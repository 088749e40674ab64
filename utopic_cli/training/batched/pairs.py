"""Whole batches of training pairs, made on the training device."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from utopic_cli.synthesis.rooms import furnished_room
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.settings import KINDS, PairSettings
from utopic_cli.synthesis.shapes import ShapeLibrary, pack
from utopic_cli.training.batched.draws import Draws
from utopic_cli.training.batched.hypotheses import draw_hypotheses
from utopic_cli.training.batched.meshes import Meshes
from utopic_cli.training.batched.range_pairs import range_scan_pairs
from utopic_cli.training.batched.raw_pairs import RawPairs, joined
from utopic_cli.training.batched.room_pairs import room_pairs
from utopic_cli.training.batched.sampling import dense_clouds, moved_apart, of_side, sampled
from utopic_cli.training.batched.surface_pairs import patch_pairs, surface_pairs
from utopic_cli.training.data import BatchOrder, points_of
from utopic_cli.training.network import TrainingPair

TOGETHER = 64
"""Objects scanned at a time: about 100 MB each at the default settings."""

MOST_TIMES = 4
"""Tries at once of a pair that failed before."""

RANGE_SCAN, INDEPENDENT, SHARED, PATCH, ROOM = range(len(KINDS))

ROOMS = 300
"""Furnished rooms made before the first batch; every pair has views and noise of its own."""


class Orders(NamedTuple):
    """What pairs are to be like. The kind and the band of a pair stay, however often it is tried.

    Attributes:
        kind: (B,) int64 number in ``synthesis.settings.KINDS``.
        band: (B, 2) overlap a range-scan pair is to have.
    """

    kind: Tensor
    band: Tensor


def batches_on_device(pairs: BatchedPairs, order: BatchOrder, seed: int) -> Iterator[TrainingPair]:
    """Yield the batches of a run in order, each from a generator of its own.

    Args:
        pairs: makes them.
        order: which.
        seed: the run's.
    """
    for batch in order:
        generator = torch.Generator(pairs.device)
        # Any two batches of any two runs get states that have nothing to do with each other.
        state = np.random.SeedSequence([seed, batch.first]).generate_state(1, np.uint64)[0]
        generator.manual_seed(int(state >> np.uint64(1)))
        yield pairs.make(batch.count, points_of(batch, seed), generator)


class BatchedPairs:
    """Draws pairs from the mixture of ``synthesis.pairs.random_pair``, many at once.

    The distribution is the same as that of ``random_pair`` and ``training.data.sample_pair``,
    the pairs themselves are not: the draws come from another generator.
    """

    def __init__(
        self, library: ShapeLibrary, settings: PairSettings, *, device: torch.device, neighbours: int
    ) -> None:
        """Upload the shapes.

        Args:
            library: the meshes.
            settings: probabilities and ranges.
            device: where pairs are made, and stay.
            neighbours: k of the network's graph.
        """
        self.settings, self.device, self.neighbours = settings, device, neighbours
        self.meshes = Meshes(library, device)
        with_rooms = len(settings.kinds) > ROOM and settings.kinds[ROOM] > 0
        self.rooms = Meshes(furnished_rooms(library, ROOMS), device) if with_rooms else None

    @torch.no_grad()
    def make(self, count: int, points: int, generator: torch.Generator) -> TrainingPair:
        """Make a batch; the same state of the generator gives the same batch on the same device.

        Args:
            count: pairs in the batch.
            points: rows of each cloud; the nodes come first, the rest is filling.
            generator: source of all draws, on the device of the shapes.

        Raises:
            DegeneratePair: not enough usable pairs in ``settings.attempts`` rounds.
        """
        draws = Draws(generator)
        clouds, gt = moved_apart(self.raw_pairs(count, draws))
        dense = dense_clouds(clouds, points, draws)
        nodes = sampled(clouds, dense, points, self.neighbours)
        hypothesis, present = draw_hypotheses(dense, gt, draws)
        return TrainingPair(of_side(nodes, 0), of_side(nodes, 1), gt, hypothesis, present)

    def raw_pairs(self, count: int, draws: Draws) -> RawPairs:
        """Make ``count`` usable pairs of clouds.

        Raises:
            DegeneratePair: not enough of them in ``settings.attempts`` rounds.
        """
        orders = self.orders(count, draws)
        made: list[RawPairs] = []
        place: list[Tensor] = []
        open_orders = torch.arange(count, device=draws.device)
        for _ in range(self.settings.attempts):
            # Orders that failed are tried several times at once, as many as fill a batch.
            times = max(1, min(MOST_TIMES, min(count, TOGETHER) // len(open_orders)))
            tried = open_orders.repeat_interleave(times)
            pairs = self.attempt(Orders(orders.kind[tried], orders.band[tried]), draws)
            attempt = torch.arange(len(tried), device=draws.device)
            first = torch.where(pairs.good, attempt, len(tried)).view(-1, times).amin(dim=1)
            met = first < len(tried)
            made.append(pairs[first[met]])
            place.append(open_orders[met])
            open_orders = open_orders[~met]
            if len(open_orders) == 0:
                return joined(made)[torch.cat(place).argsort()]
        raise DegeneratePair(
            f"no usable pair for {len(open_orders)} of {count} in {self.settings.attempts} rounds"
        )

    def orders(self, count: int, draws: Draws) -> Orders:
        """Draw kinds and bands."""
        weight = torch.tensor(self.settings.kinds, device=draws.device).cumsum(0)
        kind = torch.searchsorted(weight / weight[-1], draws.uniform(count), right=True)
        bands = torch.tensor(self.settings.bands, device=draws.device)
        which = draws.below(torch.tensor(len(bands), device=draws.device), count)
        return Orders(kind.clamp_max(len(weight) - 1), bands[which])

    def attempt(self, orders: Orders, draws: Draws) -> RawPairs:
        """Try to make each pair once; ``good`` tells where it succeeded."""
        recipes = (
            (orders.kind == RANGE_SCAN, self._range_scans),
            ((orders.kind == INDEPENDENT) | (orders.kind == SHARED), self._crops),
            (orders.kind == PATCH, self._patches),
            (orders.kind == ROOM, self._rooms),
        )
        made, place = [], []
        for chosen, recipe in recipes:
            for rows in chosen.nonzero()[:, 0].split(TOGETHER):
                if len(rows):
                    made.append(recipe(Orders(orders.kind[rows], orders.band[rows]), draws))
                    place.append(rows)
        return joined(made)[torch.cat(place).argsort()]

    def _range_scans(self, orders: Orders, draws: Draws) -> RawPairs:
        meshes = self.meshes.batch(self.meshes.draw(len(orders.kind), draws))
        return range_scan_pairs(meshes, orders.band, draws, self.settings)

    def _crops(self, orders: Orders, draws: Draws) -> RawPairs:
        meshes = self.meshes.batch(self.meshes.draw(len(orders.kind), draws))
        return surface_pairs(meshes, orders.kind == SHARED, draws, self.settings)

    def _patches(self, orders: Orders, draws: Draws) -> RawPairs:
        meshes = self.meshes.batch(self.meshes.draw(len(orders.kind), draws))
        return patch_pairs(meshes, draws, self.settings)

    def _rooms(self, orders: Orders, draws: Draws) -> RawPairs:
        assert self.rooms is not None  # rooms are only drawn where they have a weight
        meshes = self.rooms.batch(self.rooms.draw(len(orders.kind), draws))
        return room_pairs(meshes, draws, self.settings)


def furnished_rooms(library: ShapeLibrary, count: int) -> ShapeLibrary:
    """Furnish ``count`` rooms with shapes of a library; the same library gives the same rooms."""
    rng = np.random.default_rng(0)
    rooms = [furnished_room(rng, library).mesh for _ in range(count)]
    names = [f"room/{number:04d}" for number in range(count)]
    return pack(rooms, names, ["train"] * count, ["room"] * count)
