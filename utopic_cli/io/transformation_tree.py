"""Transformations as JSON or YAML, told apart by their keys."""

from __future__ import annotations

from typing import Any

import numpy as np

from utopic_cli.io.quaternion import rigid_of
from utopic_cli.io.records import FormatError

Entries = list[tuple[str, np.ndarray]]
"""Transformations by name, (4, 4) float64 each, not yet checked for being rigid."""


class PlacedScans(Entries):
    """The transformations of a batch's model: from each scan's frame to the world's.

    Attributes:
        left_out: why other scans have none, by name.
    """

    def __init__(self, entries: Entries, left_out: dict[str, str]) -> None:
        """Keep both."""
        super().__init__(entries)
        self.left_out = left_out


_PDAL_STAGE = "filters.transformation"
_TRANSLATIONS = ("translation", "position")
_ROTATIONS = ("rotation", "orientation", "quaternion")
_WRAPPERS = ("transform", "pose", "report")  # ROS's messages, and the record of a pair of 'batch'


def entries_of_tree(content: Any) -> Entries:
    """Find the transformations in what JSON or YAML gave.

    Known are ``T_target_source`` (this tool's files and reports), the ``T_world_scan`` of
    ``poses.json``, a bare 4x4 list, PDAL's ``filters.transformation``, Open3D's camera parameters,
    trajectories and pose graphs, and ROS's messages with a translation and a quaternion.

    Raises:
        FormatError: it is none of these, or not sound.
    """
    if isinstance(content, list):
        if any(isinstance(stage, (dict, str)) for stage in content):
            return _pdal(content)
        return [("", _matrix(content, "the list"))]
    if not isinstance(content, dict):
        raise FormatError("holds no transformation; see docs/transformations.md for what is read")
    if "T_target_source" in content:
        return [("", _matrix(content["T_target_source"], "'T_target_source'"))]
    if "pipeline" in content:
        return _pdal(content["pipeline"])
    if "class_name" in content:
        return _open3d(content)
    if isinstance(content.get("scans"), list):
        return _placed_scans(content["scans"], content.get("left_out"))
    if isinstance(content.get("transforms"), list):  # ROS: tf2_msgs/TFMessage
        return [entry for stamped in content["transforms"] for entry in entries_of_tree(stamped)]
    for wrapper in _WRAPPERS:
        if isinstance(content.get(wrapper), dict):
            name = content.get("child_frame_id")
            return [(own or str(name or ""), matrix) for own, matrix in entries_of_tree(content[wrapper])]
    translation = next((content[key] for key in _TRANSLATIONS if key in content), None)
    rotation = next((content[key] for key in _ROTATIONS if key in content), None)
    if translation is not None and rotation is not None:
        shift = _named(translation, "xyz", "the translation")
        return [("", rigid_of(shift, _named(rotation, "xyzw", "the rotation")))]
    raise FormatError(
        "has no 'T_target_source'; put the 4 rows of 4 numbers under that name,"
        " or see docs/transformations.md for what else is read"
    )


def _placed_scans(scans: list[Any], left_out: Any) -> PlacedScans:
    placed = [scan for scan in scans if isinstance(scan, dict) and scan.get("T_world_scan") is not None]
    without = [scan for scan in left_out if isinstance(scan, dict)] if isinstance(left_out, list) else []
    return PlacedScans(
        [
            (str(scan.get("scan", number)), _matrix(scan["T_world_scan"], "'T_world_scan'"))
            for number, scan in enumerate(placed, 1)
        ],
        {str(scan.get("scan")): str(scan.get("reason")) for scan in without},
    )


def _pdal(stages: Any) -> Entries:
    """Return the one transformation of a pipeline; readers, writers and other filters are passed over."""
    stages = stages if isinstance(stages, list) else []
    found = [stage for stage in stages if isinstance(stage, dict) and stage.get("type") == _PDAL_STAGE]
    if len(found) != 1:
        raise FormatError(f"is a PDAL pipeline with {len(found)} {_PDAL_STAGE}; leave exactly one")
    text = found[0].get("matrix")
    tokens = text.split() if isinstance(text, str) else []
    try:
        matrix = np.array([float(token) for token in tokens])
    except ValueError:
        matrix = np.empty(0)
    if len(matrix) != 16:
        raise FormatError("has a PDAL 'matrix' that is no string of 16 numbers; write it again")
    matrix = matrix.reshape(4, 4)
    if found[0].get("invert") in (True, "true"):
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 0.5:
            raise FormatError("is no rigid transformation: its matrix has no inverse")
        matrix = np.linalg.inv(matrix)
    return [("", matrix)]


def _open3d(content: dict[str, Any]) -> Entries:
    """Return Open3D's matrices, which it writes column by column."""
    kind = content["class_name"]
    if kind == "PinholeCameraParameters":
        return [("", _columns(content, "extrinsic"))]
    key, place = {
        "PinholeCameraTrajectory": ("extrinsic", "parameters"),
        "PoseGraph": ("pose", "nodes"),
    }.get(kind if isinstance(kind, str) else "", ("", ""))
    parts = content.get(place)
    if not key or not isinstance(parts, list):
        raise FormatError(f"is Open3D's {str(kind)[:40]}, which holds no transformation that is read")
    return [(str(number), _columns(part, key)) for number, part in enumerate(parts, 1)]


def _columns(part: Any, key: str) -> np.ndarray:
    values = part.get(key) if isinstance(part, dict) else None
    if not isinstance(values, list) or len(values) != 16:
        raise FormatError(f"has an '{key}' that is no list of 16 numbers; write it again")
    return _numbers(values, f"'{key}'").reshape(4, 4, order="F")


def _matrix(rows: Any, what: str) -> np.ndarray:
    rows = rows if isinstance(rows, list) else []
    values = [value for row in rows if isinstance(row, list) and len(row) == 4 for value in row]
    if len(rows) != 4 or len(values) != 16:
        raise FormatError(f"{what} must be 4 rows of 4 numbers")
    return _numbers(values, what, "must be 4 rows of 4 numbers").reshape(4, 4)


def _named(value: Any, names: str, what: str) -> np.ndarray:
    """Return the values of x, y, z (, w) in that order; a translation may be a list as well."""
    if isinstance(value, dict) and set(names) <= value.keys():
        value = [value[name] for name in names]
    elif not (isinstance(value, list) and len(value) == 3 and len(names) == 3):
        # A quaternion without names may begin or end with w: nothing tells.
        raise FormatError(f"has {what} without {', '.join(names)}; name its parts")
    return _numbers(value, what)


def _numbers(values: list[Any], what: str, must: str = "must be numbers") -> np.ndarray:
    if not all(type(value) in (int, float) for value in values):
        raise FormatError(f"{what} {must}")
    try:
        return np.array(values, np.float64)
    except OverflowError:
        raise FormatError(f"{what} holds a number that is too large") from None
