from __future__ import annotations

import json
import os
import re
from typing import get_args, get_type_hints

import numpy as np
import pytest

from tests.commands.conftest import QUARTER_TURN
from utopic_cli import config
from utopic_cli.commands.align import align
from utopic_cli.commands.outputs import CLOUD_KINDS
from utopic_cli.result import FitMeasures

CLOUDS = {f"{kind}.ply" for kind in CLOUD_KINDS}
WHOLE_SET = {"transformation.txt", "aligned.ply", "report.html", "report.json", *CLOUDS}


def strict_json(text):
    def refuse(constant):
        raise AssertionError(f"{constant} in JSON")

    return json.loads(text, parse_constant=refuse)


def read_points(path):
    """Read x, y, z of any vertex-only PLY our writers make, without our own reader."""
    data = path.read_bytes()
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = {"double": "<f8", "float": "<f4", "uchar": "u1"}
    kind = np.dtype(
        [(line.split()[2], names[line.split()[1]]) for line in lines if line.startswith("property")]
    )
    if any("ascii" in line for line in lines):
        table = np.array([row.split() for row in body.decode().splitlines()], float)
        return {name: table[:, i] for i, name in enumerate(kind.names)}
    table = np.frombuffer(body, kind)
    assert len(table) == count
    return {name: table[name] for name in kind.names}


def xyz(fields):
    return np.stack([fields["x"], fields["y"], fields["z"]], axis=1)


def test_matrix_alone_goes_to_stdout_and_the_summary_to_stderr(cli, fake, scans):
    result = cli("align", *scans)
    assert result.exit_code == 0
    matrix = np.array([line.split() for line in result.stdout.splitlines()], float)
    np.testing.assert_array_equal(matrix, QUARTER_TURN)
    assert "75% of the source, 50% of the target" in result.stderr
    assert "90.000 degrees" in result.stderr
    assert (
        "aligned and trusted; confidence 97%" in result.stderr
        and "because  the surfaces agree" in result.stderr
    )


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".json"])
def test_the_transformation_file_has_the_format_of_its_suffix(cli, fake, scans, tmp_path, suffix):
    path = tmp_path / f"T{suffix}"
    result = cli("align", *scans, "-o", path)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == ""
    if suffix == ".txt":
        matrix = np.loadtxt(path)
    elif suffix == ".npy":
        matrix = np.load(path, allow_pickle=False)
    else:
        matrix = np.array(strict_json(path.read_text())["T_target_source"])
    np.testing.assert_array_equal(matrix, QUARTER_TURN)


def test_the_whole_set(cli, fake, scans, tmp_path, monkeypatch):
    order, link = [], os.link

    def recorded(temporary, path):
        order.append(path.name)
        link(temporary, path)

    monkeypatch.setattr(os, "link", recorded)
    out = tmp_path / "out"
    result = cli("align", *scans, "--out-dir", out)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == ""
    assert {path.name for path in out.iterdir()} == WHOLE_SET
    assert len(order) == len(WHOLE_SET)
    assert order[-1] == "report.json"
    moved = xyz(read_points(out / "aligned.ply"))
    source = xyz(read_points(scans[0]))
    np.testing.assert_array_equal(moved, source @ QUARTER_TURN[:3, :3].T + QUARTER_TURN[:3, 3])
    assert b"comment a.ply" in (out / "aligned.ply").read_bytes()


def test_coloured_clouds_carry_both_fields_at_every_point_and_are_redder_where_there_is_more(
    cli, fake, scans, tmp_path
):
    assert cli("align", *scans, "--clouds", tmp_path / "clouds").exit_code == 0
    assert {path.stem for path in (tmp_path / "clouds").iterdir()} == set(CLOUD_KINDS)
    for kind in CLOUD_KINDS:
        fields = read_points(tmp_path / "clouds" / f"{kind}.ply")
        scan = read_points(scans[0] if kind.startswith("source") else scans[1])
        np.testing.assert_array_equal(xyz(fields), xyz(scan))
        ramp = np.linspace(0, 1, len(scan["x"]), dtype=np.float32)
        np.testing.assert_array_equal(fields["scalar_overlap"], ramp)
        np.testing.assert_array_equal(fields["scalar_uncertainty"], ramp[::-1])
        shown = fields["quality"]
        np.testing.assert_array_equal(shown, fields["scalar_" + kind.split("_")[1]])
        redness = fields["red"].astype(int) - fields["blue"].astype(int)
        assert redness[np.argmax(shown)] > 100
        assert redness[np.argmin(shown)] < -50


