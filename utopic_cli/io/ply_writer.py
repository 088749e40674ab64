"""New PLY files of our own: points, colours and scalar fields, named as viewers expect them.

A scalar field ``overlap`` becomes the property ``scalar_overlap``: CloudCompare loads what begins so as
a scalar field called ``overlap`` without being told, and shows the first one. The field that gives the
colours is therefore the first, and is written once more as ``quality``, which MeshLab takes for its
vertex quality. Blender keeps every property as an attribute. No property is called ``intensity``:
MeshLab would paint the points grey by it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from utopic_cli.io.colour import SOURCE_COLOUR, TARGET_COLOUR

PREFIX = "scalar_"
SHOWN = "quality"
_COLOURS = ("red", "green", "blue")
_TYPES = {"<f8": "double", "|u1": "uchar", "<f4": "float"}


def scalar_cloud_ply(
    points: np.ndarray,
    colours: np.ndarray,
    scalars: Mapping[str, np.ndarray],
    comments: Sequence[str] = (),
    shown: str | None = None,
) -> bytes:
    """Return a binary little-endian PLY with coordinates in double precision.

    Args:
        points: (N, 3) float64.
        colours: (N, 3) uint8 red, green, blue.
        scalars: name (letters, digits, underscores) to (N,) values: float32, float64 or uint8.
        comments: lines for the header.
        shown: name of the scalar field that gives the colours: put first, and repeated for MeshLab.

    Raises:
        ValueError: lengths differ, a name, type or comment does not fit a PLY header, or two names
            become one property.
    """
    for comment in comments:
        if not comment.isprintable():
            raise ValueError(f"{comment!r} does not fit one header line")
    if points.shape != (len(points), 3) or colours.shape != points.shape:
        raise ValueError(f"points {points.shape} and colours {colours.shape} must both be (N, 3)")
    columns = {name: np.asarray(points[:, axis], np.float64) for axis, name in enumerate("xyz")}
    columns |= {name: np.asarray(colours[:, channel], np.uint8) for channel, name in enumerate(_COLOURS)}
    order = scalars if shown is None else [shown, *(name for name in scalars if name != shown)]
    named = {property_name(name): np.asarray(scalars[name]) for name in order}
    if len(named) < len(scalars):
        raise ValueError(f"of {', '.join(scalars)} two become one PLY property")
    columns |= named
    if shown is not None:
        columns[SHOWN] = np.asarray(scalars[shown])
    for name, values in columns.items():
        if values.shape != (len(points),) or values.dtype.str not in _TYPES:
            raise ValueError(
                f"'{name}' is {values.dtype} {values.shape}, not float32, float64 or uint8 ({len(points)},)"
            )

    table = np.empty(len(points), np.dtype([(name, values.dtype) for name, values in columns.items()]))
    for name, values in columns.items():
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(points)}"]
    header += [f"property {_TYPES[values.dtype.str]} {name}" for name, values in columns.items()]
    header += ["end_header", ""]
    return "\n".join(header).encode("utf-8") + table.tobytes()


def points_ply(points: np.ndarray) -> bytes:
    """Return (N, 3) float64 points, NaN included, as a binary PLY with nothing else in it."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [*(f"property double {name}" for name in "xyz"), "end_header", ""]
    return "\n".join(header).encode("ascii") + np.ascontiguousarray(points, "<f8").tobytes()


def property_name(name: str) -> str:
    """Return the property that holds a scalar field.

    Args:
        name: of the field; CloudCompare looks for normals in names with ``nx``, ``ny`` or ``nz``
            anywhere inside, so these letters are set apart.

    Raises:
        ValueError: it is no PLY property name.
    """
    if not (name.isascii() and f"_{name}".isidentifier()):
        raise ValueError(f"'{name}' is no PLY property name")
    return PREFIX + re.sub("n(?=[xyz])", r"\g<0>_", name, flags=re.IGNORECASE)


def merged_cloud_ply(
    source_points: np.ndarray, target_points: np.ndarray, comments: Sequence[str] = ()
) -> bytes:
    """Return both clouds as one PLY; the scalar field ``scan`` is 0 for source, 1 for target.

    Args:
        source_points: (N, 3) float64, already in the target's frame.
        target_points: (M, 3) float64.
        comments: lines for the header.
    """
    counts = [len(source_points), len(target_points)]
    points = np.concatenate([source_points, target_points])
    colours = np.repeat(np.array([SOURCE_COLOUR, TARGET_COLOUR], np.uint8), counts, axis=0)
    scan = np.repeat(np.array([0, 1], np.float32), counts)
    return scalar_cloud_ply(points, colours, {"scan": scan}, comments, shown="scan")
