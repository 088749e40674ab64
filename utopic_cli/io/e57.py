"""E57: all scans of a file in its own frame; moved by their poses, so that no point is touched."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from utopic_cli.io.e57_file import E57File, Node, Stream, open_e57, parse_xml, read_columns
from utopic_cli.io.quaternion import quaternion_of, rigid_of
from utopic_cli.io.records import FormatError, Motion, Records

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_FIELDS = {"intensity": "intensity", "colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}
_NORMALS = ("normalX", "normalY", "normalZ")  # of the extension for surface normals


@dataclass(frozen=True)
class E57Document:
    """A file kept whole.

    Attributes:
        file: its layers.
        root: of its XML section.
    """

    file: E57File
    root: Node

    def rewrite(self, motion: Motion) -> bytes:
        """Move the scans and pictures by their poses: coordinates in an E57 file are the scanner's own."""
        changes: list[tuple[int, int, bytes]] = []  # from, to, instead
        for group in ("data3D", "images2D"):
            for entry in _entries(self.root, group):
                pose = entry.child("pose")
                if pose is not None:
                    moved = motion.transformation @ _pose(entry)
                    changes.append((pose.start, pose.end, _pose_xml(moved)))
                elif group == "data3D":
                    end = self.file.xml.rindex(b"</", entry.start, entry.end)
                    changes.append((end, end, _pose_xml(motion.transformation)))
        xml = self.file.xml
        for start, end, instead in sorted(changes, reverse=True):
            xml = xml[:start] + instead + xml[end:]
        return self.file.with_xml(xml)

    def field_names(self) -> list[str]:
        """Return what all scans say of their points, under the names of ``_FIELDS``.

        Raises:
            FormatError: the XML section is not sound.
        """
        scans = [streams for _, _, streams in self._told()]
        return [name for name in _FIELDS.values() if scans and all(name in streams for streams in scans)]

    def fields(self, records: int) -> dict[str, np.ndarray]:
        """Return (R,) float64 values of every record for each of ``field_names``.

        Args:
            records: how many the file was found to have.

        Raises:
            FormatError: the file promises another number, or its columns are not sound.
        """
        names, scans = self.field_names(), list(self._told())
        promised = sum(count for _, count, _ in scans)
        if promised != records:
            raise FormatError(f"promises {promised} E57 points but holds {records}; copy it again")
        tables = [
            read_columns(self.file, section, count, [streams[name] for name in names])
            for section, count, streams in scans
            if names
        ]
        return {name: np.concatenate(columns) for name, columns in zip(names, zip(*tables))}

    def _told(self) -> Iterator[tuple[int, int, dict[str, Stream]]]:
        """Yield the section, the number of points, and the columns of ``_FIELDS`` of scans with points."""
        for entry in _entries(self.root, "data3D"):
            points = entry.child("points")
            prototype = None if points is None else points.child("prototype")
            count = 0 if points is None else _integer(points, "recordCount", 0)
            if points is None or prototype is None or count <= 0:
                continue
            nodes = enumerate(prototype.children)
            streams = {_FIELDS[node.name]: _stream(i, node) for i, node in nodes if node.name in _FIELDS}
            yield self.file.place(_integer(points, "fileOffset", -1)), count, streams


def read_e57(data: bytes) -> Records:
    """Read the points of an E57 file; several scans are put together by their poses.

    Raises:
        FormatError: the file is not sound, or has no scans.
    """
    file = open_e57(data)
    root = parse_xml(file.xml)
    scans = [_read_scan(file, entry) for entry in _entries(root, "data3D")]
    scans = [scan for scan in scans if len(scan[0])]
    if not scans:
        raise FormatError("has no E57 scan with points; check what it is, or export it again")
    points = np.concatenate([points for points, _ in scans])
    whole = [normals for _, normals in scans if normals is not None]
    warnings = (f"holds {len(scans)} scans, taken as one by their poses",) if len(scans) > 1 else ()
    return Records(
        points, np.concatenate(whole) if len(whole) == len(scans) else None, E57Document(file, root), warnings
    )


def e57_document(data: bytes) -> E57Document:
    """Open a file whose points are read elsewhere: its checksums are not looked at again.

    Raises:
        FormatError: the file is not sound.
    """
    file = open_e57(data, check=False)
    return E57Document(file, parse_xml(file.xml))


def _entries(root: Node, group: str) -> list[Node]:
    found = root.child(group)
    return [] if found is None else [child for child in found.children if child.name == "vectorChild"]