def test_coloured_clouds_keep_what_the_scans_file_says(cli, fake, scans, tmp_path):
    header = scans[0].read_bytes().replace(b"uchar red", b"float intensity")
    scans[0].write_bytes(header)
    assert cli("align", *scans, "--clouds", tmp_path / "clouds").exit_code == 0
    for kind in ("source_overlap", "source_uncertainty"):
        fields = read_points(tmp_path / "clouds" / f"{kind}.ply")
        np.testing.assert_array_equal(fields["scalar_intensity"], np.arange(60))


def test_fields_that_can_not_be_kept_are_said_where_clouds_are_asked_for(cli, fake, scans, tmp_path):
    """A layout that only the reader of points knows: vertices behind another element."""
    text = scans[0].read_text().replace("element vertex", "element note 1\nproperty int n\nelement vertex")
    scans[0].write_text(text.replace("end_header\n", "end_header\n7\n"))
    lost = f"{scans[0]}: its colours and scalar fields are not in the coloured clouds: its PLY vertices don't"
    result = cli("align", *scans, "--out-dir", tmp_path / "out")
    assert result.exit_code == 0 and result.stderr.count(f"utopic: warning: {lost} come first") == 1
    assert [lost in text for text in json.loads((tmp_path / "out" / "report.json").read_text())["warnings"]]
    assert lost.split(": ")[1] in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert b"scalar_red" not in (tmp_path / "out" / "source_overlap.ply").read_bytes()
    assert "warning" not in cli("align", *scans, "-o", tmp_path / "T.txt").stderr


def test_the_colour_map_is_that_of_clouds_and_page(cli, fake, scans, tmp_path):
    out = tmp_path / "out"
    assert cli("align", *scans, "--out-dir", out, "--colormap", "purple-yellow").exit_code == 0
    fields = read_points(out / "source_overlap.ply")
    lightest = fields["red"].astype(int) + fields["green"]
    assert lightest.argmax() == fields["scalar_overlap"].argmax()
    assert lightest.argmin() == fields["scalar_overlap"].argmin()
    assert b"lighter = more likely to overlap" in (out / "source_overlap.ply").read_bytes()
    assert "#fff03c" in (out / "report.html").read_text(encoding="utf-8")
    refused = cli("align", *scans, "--clouds", tmp_path / "c", "--colormap", "rainbow")
    assert refused.exit_code == 2 and "blue-red" in refused.stderr


def test_the_page_names_both_files_holds_the_matrix_and_repeats_warnings(cli, fake, scans, tmp_path):
    fake.changes = {"warnings": ("watch out",)}
    result = cli("align", *scans, "--html", tmp_path / "p.html")
    assert result.exit_code == 0, result.stderr
    assert f"wrote    {tmp_path / 'p.html'}" in result.stderr
    page = (tmp_path / "p.html").read_bytes().decode("utf-8")
    assert page.startswith("<!doctype html>")
    for wanted in ("a.ply", "b.ply", "watch out", "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1"):
        assert wanted in page
    refused = cli("align", *scans, "--html", tmp_path / "p.html")
    assert refused.exit_code == 5
    assert "p.html: exists already" in refused.stderr


def test_merged_holds_both_scans_in_the_targets_frame(cli, fake, scans, tmp_path):
    assert cli("align", *scans, "--merged", tmp_path / "m.ply").exit_code == 0
    fields = read_points(tmp_path / "m.ply")
    source, target = xyz(read_points(scans[0])), xyz(read_points(scans[1]))
    np.testing.assert_array_equal(
        xyz(fields)[fields["scalar_scan"] == 0], source @ QUARTER_TURN[:3, :3].T + QUARTER_TURN[:3, 3]
    )
    np.testing.assert_array_equal(xyz(fields)[fields["scalar_scan"] == 1], target)


def test_what_could_not_be_measured_is_null_with_a_reason(cli, fake, scans, tmp_path):
    fake.changes = {"observability": None}
    assert cli("align", *scans, "--report", tmp_path / "r.json").exit_code == 0
    report = strict_json((tmp_path / "r.json").read_text())
    assert {"unobservable", "covariance", "covariance_about"} == set(report["not_measured"])
    assert all(report[name] is None and why for name, why in report["not_measured"].items())


