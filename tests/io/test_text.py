"""XYZ, TXT, PTS and CSV: separators, headers, counts, and what must be refused."""

from __future__ import annotations

import numpy as np
import pytest

from tests.io.samples import bumpy_points, motion, moved, unit_normals
from utopic_cli.io.records import FormatError
from utopic_cli.io.text import read_text


def text(separator: str = " ", header: str = "", tail: str = "", end: str = "\n") -> bytes:
    rows = [separator.join(map(repr, p)) + tail for p in bumpy_points().tolist()]
    return end.join([*([header] if header else []), *rows]).encode()


@pytest.mark.parametrize("separator", [" ", "\t", ",", ";", ", ", "   "])
@pytest.mark.parametrize("header", ["", "# a comment", "//X Y Z", "x{0}y{0}z", "80"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_reads_and_moves(separator: str, header: str, end: str) -> None:
    header = header.format(separator)
    data = text(separator, header, separator + "17" if header in ("", "80") else "", end)
    records = read_text(data)
    np.testing.assert_array_equal(records.points, bumpy_points())
    again = records.moved(motion())
    np.testing.assert_allclose(read_text(again).points, moved(bumpy_points(), motion()), rtol=0, atol=1e-14)
    assert again.startswith(header.encode())
    assert again.count(end.encode()) == data.count(end.encode())
    if header == "80":
        assert all(row.rstrip().endswith(b"17") for row in again.split(end.encode())[1:])


def test_named_columns_may_stand_anywhere() -> None:
    points, normals = bumpy_points(), unit_normals()
    rows = ["label,nx,ny,nz,z,y,x"]
    rows += [
        f"chair,{','.join(map(repr, n))},{p[2]!r},{p[1]!r},{p[0]!r}"
        for p, n in zip(points.tolist(), normals.tolist(), strict=True)
    ]
    records = read_text("\n".join(rows).encode())
    np.testing.assert_array_equal(records.points, points)
    again = read_text(records.moved(motion()))
    np.testing.assert_allclose(again.points, moved(points, motion()), rtol=0, atol=1e-14)
    np.testing.assert_allclose(again.normals, normals @ motion()[:3, :3].T, rtol=0, atol=1e-14)
    assert records.moved(motion()).count(b"chair,") == 80


def test_unit_columns_turn_and_colours_do_not() -> None:
    points = bumpy_points()
    normals = unit_normals()
    rows = [" ".join(map(repr, [*p, *n])) for p, n in zip(points.tolist(), normals.tolist(), strict=True)]
    records = read_text("\n".join(rows).encode())
    assert "taken for normals" in records.warnings[0]
    again = read_text(records.moved(motion()))
    np.testing.assert_allclose(again.normals, normals @ motion()[:3, :3].T, rtol=0, atol=1e-14)
    colours = read_text(text(tail=" 255 128 0"))
    assert colours.normals is None
    assert colours.moved(motion()).count(b" 255 128 0") == 80


def test_no_final_newline_and_byte_order_mark() -> None:
    records = read_text(b"\xef\xbb\xbf" + text())
    assert len(records.points) == 80
    assert read_text(records.moved(motion())).points.shape == (80, 3)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (text().replace(b".", b","), "decimal comma"),
        (text("\t").replace(b".", b","), "decimal comma"),
        (text("; ").replace(b".", b","), "decimal comma"),
        (b"1,05,2,5,3,25\n4,5,5,03,6,75\n", "commas both as decimal and between values"),
        (b"90\n" + text(), "promises 90 points but there are 80"),
        (b"99999999999999999999\n" + text(), "promises 9+ points"),
        (text() + b"\n1 2", "its line 81 has 2 values where 3 belong"),
        (text() + b"\n1 2 x", "its line 81 has 'x', which is not a number"),
        (text() + b"\n1 2 1_000", "1_000"),
        (b"1 2\n3 4\n", "2 values a line"),
        (b"# nothing\n\n", "no points"),
        (b"5\n", "promises 5 points but there are 0"),
        (text().decode().encode("utf-16"), "UTF-16"),
        (b"\x00\x01\x02", "binary"),
    ],
)
def test_unsound_files_are_named(data: bytes, reason: str) -> None:
    with pytest.raises(FormatError, match=reason):
        read_text(data)


def test_more_lines_than_promised_are_kept() -> None:
    data = b"60\n" + text()
    records = read_text(data)
    assert len(records.points) == 60 and "20 more lines" in records.warnings[0]
    assert records.moved(motion()).split(b"\n")[61:] == data.split(b"\n")[61:]
