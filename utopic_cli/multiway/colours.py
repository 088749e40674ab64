"""The colours of points: as their file has them, or one for each scan."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping

import numpy as np

from utopic_cli.multiway.fields import COLOURS, PACKED

_GOLDEN = 0.6180339887498949  # of a turn: neighbouring numbers get unlike hues


def has_colours(names: Mapping[str, object]) -> bool:
    """Tell whether fields of these names hold colours."""
    return names.keys() >= set(COLOURS) or PACKED in names


def colour_fields(names: Mapping[str, object]) -> tuple[str, ...]:
    """Return which fields ``colours_of`` needs, none if there are no colours."""
    if names.keys() >= set(COLOURS):
        return COLOURS
    return (PACKED,) if PACKED in names else ()


def colours_of(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return colours as bytes.

    Bytes stay as they are. Files declare other numbers loosely: all up to 1 where numbers are
    fractions, up to 255, or up to 65535; the largest tells which.

    Args:
        values: (N,) by name, see ``colour_fields``; packed: the bits 0x00RRGGBB of 4 bytes.

    Returns:
        (N, 3) uint8 red, green, blue.
    """
    if PACKED in values:
        stored = values[PACKED]
        bits = stored.view(f"u{stored.itemsize}") if stored.dtype.kind == "f" else stored
        if stored.dtype.kind == "f" and stored.itemsize == 8:
            bits = stored.astype(np.float32).view(np.uint32)
        packed = bits.astype(np.int64)
        return np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    three = [values[name] for name in COLOURS]
    if all(channel.dtype == np.uint8 for channel in three):
        return np.stack(three, axis=1)
    table = np.nan_to_num(np.stack([channel.astype(np.float64) for channel in three], axis=1))
    largest = table.max(initial=0.0)
    fractions = all(channel.dtype.kind == "f" for channel in three)
    full = 1.0 if fractions and largest <= 1.0 else 255.0 if largest <= 255.0 else 65535.0
    return np.rint(255.0 * np.clip(table / full, 0.0, 1.0)).astype(np.uint8)


def scan_colour(number: int) -> tuple[int, int, int]:
    """Return a colour to tell a scan by, its number counting from 0."""
    parts = colorsys.hsv_to_rgb((0.58 + number * _GOLDEN) % 1.0, 0.62, 0.9)
    return tuple(round(255 * part) for part in parts)  # type: ignore[return-value]
