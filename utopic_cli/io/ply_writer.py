"""New PLY files of our own: points, colours and scalar fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from utopic_cli.io.colour import SOURCE_COLOUR, TARGET_COLOUR


def scalar_cloud_ply(
    points: np.ndarray,
    colours: np.ndarray,
    scalars: Mapping[str, np.ndarray],
    comments: Sequence[str] = (),
) -> bytes:
    """Return a binary little-endian PLY with coordinates in double precision.

    Args:
        points: (N, 3) float64.
        colours: (N, 3) uint8 red, green, blue.
        scalars: name (a PLY property name: no blanks) to (N,) float32 values.
        comments: lines for the header.

    Raises:
        ValueError: lengths differ, or a name or comment does not fit a PLY header.
    """
    colour_names = ("red", "green", "blue")
    fields = [(name, "<f8") for name in "xyz"] + [(name, "u1") for name in colour_names]
    fields += [(name, "<f4") for name in scalars]
    for name in scalars:
        if not name.isascii() or not name.isidentifier():
            raise ValueError(f"'{name}' is no PLY property name")
    for comment in comments:
        if not comment.isprintable():
            raise ValueError(f"{comment!r} does not fit one header line")
    if points.shape != (len(points), 3) or colours.shape != points.shape:
        raise ValueError(f"points {points.shape} and colours {colours.shape} must both be (N, 3)")

    table = np.empty(len(points), np.dtype(fields))
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    for channel, name in enumerate(colour_names):
        table[name] = colours[:, channel]
    for name, values in scalars.items():
        if np.shape(values) != (len(points),):
            raise ValueError(f"'{name}' has shape {np.shape(values)}, not ({len(points)},)")
        table[name] = values

    kinds = {"<f8": "double", "u1": "uchar", "<f4": "float"}
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(points)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields]
    header += ["end_header", ""]
    return "\n".join(header).encode() + table.tobytes()


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
    return scalar_cloud_ply(points, colours, {"scan": scan}, comments)
