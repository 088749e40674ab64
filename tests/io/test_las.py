"""LAS and LAZ against laspy, which writes and reads the files here."""

from __future__ import annotations

import io
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.io.samples import bumpy_points, motion, moved, mutated
from utopic_cli.errors import InputError
from utopic_cli.io.las import las_block, read_las
from utopic_cli.io.las_header import parse_header
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import read_scan

laspy = pytest.importorskip("laspy")
pytest.importorskip("lazrs")

PLACE = np.array([4e5, 5e6, 100.0])
KINDS = [(0, "1.2"), (3, "1.2"), (1, "1.3"), (6, "1.4"), (7, "1.4"), (8, "1.4")]


def las(
    point_format: int = 7,
    version: str = "1.4",
    *,
    compressed: bool = False,
    points: np.ndarray | None = None,
    scale: float = 1e-3,
    normals: bool = True,
) -> bytes:
    """A file with every kind of thing in it: extra bytes, records before and, in 1.4, after the points."""
    points = 50 * bumpy_points(300) + PLACE if points is None else points
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [scale] * 3, np.rint((points.min(axis=0) + points.max(axis=0)) / 2)
    header.add_extra_dim(laspy.ExtraBytesParams(name="quality", type="u2"))
    if normals:
        for axis in "XYZ":
            header.add_extra_dim(laspy.ExtraBytesParams(name=f"Normal{axis}", type="f4"))
    header.vlrs.append(laspy.VLR(user_id="somebody", record_id=7, description="", record_data=b"before"))
    content = laspy.LasData(header)
    content.x, content.y, content.z = points.T
    rng = np.random.default_rng(4)
    content.intensity = rng.integers(0, 60000, len(points))
    content.classification = rng.integers(0, 9, len(points))
    content["quality"] = rng.integers(0, 60000, len(points))
    if normals:
        for axis, values in zip("XYZ", np.eye(3)[rng.integers(0, 3, len(points))].T):
            content[f"Normal{axis}"] = values
    if version == "1.4":
        after = laspy.VLR(user_id="somebody", record_id=8, description="", record_data=b"after" * 20)
        content.evlrs = laspy.vlrs.vlrlist.VLRList([after])
    stream = io.BytesIO()
    content.write(stream, do_compress=compressed)
    return stream.getvalue()


def again(data: bytes) -> Any:
    return laspy.read(io.BytesIO(data))


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("point_format", "version"), KINDS)
def test_moves_points_and_normals_and_keeps_the_rest(
    point_format: int, version: str, compressed: bool
) -> None:
    T = motion(translation=(-4e5, 3.0, 7.0))
    data = las(point_format, version, compressed=compressed)
    records, before = read_las(data), again(data)
    np.testing.assert_allclose(records.points, before.xyz, rtol=0, atol=1e-9)
    written = records.moved(T)
    after = again(written)
    # A tenth of the file's millimetre is the new grid, so rounding is half of that.
    np.testing.assert_allclose(after.xyz, moved(before.xyz, T), rtol=0, atol=0.51e-4)
    np.testing.assert_allclose(after.header.scales, 1e-4)
    np.testing.assert_allclose(after.header.mins, after.xyz.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(after.header.maxs, after.xyz.max(axis=0), atol=1e-9)
    turned = {f"Normal{axis}" for axis in "XYZ"}
    for name in set(before.point_format.dimension_names) - {*"XYZ", *turned}:
        np.testing.assert_array_equal(np.asarray(after[name]), np.asarray(before[name]), err_msg=name)
    normals = [np.stack([content[name] for name in sorted(turned)], axis=1) for content in (before, after)]
    np.testing.assert_allclose(normals[1], normals[0] @ T[:3, :3].T, atol=1e-6)
    kept = [vlr.record_data for vlr in after.vlrs if vlr.user_id == "somebody"]
    assert kept == [b"before"]
    assert [vlr.record_data for vlr in after.evlrs or ()] == [b"after" * 20] * (version == "1.4")
    if not compressed:  # nothing but the grid, the bounds, the coordinates and the normals
        differing = np.flatnonzero(np.frombuffer(data, "u1") != np.frombuffer(written, "u1"))
        assert (
            differing.min() >= 131
            and not ((differing > 226) & (differing < before.header.offset_to_point_data)).any()
        )


def test_there_and_back_is_where_it_was() -> None:
    T = motion(2.0, (10.0, -20.0, 30.0))
    first = read_las(las())
    back = read_las(read_las(first.moved(T)).moved(np.linalg.inv(T)))
    np.testing.assert_allclose(back.points, first.points, rtol=0, atol=1e-4)


def test_a_shift_leaves_every_integer() -> None:
    data, T = las(), np.eye(4)
    T[:3, 3] = 1 / 3, -7e5, 0.1
    before, after = again(data), again(read_las(data).moved(T))
    for axis in "XYZ":
        np.testing.assert_array_equal(after[axis], before[axis])
    np.testing.assert_allclose(after.xyz, before.xyz + T[:3, 3], rtol=0, atol=1e-8)


def test_a_grid_that_would_overflow_gets_coarser() -> None:
    points = 2e6 * np.sign(bumpy_points(100))  # corners of a cube, as far out as integers reach
    records = read_las(las(points=points, normals=False))
    T = motion()
    written = again(records.moved(T))
    assert max(written.header.scales) == pytest.approx(1e-2)  # 3.4 million metres along the diagonal
    np.testing.assert_allclose(written.xyz, moved(records.points, T), rtol=0, atol=0.51e-2)


def test_without_lazrs_plain_las_is_read_and_laz_names_the_command(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "lazrs", None)
    assert len(read_las(las()).points) == 300
    path = tmp_path / "a.laz"
    path.write_bytes(las(compressed=True))
    with pytest.raises(InputError, match=r"a\.laz: .*pip install 'utopic-cli\[las\]'"):
        read_scan(path)


def test_copc_becomes_plain_laz() -> None:
    data = las(compressed=True)
    data = data.replace(b"somebody\0\0\0\0\0\0\0\0\7\0", b"copc\0\0\0\0\0\0\0\0\0\0\0\0\1\0")
    records = read_las(data)
    assert "COPC" in records.warnings[0]
    vlrs = again(records.moved(motion())).vlrs
    assert not [vlr for vlr in vlrs if vlr.user_id == "copc"]
    assert [vlr.record_data for vlr in vlrs if vlr.user_id == "LASF_Spec" and vlr.record_id == 7] == [
        b"before"
    ]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda d: d[:100], "cut short"),
        (lambda d: d[:-1500], "cut short"),
        (lambda d: d[:24] + b"\1\5" + d[26:], "LAS 1.5"),
        (lambda d: d[:104] + b"\x0b" + d[105:], "point format 11"),
        (lambda d: d[:131] + struct.pack("<d", float("nan")) + d[139:], "scale"),
        (lambda d: d[:247] + struct.pack("<Q", 1 << 60) + d[255:], str(1 << 60)),
        (lambda d: b"LASX" + d[4:], "no LAS file"),
    ],
)
@pytest.mark.parametrize("compressed", [False, True])
def test_damaged_files_are_refused(damage, reason: str, compressed: bool) -> None:
    with pytest.raises(FormatError) as caught:
        read_las(damage(las(compressed=compressed)))
    assert reason in str(caught.value) or (compressed and "damaged" in str(caught.value))


