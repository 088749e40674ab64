"""Tables of variants: what they change, what is told apart, what is called noise."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from tests.model.conftest import SMALL
from utopic_cli.benchmark.pair_metrics import MatchMeasures, OverlapMeasures, PoseMeasures
from utopic_cli.benchmark.paired import Difference
from utopic_cli.benchmark.protocols import CropProtocol
from utopic_cli.benchmark.reports import render
from utopic_cli.benchmark.result_page import page
from utopic_cli.benchmark.variant_pairs import PairResult, answer
from utopic_cli.benchmark.variant_report import VariantReport, VariantRun
from utopic_cli.benchmark.variant_summary import told_apart
from utopic_cli.benchmark.variants import CONTROL, FULL, TABLES, VARIANTS
from utopic_cli.config import ModelConfig
from utopic_cli.model.utopic import Utopic
from utopic_cli.synthesis.shapes import procedural_shapes

PAIRS = 40


def pose(degrees: float) -> PoseMeasures:
    return PoseMeasures(degrees, degrees / 100.0, (degrees, 0.0, 0.0), (degrees / 100.0, 0.0, 0.0), False)


def results(variant: str, accuracy: float, hits: float, seed: int = 0) -> tuple[PairResult, ...]:
    """Pairs of different hardness, answered a little better or worse than the full network does."""
    hardness = np.random.default_rng(0).uniform(0.0, 0.3, PAIRS)
    luck = np.random.default_rng(seed).normal(0.0, 0.01, (2, PAIRS))
    told = accuracy - hardness + luck[0]
    return tuple(
        PairResult(
            pair=number,
            shape="a",
            matches=MatchMeasures(hits - hardness[number] + luck[1][number], 0.5),
            overlap=None
            if variant == "no-o-c-u-g"
            else OverlapMeasures(told[number], 1.0, 1.0, told[number]),
            poses={"svd": pose(4.0) if number else None, "auto": pose(0.5), "floor": pose(0.1)},
        )
        for number in range(PAIRS)
    )


def report(table: str = "uncertainty") -> VariantReport:
    accuracies = {"predicted-u": 0.7, "no-u": 0.902, FULL: 0.9, CONTROL: 0.91}
    runs = tuple(
        VariantRun(row, 100, 2.5, results(row.variant, accuracies.get(row.variant, 0.9), 0.6, seed))
        for seed, row in enumerate(TABLES[table])
    )
    settings = {
        "protocol": table,
        "data": "procedural",
        "test": {"pairs": PAIRS, "shapes": 20, "split": "val", "seed": 0},
        "variants": {run.row.variant: {"weights_sha256": f"{run.row.variant:-<64}"} for run in runs},
        "budget": {"pairs": 100, "descriptor_pairs": 50, "minutes": 2.0, "pairs_per_s": 0.83},
    }
    return VariantReport(settings, runs)


def printed(some: VariantReport) -> str:
    console = Console(width=200, record=True, quiet=True)
    with console.capture() as capture:
        console.quiet = False
        render(some, console)
    return capture.get()


def test_every_row_is_a_variant_and_the_full_network_changes_nothing():
    assert set(TABLES) == {"ablation", "attention", "uncertainty"}
    for rows in TABLES.values():
        names = [row.variant for row in rows]
        assert names[-2:] == [FULL, CONTROL] and len(set(names)) == len(names)
        assert all(name in VARIANTS for name in names[:-1])
        assert all(len(row.quoted) == 6 for row in rows[:-1]) and not rows[-1].quoted
    assert VARIANTS[FULL] == {}
    # A row with more parts keeps what those above it have.
    keys = [
        {(section, key) for section, values in VARIANTS[row.variant].items() for key in values}
        for row in TABLES["ablation"][:-1]
    ]
    assert all(more < fewer for fewer, more in itertools.pairwise(keys))


def test_what_is_beyond_chance_and_beyond_another_seed_is_told_apart():
    lines = printed(report()).splitlines()
    start = next(i for i, line in enumerate(lines) if "Differences from" in line)
    rows = {
        line.split("│")[1].strip(): line.split("│")[2:-1] for line in lines[start:] if line.startswith("│")
    }
    assert set(rows) == {"PU, RM", "no U, no RM", "U, no RM", "full, another seed"}
    assert rows["PU, RM"][0].strip().startswith("-0.2") and rows["PU, RM"][0].strip().endswith("*")
    assert "*" not in "".join(rows["full, another seed"] + rows["no U, no RM"] + rows["PU, RM"][1:])
    assert "±" in rows["no U, no RM"][0]
    assert lines[-6].startswith(
        "told apart from the full network: PU, RM (overlap accuracy); everything else"
    )
    assert lines[-5] == "PU, RM: no answer 1 times by the paper's solve"


def test_a_difference_within_that_of_another_seed_is_noise():
    some = report()
    difference = some.differences["no-u"]["overlap_accuracy"]
    control = some.differences[CONTROL]["overlap_accuracy"]
    assert difference is not None and control is not None
    assert control.p_value < 0.01 and abs(difference.value) < abs(control.value)
    assert not told_apart(difference, control, 1)
    dull = replace(some, runs=tuple(run for run in some.runs if run.row.variant != "predicted-u"))
    assert "within noise: this budget tells no variant" in printed(dull)
    alone = replace(some, runs=tuple(run for run in some.runs if run.row.variant != CONTROL))
    assert "*" not in "".join(line for line in printed(alone).splitlines() if line.startswith("│"))


def test_of_many_comparisons_each_must_be_clearer():
    small = Difference(0.1, 0.05, 0.15, 40, 0.01)
    none = Difference(0.0, -0.1, 0.1, 40, 1.0)
    assert told_apart(small, none, 4) and not told_apart(small, none, 6)
    assert not told_apart(small, replace(none, value=-0.2), 1)
    assert not told_apart(small, None, 1) and not told_apart(None, none, 1)


def test_the_budget_the_published_figures_and_what_they_are_are_said():
    text = " ".join(printed(report()).split())
    assert "budget: 100 pairs each, about 2 minutes at the 0.83 pairs/s measured before" in text
    assert "each variant trained on 100 pairs of procedural, tested on 40 pairs of 20 'val' shapes" in text
    assert "PU, RM (quoted)" in text and "0.8251" in text and "statistical floor" in text
    assert "quoted: from the paper" in text


def test_a_variant_without_overlap_has_no_overlap_accuracy():
    some = report("ablation")
    assert some.differences["no-o-c-u-g"]["overlap_accuracy"] is None
    line = next(line for line in printed(some).splitlines() if line.startswith("│ none of O, C, U, G"))
    assert line.split("│")[-2].strip() == "-"


def test_json_and_page_hold_everything():
    some = report()
    # Whose weights they are is said in the terminal and on the page, by the beginning of the hash.
    for text in (printed(some), page(some)):
        assert all(f"{run.row.variant:-<64}"[:12] in text for run in some.runs)
    content = json.loads(some.to_json())
    assert len(content["answers"]) == 5 * PAIRS
    row = content["summary"][0]
    assert row["quoted"]["error_r"] == 0.2852 and row["quoted"]["overlap_accuracy"] == 0.8251
    assert row["difference_from_full"]["overlap_accuracy"]["told_apart"] is True
    assert row["difference_from_full"]["hit_rate"]["told_apart"] is False
    assert (row["pairs_seen"], row["minutes"], row["poses"]["svd"]["without_answer"]) == (100, 2.5, 1)
    html = page(some)
    assert "Differences from the full network" in html and "<svg" in html and "within noise" in html


def test_results_survive_their_way_through_json():
    for one in results("full", 0.9, 0.6)[:2]:
        assert PairResult.from_dict(json.loads(json.dumps(one.to_dict()))) == one


def test_other_pairs_are_not_compared():
    some = report()
    cut = replace(some.runs[0], results=some.runs[0].results[1:])
    with pytest.raises(ValueError, match="not of the same pairs"):
        _ = replace(some, runs=(cut, *some.runs[1:])).differences


@pytest.mark.parametrize("overlap", [True, False])
def test_one_network_on_one_pair(overlap):
    model = Utopic(ModelConfig(**SMALL, hypothesis=False, overlap=overlap)).eval()
    shapes = procedural_shapes(np.random.default_rng(0), 2, 24)
    protocol = CropProtocol("modelnet", 0.7, "shared", "euler45")
    one = answer(model, protocol, shapes, "shapes", 0, seed=0, points=80)
    assert one == answer(model, protocol, shapes, "shapes", 0, seed=0, points=80)
    assert set(one.poses) == {"svd", "auto", "floor"}
    floor = one.poses["floor"]
    assert floor is not None and floor.rotation_deg < 1.5
    assert (one.overlap is not None) == overlap
