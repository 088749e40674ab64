"""The colours of every picture: blue is little, red is much; source is orange, target blue."""

from __future__ import annotations

import numpy as np

# Evenly spaced stops, saturated enough to be told apart on white and on black.
_STOPS = np.array(
    [(35, 60, 190), (60, 125, 210), (70, 185, 205), (245, 220, 90), (245, 125, 45), (225, 10, 20)], np.float64
)
SOURCE_COLOUR = (230, 159, 0)  # told apart from the target's by colour-blind eyes too
TARGET_COLOUR = (0, 114, 178)
_UNKNOWN = (128, 128, 128)


def colour_map(values: np.ndarray) -> np.ndarray:
    """Return colours from blue over cyan and yellow to red.

    Args:
        values: (N,) numbers; below 0 counts as 0, above 1 as 1, NaN is grey.

    Returns:
        (N, 3) uint8 red, green, blue.
    """
    values = np.asarray(values, np.float64)
    known = ~np.isnan(values)
    place = np.clip(np.where(known, values, 0.0), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(_STOPS))
    colours = np.stack([np.interp(place, stops, _STOPS[:, channel]) for channel in range(3)], axis=1)
    colours[~known] = _UNKNOWN
    return np.rint(colours).astype(np.uint8)  # (N, 3)
