"""What a scan file says of its points besides where they are, to be carried into clouds of our own."""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING

from utopic_cli.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from utopic_cli.io.scan import Scan

OWN = ("overlap", "uncertainty")
_ORIGINAL = "original_"
# Normals are no scalars, and opacity means nothing without its colours.
_LEFT_OUT = re.compile(r"n(orm(al)?)?_?[xyz]|a|alpha|diffuse_alpha")


def kept_fields(scan: Scan) -> tuple[dict[str, np.ndarray], str | None]:
    """Return the scalar fields and the colours of a scan's file.

    Args:
        scan: as it was read.

    Returns:
        Name to (N,) values of the scan's points: float32 where that holds what the file declares,
        else float64; colours are uint8, ``original_red`` and so on. Fields are called as in the file,
        in lower case, without CloudCompare's ``scalar_``, and with ``original_`` where the name would be
        one of ours, or another's, in a PLY. Empty for meshes, whose points are drawn from the surface.
        Then a warning where the file's layout keeps its fields from being told, or None.

    Raises:
        InputError: the file can't be read again, or has changed.
    """
    import numpy as np

    from utopic_cli.io.ply_writer import property_name
    from utopic_cli.multiway.colours import colour_fields, colours_of
    from utopic_cli.multiway.fields import COLOURS

    found, lost = _values(scan)
    values = {name: column[scan.kept] for name, column in found.items() if not _LEFT_OUT.fullmatch(name)}
    kept: dict[str, np.ndarray] = {}
    taken = {property_name(name) for name in OWN}
    colours = colour_fields(values)
    if colours:
        rgb = colours_of({name: values.pop(name) for name in colours})
        kept |= {_ORIGINAL + name: rgb[:, channel] for channel, name in enumerate(COLOURS)}
        taken |= {property_name(name) for name in kept}
    for name, column in values.items():
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "field"
        while property_name(plain) in taken:
            plain = _ORIGINAL + plain
        taken.add(property_name(plain))
        exact = np.can_cast(column.dtype, np.float32)
        with np.errstate(invalid="ignore"):
            kept[plain] = column.astype(np.float32 if exact else np.float64)
    return kept, lost and f"its colours and scalar fields are not in the coloured clouds: {lost}"


def _values(scan: Scan) -> tuple[dict[str, np.ndarray], str | None]:
    """Return (R,) values of every record of a scan's file by name, and why others are lost or None."""
    from utopic_cli.io.files import read_bytes
    from utopic_cli.io.records import FormatError
    from utopic_cli.multiway.fields import find_fields, sample_size

    try:
        told = getattr(scan.document.document, "fields", None)
        if told is not None:  # formats whose reader keeps them at hand
            return dict(told(scan.records)), None
        data = read_bytes(scan.path)
        if hashlib.sha256(data).hexdigest() != scan.sha256:
            raise InputError(f"{scan.path}: has changed while it was aligned; run again")
        fields = find_fields(data[: sample_size(data, scan.format, len(data))], scan.format)
        values = fields.read(data, scan.records, list(fields.dtypes)) if fields.dtypes else {}
    except (FormatError, ValueError, KeyError) as error:
        # A layout that only the reader of points knows.
        why = str(error) if isinstance(error, FormatError) else f"its {scan.format.upper()} layout is unusual"
        return {}, why
    return values, fields.lost
