from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmark.conftest import ScanFolder
from utopic_cli.benchmark.ground_truth import measured_overlap, read_ground_truth
from utopic_cli.errors import InputError
from utopic_cli.geometry.rigid import is_rigid, rigid
from utopic_cli.point_cloud import PointCloud


def test_many_pairs_and_one_pair(folder: ScanFolder) -> None:
    many = folder.write({"units": "m", "pairs": [folder.pair(), folder.pair(source="b.ply", target="a.ply")]})
    pairs = read_ground_truth(many)
    assert [(p.index, p.source.name, p.target.name) for p in pairs] == [
        (0, "a.ply", "b.ply"),
        (1, "b.ply", "a.ply"),
    ]
    (single,) = read_ground_truth(folder.write(folder.pair()))
    np.testing.assert_allclose(single.gt_T_target_source, folder.gt_T_target_source, atol=1e-12)
    assert single.overlap_ratio == {"source": 0.8, "target": 0.7}


def test_the_example_in_the_documents_is_read(folder: ScanFolder) -> None:
    text = (Path(__file__).parents[2] / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    example = json.loads(text.split("```json\n")[1].split("```")[0])
    for entry in example["pairs"]:
        entry.update(source="a.ply", target="b.ply")
    (pair,) = read_ground_truth(folder.write(example))
    assert pair.overlap_ratio == {"source": 0.62, "target": 0.55}
    with pytest.raises(InputError, match=r"docs/benchmarks\.md has an example"):
        read_ground_truth(folder.path / "nowhere")


def test_the_first_overlap_both_sides_have_counts(folder: ScanFolder) -> None:
    entry = folder.pair(overlap_source_2p5mm=0.6, overlap_target_2p5mm=0.5, overlap_source_1mm=0.4)
    entry["overlap_target_1mm"] = 0.3
    del entry["overlap_target"]  # now overlap_source has no partner
    assert read_ground_truth(folder.write(entry))[0].overlap_ratio == {"source": 0.6, "target": 0.5}


def test_without_overlaps_they_are_left_to_be_measured(folder: ScanFolder) -> None:
    entry = {key: value for key, value in folder.pair().items() if not key.startswith("overlap")}
    assert read_ground_truth(folder.write(entry))[0].overlap_ratio is None


def test_measured_overlap_looks_both_ways_through_the_known_answer() -> None:
    line = np.linspace(0.0, 1.0, 101)[:, None] * np.array([1.0, 0, 0])
    shift = rigid(np.eye(3), np.array([50.0, 0, 0]))
    ratio = measured_overlap(PointCloud(line), PointCloud(line[:26] + [50.0, 0, 0]), shift, extent=0.5)
    assert ratio == {"source": pytest.approx(26 / 101), "target": 1.0}


def test_rounded_matrices_become_exactly_rigid(folder: ScanFolder) -> None:
    rounded = np.round(folder.gt_T_target_source, 5)
    (pair,) = read_ground_truth(folder.write(folder.pair(T_target_source=rounded.tolist())))
    assert is_rigid(pair.gt_T_target_source, 1e-12)
    np.testing.assert_allclose(pair.gt_T_target_source, rounded, atol=1e-4)


BAD_MATRICES = {
    "scaled": np.diag([1.001, 1.001, 1.001, 1.0]).tolist(),
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]).tolist(),
    "last row": (np.eye(4) + 0.01 * np.eye(4)[[3, 3, 3, 0]]).tolist(),
    "three rows": np.eye(4)[:3].tolist(),
    "ragged": [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "words": [["one"] * 4] * 4,
    "not a number": np.full((4, 4), np.nan).tolist(),
    "missing": None,
}


@pytest.mark.parametrize("matrix", BAD_MATRICES.values(), ids=BAD_MATRICES)
def test_no_rigid_matrix_names_the_entry(folder: ScanFolder, matrix: Any) -> None:
    path = folder.write({"pairs": [folder.pair(), folder.pair(T_target_source=matrix)]})
    with pytest.raises(InputError, match=r"pairs\[1\] \(a.ply -> b.ply\): T_target_source"):
        read_ground_truth(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": "gone.ply"}, r"pairs\[0\]: its target 'gone.ply' is not a file"),
        ({"source": "."}, r"pairs\[0\]: its source '.' is not a file"),
        ({"source": None}, r"pairs\[0\] does not name its source"),
        ({"overlap_target": 1.5}, r"pairs\[0\] .*overlap_target is 1.5"),
        ({"overlap_source": "much"}, r"pairs\[0\] .*overlap_source is 'much'"),
    ],
)
def test_bad_entries_are_named(folder: ScanFolder, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_ground_truth(folder.write({"pairs": [folder.pair(**changes)]}))


@pytest.mark.parametrize("content", [[], {"pairs": []}, {"pairs": {"a": 1}}, {"pairs": ["a.ply"]}, "text"])
def test_other_structures_are_refused(folder: ScanFolder, content: Any) -> None:
    with pytest.raises(InputError, match=r"gt.json"):
        read_ground_truth(folder.write(content))


def test_missing_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can't be read"):
        read_ground_truth(tmp_path)
    (tmp_path / "gt.json").write_text('{"pairs": [')
    with pytest.raises(InputError, match="not valid JSON"):
        read_ground_truth(tmp_path)


SHARED = Path(os.environ.get("UTOPIC_SHARED", Path(__file__).parents[2].parent / "shared")) / "scans"


@pytest.mark.skipif(not SHARED.is_dir(), reason="the shared scans are not here")
@pytest.mark.parametrize(
    ("name", "pairs", "least"), [("bunny", 45, 0.0), ("indoor", 1, 0.44), ("lidar", 1, 0.7)]
)
def test_real_folders(name: str, pairs: int, least: float) -> None:
    known = read_ground_truth(SHARED / name)
    assert len(known) == pairs
    smaller = [min(pair.overlap_ratio.values()) for pair in known if pair.overlap_ratio]
    assert len(smaller) == pairs and min(smaller) >= least
    if name == "bunny":  # the counts its README states
        assert [sum(value >= bound for value in smaller) for bound in (0.5, 0.3, 0.1)] == [15, 23, 35]
