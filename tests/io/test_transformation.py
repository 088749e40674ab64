"""Transformations as files: exact round trips, strict reading."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.io.samples import motion, mutated
from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.transformation import (
    FORM_OF_SUFFIX,
    FORMS,
    SUFFIXES,
    form_of,
    format_transformation,
    read_transformation,
)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip_to_the_last_digit(tmp_path: Path, suffix: str) -> None:
    T = motion(1.1, (4e5 + 1 / 3, 5e6 + 1 / 7, -0.1))
    path = tmp_path / f"T{suffix}"
    path.write_bytes(format_transformation(T, suffix))
    again = read_transformation(path)
    np.testing.assert_array_equal(again[:3, 3], T[:3, 3])
    np.testing.assert_allclose(again, T, rtol=0, atol=1e-15)


def test_formats_are_what_other_tools_read() -> None:
    T = motion()
    np.testing.assert_array_equal(np.loadtxt(io.BytesIO(format_transformation(T, ".txt"))), T)
    np.testing.assert_array_equal(np.load(io.BytesIO(format_transformation(T, ".npy"))), T)
    content = json.loads(format_transformation(T, ".json"))
    assert content["convention"] == "p_target = T_target_source @ p_source"
    np.testing.assert_array_equal(content["T_target_source"], T)
    with pytest.raises(OutputError, match=r"\.xlsx"):
        format_transformation(T, ".xlsx")


def test_few_digits_are_made_rigid(tmp_path: Path) -> None:
    path = tmp_path / "T.txt"
    path.write_text("\n".join(" ".join(f"{v:.4f}" for v in row) for row in motion()))
    rotation = read_transformation(path)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, motion()[:3, :3], atol=1e-4)


def npy(array: np.ndarray, allow_pickle: bool = False) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=allow_pickle)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("suffix", "data", "reason"),
    [
        (".txt", b"", "empty"),
        (".txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n", "3 rows"),
        (".txt", b"1 0 0\n0 1 0\n0 0 1\n0 0 0\n", "row 1 has 3 values"),
        (".txt", b"1 0 0 0\n0 1 0 0\n0 0 1 x\n0 0 0 1\n", "row 3 has 'x'"),
        (".txt", b"2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "scales or shears"),
        (".txt", b"1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "mirrors"),
        (".txt", b"1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "finite"),
        (".txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n1 2 3 1\n", "last row"),
        (".npy", npy(np.eye(3)), "(3, 3) array"),
        (".npy", npy(np.array([{}] * 16).reshape(4, 4), allow_pickle=True), "object"),
        (".npy", npy(np.eye(4))[:-8], "not a NumPy array"),
        (".npy", npy(np.eye(4)).replace(b"(4, 4), }", b"(4, 4000000000), }"), "array"),
        (".npy", b"hello", "not a NumPy array"),
        (".json", b"{", "not JSON"),
        (".json", b"[" * 100_000, "not JSON"),
        (".json", b"{}", "no 'T_target_source'"),
        (".json", b"[[1, 2], [3, 4]]", "4 rows of 4"),
        (".json", json.dumps(np.eye(4).astype(str).tolist()).encode(), "4 rows of 4"),
        (".txt", b"1 0 0 0 0 1 0 0\n1 0 0 0 0 1 0 0 0 1 0 0\n", "2 rows of 8 or 12"),
        (".txt", b"# nothing\n", "no numbers"),
        (".tum", b"0,1,2,3,0,0,0,1\n", "commas"),
        (".tum", b"0 1 2 3 0 0 0 0.7\n", "length 0.7"),
        (".tum", b"0 1 2 3 0 0 0 nan\n", "length nan"),
        (".kitti", b"1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "2 transformations ('1' to '2')"),
        (".log", b"0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", "row 4 has 3 values"),
        (".json", b'{"pipeline": ["a.las", "b.las"]}', "0 filters.transformation"),
        (".json", b'[{"type": "filters.transformation", "matrix": "1 0 0"}]', "16 numbers"),
        (
            ".json",
            b'[{"type": "filters.transformation", "invert": true, "matrix": "%s"}]' % b" ".join([b"0"] * 16),
            "no inverse",
        ),
        (".json", b'{"class_name": "PointCloud"}', "Open3D's PointCloud"),
        (".json", b'{"translation": [1, 2, 3], "rotation": [0, 0, 0, 1]}', "name its parts"),
        (".json", b'{"translation": {"x": 1, "y": 2}, "rotation": {}}', "without x, y, z"),
        (".json", b'{"T_target_source": [["\xc3\xa9", 0, 0, 0], [], [], []]}', "4 rows of 4"),
        (".json", b'{"scans": [{"scan": "a", "T_world_scan": null}]}', "no transformation"),
        (".yaml", b"just words\n", "no transformation"),
        (".yaml", b"a: &anchor 1\n", "no plain YAML"),
        (".yaml", b"a:\n\tb: 1\n", "tab"),
        (".yaml", b"a: {x: 1\n", "no plain YAML"),
        (".yaml", b"a: 1\na: 2\n", "again"),
        (".yaml", b"- " * 100 + b"1\n", "too deep"),
        (".yaml", b"[" * 1000 + b"\n", "no plain YAML"),
        (".yaml", b"a" + b" " * 500_000 + b"!\n", "too long"),
        (".yaml", b"\xff\xfe", "UTF-8"),
        (".xlsx", b"x", "no transformation file"),
    ],
)
def test_unsound_files_are_named(tmp_path: Path, suffix: str, data: bytes, reason: str) -> None:
    path = tmp_path / f"T{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_transformation(path)
    assert reason in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_comes_back(tmp_path: Path, form: str) -> None:
    T = motion(2.9, (4e5 + 1 / 3, 5e6 + 1 / 7, -0.1))
    suffix = next(suffix for suffix, named in FORM_OF_SUFFIX.items() if named == form)
    path = tmp_path / f"T{suffix}"
    assert form_of(path) == form
    path.write_bytes(format_transformation(T, form))
    again = read_transformation(path)
    np.testing.assert_array_equal(again[:3, 3], T[:3, 3])
    np.testing.assert_allclose(again, T, rtol=0, atol=1e-15)


def test_names_tell_the_form() -> None:
    assert form_of("a/T.PDAL.json") == "pdal"
    assert form_of("a.pdal/T.json") == "json"
    assert form_of("T.yml") == "ros"
    assert form_of("T.doc") is None and form_of(".txt") is None


def quaternion_about_z(degrees: float) -> tuple[float, float, float, float]:
    half = np.radians(degrees) / 2
    return 0.0, 0.0, float(np.sin(half)), float(np.cos(half))


# A quarter turn about z, then a shift: small whole numbers, worked out by hand.
QUARTER = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
QX, QY, QZ, QW = quaternion_about_z(90)
TURN = {"x": QX, "y": QY, "z": QZ, "w": QW}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("numpy.txt", "[[ 0. -1.  0.  1.]\n [ 1.  0.  0.  2.]\n [ 0.  0.  1.  3.]\n [ 0.  0.  0.  1.]]"),
        ("commas.txt", "0, -1, 0, 1\n1, 0, 0, 2\n0, 0, 1, 3\n0, 0, 0, 1\n"),
        ("comments.txt", "# from CloudCompare\n\n0 -1 0 1\r\n1 0 0 2\r\n0 0 1 3\r\n0 0 0 1\r\n"),
        ("pdal.txt", "0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1"),
        ("kitti.txt", "0 -1 0 1 1 0 0 2 0 0 1 3"),
        ("tum.txt", f"1305031102.17 1 2 3 {QX} {QY} {QZ} {QW}"),
        ("T.log", "7 3 9\n0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n"),
        ("bare.json", json.dumps(QUARTER.tolist())),
        ("pair.json", json.dumps({"status": "done", "report": {"T_target_source": QUARTER.tolist()}})),
        (
            "pipeline.json",
            json.dumps(
                [
                    "in.las",
                    {"type": "filters.transformation", "matrix": "0 -1 0 1  1 0 0 2  0 0 1 3  0 0 0 1"},
                ]
            ),
        ),
        (
            "inverted.json",
            json.dumps(
                {
                    "pipeline": [
                        "in.las",
                        {
                            "type": "filters.transformation",
                            "invert": True,
                            "matrix": "0 1 0 -2  -1 0 0 1  0 0 1 -3  0 0 0 1",
                        },
                    ]
                }
            ),
        ),
        (
            "camera.json",
            json.dumps({"class_name": "PinholeCameraParameters", "extrinsic": QUARTER.T.ravel().tolist()}),
        ),
        (
            "transform.json",
            json.dumps(
                {
                    "transform": {
                        "translation": {"x": 1, "y": 2, "z": 3},
                        "rotation": TURN,
                    }
                }
            ),
        ),
        (
            "quaternion.json",
            json.dumps({"translation": [1, 2, 3], "quaternion": TURN}),
        ),
        (
            "echo.yaml",
            "transforms:\n- header:\n    stamp: {sec: 1, nanosec: 2}\n    frame_id: 'map: it'  # a comment\n"
            "  child_frame_id: base\n  transform:\n    translation:\n      x: 1.0\n      y: 2\n      z: 3e0\n"
            f"    rotation:\n      x: {QX}\n      y: {QY}\n      z: {QZ}\n      w: {QW}\n---\n",
        ),
        (
            "pose.yaml",
            "pose:\n  position: {x: 1, y: 2, z: 3}\n"
            f"  orientation: {{x: {QX}, y: {QY}, z: {QZ}, w: {QW}}}\n",
        ),
    ],
)
def test_what_other_tools_write_is_read(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    np.testing.assert_allclose(read_transformation(path), QUARTER, atol=1e-15)


def test_one_of_several_is_named(tmp_path: Path) -> None:
    poses = tmp_path / "poses.json"
    scans = [{"scan": "a#1.ply", "T_world_scan": np.eye(4).tolist()}]
    scans += [{"scan": "b.ply", "T_world_scan": QUARTER.tolist()}, {"scan": "c.ply", "T_world_scan": None}]
    poses.write_text(json.dumps({"scans": scans}))
    np.testing.assert_array_equal(read_transformation(f"{poses}#b.ply"), QUARTER)
    np.testing.assert_array_equal(read_transformation(f"{poses}#a#1.ply"), np.eye(4))
    for wrong, said in (("", "#a#1.ply'"), ("#c.ply", "no entry 'c.ply'; it holds a#1.ply, b.ply")):
        with pytest.raises(InputError) as caught:
            read_transformation(f"{poses}{wrong}")
        assert said in str(caught.value)
    rows = tmp_path / "poses.txt"
    rows.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 2 0 0 1 3\n")
    np.testing.assert_array_equal(read_transformation(f"{rows}#2"), QUARTER)
    with pytest.raises(InputError, match="cannot be read"):
        read_transformation(tmp_path / f"{'long' * 100}.txt")
    odd = tmp_path / "T#2.txt"
    odd.write_bytes(format_transformation(QUARTER, "matrix"))
    np.testing.assert_array_equal(read_transformation(odd), QUARTER)


def test_open3d_reads_and_writes_the_same(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    T = motion(translation=(1.0, 2.0, 3.0))
    path = tmp_path / "T.log"
    path.write_bytes(format_transformation(T, "open3d"))
    trajectory = open3d.io.read_pinhole_camera_trajectory(str(path))
    # A log holds where the camera is; the extrinsic matrix is the inverse of that.
    np.testing.assert_allclose(trajectory.parameters[0].extrinsic, np.linalg.inv(T), atol=1e-12)
    for name, expected in (("again.log", T), ("again.json", np.linalg.inv(T))):
        open3d.io.write_pinhole_camera_trajectory(str(tmp_path / name), trajectory)
        np.testing.assert_allclose(read_transformation(tmp_path / name), expected, atol=1e-7)
    graph = open3d.pipelines.registration.PoseGraph()
    graph.nodes.append(open3d.pipelines.registration.PoseGraphNode(np.eye(4)))
    graph.nodes.append(open3d.pipelines.registration.PoseGraphNode(T))
    open3d.io.write_pose_graph(str(tmp_path / "graph.json"), graph)
    np.testing.assert_allclose(read_transformation(f"{tmp_path / 'graph.json'}#2"), T, atol=1e-12)


def test_any_yaml_parser_reads_ours() -> None:
    yaml = pytest.importorskip("yaml")
    message = yaml.safe_load(format_transformation(QUARTER, "ros"))
    assert message["header"]["frame_id"] == "target" and message["child_frame_id"] == "source"
    assert message["transform"]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert message["transform"]["rotation"] == pytest.approx(TURN)


def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    for form in FORMS:
        suffix = next(suffix for suffix, named in FORM_OF_SUFFIX.items() if named == form)
        path = tmp_path / f"T{suffix}"
        for _ in range(60):
            path.write_bytes(mutated(format_transformation(motion(), form), rng))
            try:
                T = read_transformation(path)
            except InputError as error:
                assert str(error).isprintable()
            else:
                np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_what_is_rigid_comes_back_to_the_byte(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        matrix[:3, 3] = rng.normal(0, 1e3, 3)
        data = format_transformation(matrix, "matrix")
        (tmp_path / "T.txt").write_bytes(data)
        assert format_transformation(read_transformation(tmp_path / "T.txt"), "matrix") == data


def test_a_table_of_poses_points_to_the_poses_file(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("name,group\n")
    with pytest.raises(InputError, match=r"poses\.json#NAME"):
        read_transformation(tmp_path / "poses.csv")


def test_words_are_named_with_their_line(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("# a comment\n1 2\nDear all,\nthese are the scans.\n")
    with pytest.raises(InputError, match="line 3 holds 'Dear', which is no number; a transformation is"):
        read_transformation(tmp_path / "letter.txt")
