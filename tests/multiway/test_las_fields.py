"""What LAS files say of their points, for merged and coloured clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.io.test_las import again, las
from utopic_cli.commands.kept_fields import kept_fields
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway.fields import SAMPLE_BYTES, find_fields


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


def test_coloured_clouds_keep_them(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(las(compressed=True))
    kept = kept_fields(read_scan(path))
    np.testing.assert_array_equal(kept["intensity"], np.asarray(again(path.read_bytes()).intensity))
    assert kept.keys() >= {"original_red", "original_green", "original_blue", "quality"}
