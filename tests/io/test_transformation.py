"""Transformations as files: exact round trips, strict reading."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest

from tests.io.samples import motion
from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.transformation import SUFFIXES, format_transformation, read_transformation


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
        (".yaml", b"x", "no transformation file"),
    ],
)
def test_unsound_files_are_named(tmp_path: Path, suffix: str, data: bytes, reason: str) -> None:
    path = tmp_path / f"T{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_transformation(path)
    assert reason in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
