"""What LAS files say of their points, for merged and coloured clouds."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.io.test_las import again, las
from tests.multiway.test_merge import read as read_ply_table
from utopic_cli.commands.kept_fields import kept_fields
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway.fields import SAMPLE_BYTES, find_fields, sample_size
from utopic_cli.multiway.merge import write_merged
from utopic_cli.multiway.scans import find_scans


@pytest.mark.parametrize("point_format", [0, 1, 3, 6, 7, 8])
@pytest.mark.parametrize("compressed", [False, True])
def test_fields_are_what_laspy_reads(point_format: int, compressed: bool) -> None:
    data = las(point_format, "1.4" if point_format > 3 else "1.2", compressed=compressed)
    expected = again(data)
    fields = find_fields(data[: len(data) // 2], "las")
    assert {"intensity", "quality", "normalx"} <= fields.dtypes.keys()
    values = fields.read(data, 300, list(fields.dtypes))
    for name, found in values.items():
        theirs = name.replace("normal", "Normal")[:-1] + name[-1].upper() if "normal" in name else name
        np.testing.assert_array_equal(found, np.asarray(expected[theirs]), err_msg=name)
    names = set(expected.point_format.dimension_names)
    assert ("gps_time" in values) == ("gps_time" in names) and ("red" in values) == ("red" in names)
    with pytest.raises(FormatError, match="changed"):
        fields.read(data, 299, ["intensity"])


def test_a_beginning_too_short_is_refused() -> None:
    with pytest.raises(FormatError):
        find_fields(las()[:300], "las")
    assert len(las()) < SAMPLE_BYTES


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_fields_behind_a_megabyte_of_records_are_kept(tmp_path: Path, suffix: str) -> None:
    data = bytearray(las(compressed=suffix == "laz"))
    size, points_at, records = struct.unpack_from("<HII", data, 94)
    more = b"".join(
        struct.pack("<H16sHH32s", 0, b"somebody", 9, 65535, b"") + bytes(65535) for _ in range(17)
    )
    assert points_at < SAMPLE_BYTES < len(more)
    struct.pack_into("<HII", data, 94, size, points_at + len(more), records + 17)
    for place in (235, *((points_at,) if suffix == "laz" else ())):  # what follows the points; chunks
        (start,) = struct.unpack_from("<Q", data, place)
        struct.pack_into("<Q", data, place, start + len(more))
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(data[:size] + more + data[size:])
    expected = np.asarray(again(path.read_bytes()).intensity)
    np.testing.assert_array_equal(kept_fields(read_scan(path))[0]["intensity"], expected)
    (tmp_path / f"b.{suffix}").write_bytes(data[:size] + more + data[size:] + b"\0")
    files = dict(enumerate(find_scans([path, tmp_path / f"b.{suffix}"]).scans))
    write_merged(tmp_path / "m.ply", dict.fromkeys(files, np.eye(4)), files, seed=0)
    merged = read_ply_table(tmp_path / "m.ply")
    np.testing.assert_array_equal(merged["scalar_intensity"], np.tile(expected, 2))


def test_no_more_is_asked_for_than_a_file_has() -> None:
    data = bytearray(las())
    assert sample_size(data, "las", 5 << 20) == SAMPLE_BYTES
    struct.pack_into("<I", data, 96, 0xFFFFFFFF)
    assert sample_size(data, "laz", 5 << 20) == 5 << 20
    assert sample_size(data, "ply", 5 << 20) == SAMPLE_BYTES


def test_coloured_clouds_keep_them(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(las(compressed=True))
    kept, _ = kept_fields(read_scan(path))
    np.testing.assert_array_equal(kept["intensity"], np.asarray(again(path.read_bytes()).intensity))
    assert kept.keys() >= {"original_red", "original_green", "original_blue", "quality"}