def test_the_report_says_everything_promised(cli, fake, scans, tmp_path):
    fake.changes = {"warnings": ("watch out",), "reasons": ("because",)}
    assert cli("align", *scans, "--report", tmp_path / "r.json").exit_code == 0
    report = strict_json((tmp_path / "r.json").read_text())
    promised = (
        "schema_version utopic_cli convention weights source target T_target_source rotation_translation "
        "about_source_centroid confidence trusted reasons ambiguous_with overlap_ratio inlier_ratio "
        "inlier_rmse residual_percentiles unobservable covariance overlap uncertainty timings_s options "
        "warnings"
    )
    assert set(promised.split()) <= set(report)
    assert report["schema_version"] == 1
    assert report["convention"] == "p_target = T_target_source @ p_source"
    assert report["confidence"] == 0.97 and report["trusted"] is True
    assert report["not_measured"] == {}
    assert report["unobservable"] == [{"kind": "rotation", "axis": [0, 0, 1], "point": [1, 2, 0]}]
    assert np.shape(report["covariance"]) == (6, 6) and report["covariance_about"] == [0, 0, 0]
    assert report["T_target_source"] == QUARTER_TURN.tolist()
    assert report["source"]["points"] == 60
    assert report["target"]["path"] == str(scans[1])
    assert re.fullmatch("[0-9a-f]{64}", report["source"]["sha256"])
    assert report["options"]["seed"] == 0
    assert report["warnings"][-1] == "watch out"
    assert {"read", "network"} <= set(report["timings_s"])


def test_json_is_alone_on_stdout(cli, fake, scans):
    result = cli("align", *scans, "--json")
    assert strict_json(result.stdout)["T_target_source"] == QUARTER_TURN.tolist()


def test_numbers_that_are_not_finite_become_null(cli, fake, scans):
    nothing_fits = FitMeasures({"source": 0.0, "target": 0.0}, 0.0, float("nan"), {"p50": np.inf}, 0.1)
    fake.changes = {"raw_uncertainty": {"source_mean": np.float32("nan")}, "fit": nothing_fits}
    report = strict_json(cli("align", *scans, "--json").stdout)
    assert report["uncertainty"]["raw"]["source_mean"] is None
    assert report["inlier_rmse"] is None
    assert report["residual_percentiles"]["p50"] is None


def test_quiet_says_nothing_and_verbose_says_more(cli, fake, scans, tmp_path):
    fake.changes = {"warnings": ("watch out",)}
    assert cli("align", *scans, "-q", "-o", tmp_path / "q.txt").output == ""
    normal = cli("align", *scans).stderr
    assert "utopic: warning: watch out" in normal
    assert len(cli("align", *scans, "-v").stderr.splitlines()) > len(normal.splitlines())


def test_where_several_poses_fit_the_way_to_say_what_is_known_is_named(cli, fake, scans):
    fake.changes = {"ambiguous_with": (np.diag([-1.0, -1.0, 1.0, 1.0]),), "trusted": False}
    assert "--max-rotation" in cli("align", *scans).stderr
    assert "--max-rotation" not in cli("align", *scans, "--max-rotation", 90).stderr
    fake.changes = {"ambiguous_with": (), "trusted": False}
    assert "--max-rotation" not in cli("align", *scans).stderr


def test_options_reach_the_pipeline(cli, fake, scans, tmp_path):
    np.savetxt(tmp_path / "init.txt", QUARTER_TURN)
    result = cli(
        "align", *scans, "--points", 300, "--no-refine", "--solver", "svd", "--device", "cpu",
        "--threads", 1, "--seed", 7, "--weights", "other", "--init", tmp_path / "init.txt",
        "--max-rotation", 45,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert fake.calls[0]["options"] == config.AlignOptions("other", 300, False, "svd", 45.0, "cpu", 1, 7)
    np.testing.assert_array_equal(fake.calls[0]["initial"], QUARTER_TURN)


def test_without_options_the_defaults_of_the_library_hold(cli, fake, scans):
    cli("align", *scans)
    assert fake.calls[0]["options"] == config.AlignOptions()


def test_choices_are_those_of_the_library():
    hints = get_type_hints(align)
    assert get_args(hints["solver"]) == config.SOLVERS
    assert get_args(hints["device"]) == config.DEVICES


def test_an_answer_not_to_be_trusted_is_written_and_exits_3(cli, fake, scans, tmp_path):
    fake.changes = {"trusted": False, "confidence": 0.2, "reasons": ("a rival fits as well",)}
    result = cli("align", *scans, "-o", tmp_path / "T.txt")
    assert result.exit_code == 3
    assert (tmp_path / "T.txt").exists()
    assert "do not trust it" in result.stderr
    assert "a rival fits as well" in result.stderr
    assert cli("align", *scans, "--exit-zero").exit_code == 0


def test_the_same_run_twice_writes_the_same_bytes(cli, fake, scans, tmp_path):
    for name in ("first", "second"):
        cli("align", *scans, "--out-dir", tmp_path / name)
    for name in WHOLE_SET - {"report.json"}:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


def test_weights_without_a_calibration_are_never_trusted(cli, fake, scans):
    fake.changes = {"trusted": False, "confidence": None, "reasons": ("no calibration",)}
    result = cli("align", *scans)
    assert result.exit_code == 3
    assert "do not trust it unseen" in result.stderr and "because  no calibration" in result.stderr
    np.testing.assert_array_equal(np.loadtxt(result.stdout.splitlines()), QUARTER_TURN)
