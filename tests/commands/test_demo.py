from __future__ import annotations

import json

import numpy as np
import pytest

from utopic_cli.io.scan import read_scan
from utopic_cli.synthesis.demo_object import demo_pair


@pytest.fixture(scope="module")
def pair():
    return demo_pair(np.random.default_rng(0))


def test_the_scans_are_two_views_of_one_object_with_overlap_and_a_large_motion(pair):
    assert 0.4 < pair.smaller_overlap < 0.9
    assert all(5000 < len(cloud) <= 20_000 for cloud in (pair.source, pair.target))
    angle = np.degrees(np.arccos((np.trace(pair.gt_T_target_source[:3, :3]) - 1) / 2))
    assert angle > 30


def test_the_same_seed_gives_the_same_scans_and_another_seed_others(pair):
    np.testing.assert_array_equal(demo_pair(np.random.default_rng(0)).source.points, pair.source.points)
    assert not np.array_equal(
        demo_pair(np.random.default_rng(1)).source.points[:100], pair.source.points[:100]
    )


def test_demo_writes_the_whole_set_and_says_how_far_off_it_is(cli, fake, tmp_path, pair):
    fake.changes = {"T_target_source": pair.gt_T_target_source}
    result = cli("demo", "--out-dir", tmp_path / "d")
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    assert "error    0.000 degrees and 0.000% of the object's size" in result.stderr
    assert f"open {tmp_path / 'd' / 'report.html'} in a browser" in result.stderr
    assert str(tmp_path / "d" / "aligned.ply") in result.stderr
    written = {path.name for path in (tmp_path / "d").iterdir()}
    assert written == {
        "source.ply", "target.ply", "transformation.txt", "aligned.ply", "report.html", "report.json",
        "source_overlap.ply", "target_overlap.ply", "source_uncertainty.ply", "target_uncertainty.ply",
    }  # fmt: skip
    np.testing.assert_array_equal(read_scan(tmp_path / "d" / "source.ply").cloud.points, pair.source.points)
    report = json.loads((tmp_path / "d" / "report.json").read_text())
    assert report["T_target_source"] == pair.gt_T_target_source.tolist()


def test_a_wrong_answer_is_called_what_it_is(cli, fake, tmp_path, pair):
    flip = np.diag([-1.0, -1, 1, 1])
    fake.changes = {"T_target_source": flip @ pair.gt_T_target_source}
    assert "error    180.000 degrees" in cli("demo", "--out-dir", tmp_path / "d").stderr


def test_a_demo_that_fails_leaves_nothing(cli, fake, tmp_path):
    fake.raises = KeyboardInterrupt()
    assert cli("demo", "--out-dir", tmp_path / "d").exit_code == 130
    assert fake.calls
    assert list(tmp_path.iterdir()) == []


def test_an_existing_demo_is_replaced_only_if_told(cli, fake, tmp_path):
    (tmp_path / "report.json").write_text("precious")
    refused = cli("demo", "--out-dir", tmp_path)
    assert refused.exit_code == 5
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]
    assert (tmp_path / "report.json").read_text() == "precious"
    assert cli("demo", "--out-dir", tmp_path, "--overwrite").exit_code == 0
