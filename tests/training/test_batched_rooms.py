"""Rooms made in batches on the device: like the ones made one at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from utopic_cli.synthesis.pairs import random_pair
from utopic_cli.synthesis.rooms import furnished_room, seen_from_within
from utopic_cli.synthesis.settings import PairSettings
from utopic_cli.synthesis.shapes import procedural_shapes
from utopic_cli.synthesis.surface import sample_surface
from utopic_cli.training.batched import BatchedPairs, room_pairs
from utopic_cli.training.batched import pairs as pairs_module
from utopic_cli.training.batched.draws import Draws
from utopic_cli.training.batched.raw_pairs import smaller_overlap


def test_rooms_look_as_those_made_one_at_a_time(monkeypatch):
    library = procedural_shapes(np.random.default_rng(3), 12, resolution=32)
    monkeypatch.setattr(pairs_module, "ROOMS", 3)
    monkeypatch.setattr(room_pairs, "SAMPLES", 60_000)
    settings = PairSettings(kinds=(0.0, 0.0, 0.0, 0.0, 1.0), room_points=(2000, 4000))
    made = BatchedPairs(library, settings, device=torch.device("cpu"), neighbours=8).raw_pairs(
        6, Draws(torch.Generator().manual_seed(21))
    )
    sizes = made.mask.sum(dim=2)
    assert bool(made.good.all()) and int(sizes.min()) >= 2000 and int(sizes.max()) <= 4000
    assert not bool(made.one_side.any())
    overlaps = smaller_overlap(made, Draws(torch.Generator().manual_seed(22)))
    one_by_one = [random_pair(library, np.random.default_rng(i), settings) for i in range(12)]
    expected = np.mean([pair.smaller_overlap for pair in one_by_one])
    assert float(overlaps.mean()) == pytest.approx(expected, abs=0.2)
    assert float(made.extent.mean()) == pytest.approx(np.mean([pair.extent for pair in one_by_one]), rel=0.3)
    for number in range(6):  # within the walls but for the noise, and the two scans in one frame
        source, target = (made.points[number, side][made.mask[number, side]] for side in (0, 1))
        assert float(source.abs().max()) < 4.0 + 0.05
        distance = torch.cdist(source, target).amin(dim=1).sort().values
        near = distance[: int(0.7 * float(overlaps[number]) * len(distance))]
        assert float(near.max()) < 0.03 * float(made.extent[number])


def test_what_is_seen_within_a_room_equals_the_scanner_of_single_rooms():
    room = furnished_room(np.random.default_rng(4))
    points = sample_surface(*room.mesh, 50_000, np.random.default_rng(5))[0].astype(np.float32)
    places = np.array([[0.2, -0.3, 0.1], [-0.9, 0.6, 0.3]], dtype=np.float32)
    rays = torch.from_numpy(points[None] - places[:, None])
    seen = room_pairs.seen_from_within(rays, rays.norm(dim=2))
    for number, place in enumerate(places):
        expected = seen_from_within(points, place)
        assert 0.3 < expected.mean() < 0.95
        assert (seen[number].numpy() == expected).mean() > 0.999