def test_a_chunk_that_promises_gigabytes_is_refused_before_room_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import lazrs

    data = bytearray(las(compressed=True))
    (points_at,) = struct.unpack_from("<I", data, 96)
    (record,) = struct.unpack_from("<H", data, 105)
    struct.pack_into("<I", data, points_at + 8 + record + 4, 0xFFFFFFF0)  # the size of the first layer
    monkeypatch.setattr(lazrs, "LasZipDecompressor", None)  # would make the room
    with pytest.raises(FormatError, match="chunk 1 is not whole"):
        read_las(bytes(data))


@pytest.mark.parametrize("compressed", [False, True])
def test_mutated_files_are_read_or_refused(compressed: bool) -> None:
    rng, data = np.random.default_rng(5), las(compressed=compressed, points=bumpy_points(60))
    outcomes = set()
    for _ in range(150):
        try:
            read_las(mutated(data, rng)).moved(motion())
            outcomes.add("read")
        except FormatError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_chunks_of_any_size_are_read_and_written() -> None:
    import lazrs

    data, plain = las(compressed=True), las()
    header = parse_header(data)
    vlr = lazrs.LazVlr.new_for_compression(7, header.record_size - 36, use_variable_size_chunks=True)
    settings, where = bytes(vlr.record_data()), header.find(b"laszip encoded", 22204)
    assert where is not None and len(settings) == where.size
    stream = io.BytesIO()
    stream.write(data[: where.start] + settings + data[where.start + where.size : header.points_at])
    compressor = lazrs.LasZipCompressor(stream, vlr)
    block = las_block(plain)[1]
    for start, end in ((0, 10), (10, 250), (250, 300)):
        compressor.compress_many(
            np.frombuffer(block, "u1")[start * header.record_size : end * header.record_size]
        )
        compressor.finish_current_chunk()
    compressor.done()
    end = stream.seek(0, io.SEEK_END)
    shifted = bytearray(stream.getvalue() + data[header.tail_at :])
    struct.pack_into("<Q", shifted, 235, end)
    records = read_las(bytes(shifted))
    np.testing.assert_array_equal(records.points, read_las(plain).points)
    np.testing.assert_array_equal(
        read_las(records.moved(motion())).points, read_las(read_las(plain).moved(motion())).points
    )
    np.testing.assert_array_equal(
        again(records.moved(motion())).xyz, again(read_las(plain).moved(motion())).xyz
    )