def _read_scan(file: E57File, entry: Node) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the points (N, 3) of one scan in the file's frame, NaN where invalid, and its normals."""
    points = entry.child("points")
    prototype = None if points is None else points.child("prototype")
    if points is None or prototype is None:
        raise FormatError("has an E57 scan without points; export it again")
    count = _integer(points, "recordCount", 0)
    if count <= 0:
        return np.empty((0, 3)), None
    fields = {node.name: (number, node) for number, node in enumerate(prototype.children)}
    names = next((triple for triple in (_CARTESIAN, _SPHERICAL) if fields.keys() >= set(triple)), None)
    if names is None:
        raise FormatError("has an E57 scan without coordinates; export it as points")
    state = "cartesianInvalidState" if names is _CARTESIAN else "sphericalInvalidState"
    wanted = [*names, *([state] if state in fields else [])]
    normals = fields.keys() >= set(_NORMALS)
    wanted += _NORMALS if normals else ()
    section = file.place(_integer(points, "fileOffset", -1))
    streams = {name: _stream(*fields[name]) for name in wanted}
    if not any(streams[name].bits for name in names):  # and nothing holds against the promised number
        raise FormatError("has E57 points that are all equal; export it again")
    columns = dict(zip(wanted, read_columns(file, section, count, list(streams.values()))))
    values = np.stack([columns[name] for name in names], axis=1)
    if names is _SPHERICAL:
        values = _from_spherical(values)
    if state in columns:
        values[columns[state] != 0] = np.nan
    pose = _pose(entry)
    with np.errstate(invalid="ignore"):
        values = values @ pose[:3, :3].T + pose[:3, 3]
        if not normals:
            return values, None
        return values, np.stack([columns[name] for name in _NORMALS], axis=1) @ pose[:3, :3].T


def _from_spherical(values: np.ndarray) -> np.ndarray:
    """Turn (N, 3) range, azimuth and elevation in radians into coordinates."""
    distance, azimuth, elevation = values.T
    with np.errstate(invalid="ignore"):
        level = distance * np.cos(elevation)
        return np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1
        )


def _stream(number: int, node: Node) -> Stream:
    """Tell from a prototype's entry how the numbers of a column are stored."""
    kind = node.attributes.get("type")
    if kind == "Float":
        single = node.attributes.get("precision") == "single"
        return Stream(number, 32 if single else 64, np.dtype("<f4" if single else "<f8"))
    if kind not in ("Integer", "ScaledInteger"):
        raise FormatError(f"has E57 {node.name} of type {str(kind)[:20]}; export it again")
    least, most = _integer(node, "minimum", -(2**63)), _integer(node, "maximum", 2**63 - 1)
    if not -(2**63) <= least <= most < 2**63:
        raise FormatError(f"has E57 {node.name} with limits that can't be true; export it again")
    scale = _number(node.attributes.get("scale", "1")) if kind == "ScaledInteger" else 1.0
    offset = _number(node.attributes.get("offset", "0")) if kind == "ScaledInteger" else 0.0
    return Stream(number, (most - least).bit_length(), None, least, scale, offset)


def _pose(entry: Node) -> np.ndarray:
    """Return the (4, 4) transformation from a scan's own frame to the file's."""
    pose = entry.child("pose")
    turn = None if pose is None else pose.child("rotation")
    shift = None if pose is None else pose.child("translation")
    quaternion = [_part(turn, name, 1.0 if name == "w" else 0.0) for name in "xyzw"]
    return rigid_of(np.array([_part(shift, name, 0.0) for name in "xyz"]), np.array(quaternion))


def _part(node: Node | None, name: str, missing: float) -> float:
    part = None if node is None else node.child(name)
    # An element without text is zero.
    return missing if part is None else _number(part.text.strip() or "0")


def _pose_xml(pose: np.ndarray) -> bytes:
    def parts(names: str, values: np.ndarray) -> str:
        return "".join(f'<{name} type="Float">{v:.17g}</{name}>' for name, v in zip(names, values))

    x, y, z, w = quaternion_of(pose[:3, :3])
    rotation = parts("wxyz", np.array([w, x, y, z]))
    return (
        f'<pose type="Structure"><rotation type="Structure">{rotation}</rotation>'
        f'<translation type="Structure">{parts("xyz", pose[:3, 3])}</translation></pose>'
    ).encode("ascii")


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise FormatError(f"has '{text[:24]}' in its E57 XML where a number belongs") from None
    if not np.isfinite(value):
        raise FormatError("has an infinite number in its E57 XML; export it again")
    return value


def _integer(node: Node, name: str, missing: int) -> int:
    text = node.attributes.get(name)
    try:
        return missing if text is None else int(text)
    except ValueError:
        raise FormatError(f"has '{str(text)[:24]}' in its E57 XML where an integer belongs") from None
