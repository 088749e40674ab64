"""What the bundled weights call uncertain, in rooms: walls, of which nothing tells where on them one is."""

from __future__ import annotations

import numpy as np

from utopic_cli.benchmark.pair_metrics import known_nodes
from utopic_cli.benchmark.protocols import RoomProtocol
from utopic_cli.benchmark.uncertainty import measure_uncertainty
from utopic_cli.bridge import load_network, predict
from utopic_cli.preprocess import prepare
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.shapes import pack


def test_walls_and_wrong_matches_are_more_uncertain_than_furniture_and_right_ones() -> None:
    rng = np.random.default_rng(3)
    shapes = pack([procedural_mesh(rng, 32) for _ in range(3)], list("abc"), ["val"] * 3, ["one"] * 3)
    model = load_network("utopic", "cpu")[0]
    protocol = RoomProtocol()
    found = []
    for number in range(4):
        pair = protocol.pair(shapes, 5, number)
        prepared = prepare(pair.source, pair.target, 768)
        view = predict(model, prepared, 0, prepared.normalise(pair.gt_T_target_source))
        known = known_nodes(prepared, pair.gt_T_target_source, protocol.overlap_radius(prepared))
        found.append(measure_uncertainty(prepared, view, known))
    assert np.mean([one.plain_auc for one in found]) > 0.55  # .2 to .3 if told from features
    assert np.mean([one.wrong_auc for one in found]) > 0.6
    assert np.mean([one.border_auc for one in found]) > 0.6
