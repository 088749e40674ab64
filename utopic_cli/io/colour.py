"""The colours of every picture: more is redder, or lighter; source is orange, target blue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.config import DEFAULT_COLOUR_MAP, ColourMapName

SOURCE_COLOUR = (230, 159, 0)  # told apart from the target's by colour-blind eyes too
TARGET_COLOUR = (0, 114, 178)
_UNKNOWN = (128, 128, 128)


@dataclass(frozen=True)
class ColourMap:
    """Colours from little to much.

    Attributes:
        stops: evenly spaced red, green, blue, from 0 to 1.
        more: how much differs from little, in a word.
    """

    stops: tuple[tuple[int, int, int], ...]
    more: str


COLOUR_MAPS: dict[ColourMapName, ColourMap] = {
    # As in the paper's figure. Saturated enough to be told apart on white and on black.
    "blue-red": ColourMap(
        ((35, 60, 190), (60, 125, 210), (70, 185, 205), (245, 220, 90), (245, 125, 45), (225, 10, 20)),
        "redder",
    ),
    # Lighter all the way, so that it can be read without telling red from green, or in print.
    "purple-yellow": ColourMap(
        ((55, 10, 95), (60, 70, 150), (30, 125, 150), (60, 180, 120), (170, 215, 70), (255, 240, 60)),
        "lighter",
    ),
}


def colour_map(values: np.ndarray, name: ColourMapName = DEFAULT_COLOUR_MAP) -> np.ndarray:
    """Return the colours of values.

    Args:
        values: (N,) numbers; below 0 counts as 0, above 1 as 1, NaN is grey.
        name: one of ``COLOUR_MAPS``.

    Returns:
        (N, 3) uint8 red, green, blue.
    """
    table = np.array(COLOUR_MAPS[name].stops, np.float64)
    values = np.asarray(values, np.float64)
    known = ~np.isnan(values)
    place = np.clip(np.where(known, values, 0.0), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(table))
    colours = np.stack([np.interp(place, stops, table[:, channel]) for channel in range(3)], axis=1)
    colours[~known] = _UNKNOWN
    return np.rint(colours).astype(np.uint8)  # (N, 3)
