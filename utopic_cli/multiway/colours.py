"""The colours a scan's points have in their file."""

from __future__ import annotations

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.io.ascii_table import parse_table
from utopic_cli.io.files import read_bytes
from utopic_cli.io.ply_header import parse_header
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import Scan

_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


def read_colours(scan: Scan) -> np.ndarray | None:
    """Return the colours of a scan's finite points, or None if its file has none that are known.

    PLY files whose vertices come first, without lists, as scanners and viewers write them;
    integers by their range, floats from 0 to 1.

    Returns:
        (N, 3) uint8 red, green, blue, or None.

    Raises:
        InputError: the file has changed since it was read.
    """
    if scan.format != "ply":
        return None
    data = read_bytes(scan.path)
    try:
        header = parse_header(data)
        vertex = header.elements[0]
        places = {p.name: i for i, p in enumerate(vertex.properties)}
        names = next((names for names in _NAMES if places.keys() >= set(names)), None)
        if names is None or vertex.name != "vertex" or vertex.has_lists:
            return None
        dtypes = [vertex.properties[places[name]].dtype for name in names]
        if vertex.count != scan.records:
            raise FormatError("has changed while it was read; run again")
        body = memoryview(data)[header.size :]
        if header.order:
            layout = np.dtype([(p.name, p.dtype) for p in vertex.properties])
            table = np.frombuffer(body, layout, vertex.count)
            values = np.stack([table[name].astype(np.float64) for name in names], axis=1)
        else:
            lines = [line for line in bytes(body).splitlines() if line.strip()][: vertex.count]
            wanted = [places[name] for name in names]
            values = parse_table(lines, len(vertex.properties), wanted, lambda i: f"its PLY vertex {i}")
    except (FormatError, ValueError) as error:
        raise InputError(f"{scan.path}: {error}") from None
    largest = [float(np.iinfo(dtype).max) if dtype.kind in "iu" else 1.0 for dtype in dtypes]
    shares = np.nan_to_num(values[scan.kept] / largest, nan=0.0)
    return np.rint(255.0 * np.clip(shares, 0.0, 1.0)).astype(np.uint8)
