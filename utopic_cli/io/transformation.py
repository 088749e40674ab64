"""Transformations as files, in the forms of this tool and of the programs around it.

A file may hold several (KITTI and TUM trajectories, ``poses.json``, Open3D's logs); one of them is
named behind a ``#``: ``poses.json#scan-a``, ``trajectory.tum#12`` (rows counted from 1).
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import numpy as np

from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.files import read_bytes
from utopic_cli.io.plain_yaml import parse_yaml
from utopic_cli.io.quaternion import quaternion_of
from utopic_cli.io.records import FormatError
from utopic_cli.io.transformation_rows import entries_of_rows
from utopic_cli.io.transformation_tree import Entries, PlacedScans, entries_of_tree

CONVENTION = "p_target = T_target_source @ p_source"

Frames = tuple[str, str]
"""Names of the frames that a transformation leads to and from."""

UNNAMED: Frames = ("target", "source")
WORLD = "world"

FORMS = {
    "matrix": "4 rows of 4 numbers: CloudCompare, PDAL, NumPy's loadtxt",
    "npy": "NumPy's np.save",
    "json": "T_target_source with its convention",
    "pdal": "a pipeline with filters.transformation",
    "open3d": "a line of numbers and the 4x4, as in Open3D's .log",
    "kitti": "one row of 12 numbers",
    "tum": "t tx ty tz qx qy qz qw",
    "ros": "geometry_msgs/TransformStamped as YAML",
}
"""Form by name, and what it is. Every form is read as well, told by the file's content."""

FORM_OF_SUFFIX = {
    ".txt": "matrix",
    ".npy": "npy",
    ".json": "json",
    ".pdal.json": "pdal",
    ".log": "open3d",
    ".kitti": "kitti",
    ".tum": "tum",
    ".yaml": "ros",
    ".yml": "ros",
}
SUFFIXES = tuple(FORM_OF_SUFFIX)

# How far the rotation may be from orthonormal: files with few digits are common.
_TOLERANCE = 1e-3
# Within this it is as exact as doubles are: taken as it is, so that writing it again gives the same digits.
_EXACT = 1e-12
_LARGEST_FILE = 1 << 26  # bytes: a trajectory of some 100,000 poses


def form_of(path: str | os.PathLike[str]) -> str | None:
    """Return the form that a file name asks for by its suffix, or None if by none of them."""
    name = Path(path).name.lower()
    # The longest first: T.pdal.json is no plain .json.
    for suffix in sorted(FORM_OF_SUFFIX, key=len, reverse=True):
        if name.endswith(suffix) and name != suffix:
            return FORM_OF_SUFFIX[suffix]
    return None


def format_transformation(transformation: np.ndarray, form: str, frames: Frames = UNNAMED) -> bytes:
    """Return a (4, 4) transformation as the bytes of a file.

    Args:
        transformation: (4, 4) float64, ``p_target = T_target_source @ p_source``.
        form: one of ``FORMS``, or a suffix that stands for one. Text carries 17 digits.
        frames: what target and source are, for the forms that name them.

    Raises:
        OutputError: the form is another one.
    """
    matrix = np.asarray(transformation, np.float64)
    form = FORM_OF_SUFFIX.get(form.lower(), form)
    rows = [" ".join(f"{value:.17g}" for value in row) for row in matrix]
    if form == "matrix":
        return _lines(rows)
    if form == "npy":
        stream = io.BytesIO()
        np.save(stream, matrix, allow_pickle=False)
        return stream.getvalue()
    if form == "json":
        named = {} if frames == UNNAMED else dict(zip(UNNAMED, frames, strict=True))
        return _json({"convention": CONVENTION, **named, "T_target_source": matrix.tolist()})
    if form == "pdal":
        return _json({"pipeline": [{"type": "filters.transformation", "matrix": " ".join(rows)}]})
    if form == "open3d":
        return _lines(["0 0 1", *rows])
    if form == "kitti":
        return _lines([" ".join(rows[:3])])
    if form == "tum":
        return _lines(
            [" ".join(["0", *(f"{v:.17g}" for v in (*matrix[:3, 3], *quaternion_of(matrix[:3, :3])))])]
        )
    if form == "ros":
        return _lines(_ros_lines(matrix, frames))
    raise OutputError(f"a transformation can't be written as '{form}'; use one of {', '.join(FORMS)}")


def _lines(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode("ascii")


def _json(content: dict[str, object]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode("ascii")


def _ros_lines(matrix: np.ndarray, frames: Frames) -> list[str]:
    """Return a TransformStamped: it takes points of the child's frame to the header's frame."""

    def vector(names: str, values: np.ndarray) -> list[str]:
        return [f"    {name}: {float(value)!r}" for name, value in zip(names, values)]

    # Only names that are no YAML of their own stand bare; our reader takes a # for a comment's.
    target, source = (
        frame if frame in (*UNNAMED, WORLD) else json.dumps(frame).replace("#", "\\u0023") for frame in frames
    )
    what = "" if frames == UNNAMED else f", target: {target}, source: {source}"
    lines = [f"# {CONVENTION}{what}", "header:", f"  frame_id: {target}", f"child_frame_id: {source}"]
    lines += ["transform:"]
    lines += ["  translation:", *vector("xyz", matrix[:3, 3])]
    return [*lines, "  rotation:", *vector("xyzw", quaternion_of(matrix[:3, :3]))]


def split_entry(path: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Split ``FILE#ENTRY`` into the file and the name of one of its transformations, or None.

    A file whose own name holds a ``#`` is taken as it is, if it exists.
    """
    whole = str(path)
    if os.path.exists(whole):
        return Path(whole), None
    for place in (i for i, letter in enumerate(whole) if letter == "#"):
        if os.path.isfile(whole[:place]):
            return Path(whole[:place]), whole[place + 1 :]
    return Path(whole), None


def read_transformation(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a rigid transformation, see ``read_with_frames``; returns its matrix alone."""
    return read_with_frames(path)[0]


def read_with_frames(path: str | os.PathLike[str]) -> tuple[np.ndarray, Frames]:
    """Read a rigid transformation in any of the forms; ``FILE#ENTRY`` names one of several.

    ``.npy`` is NumPy's, ``.json`` and ``.yaml`` are told by their keys, every other suffix is
    rows of numbers, told by their number and length.

    Returns:
        (4, 4) float64 with its rotation projected to the nearest exact one, unless it is one to 1e-12;
        and its frames: of a batch's model the world and the scan, else ``UNNAMED``.

    Raises:
        InputError: the file can't be read, holds no transformation or several, or what it holds
            is not rigid within 1e-3 (it scales, shears or mirrors).
    """
    file, entry = split_entry(path)
    if form_of(file) is None and os.path.isfile(file):
        poses = file.with_suffix(".json")
        table = f"; a batch's are named as in '{poses}#NAME'" if file.name.lower() == "poses.csv" else ""
        raise InputError(f"{file}: is no transformation file by its name; use {', '.join(SUFFIXES)}{table}")
    data = read_bytes(file)
    if len(data) > _LARGEST_FILE:
        raise InputError(f"{file}: is too large for a transformation; check what it is")
    try:
        entries = _entries(data, file.suffix.lower())
        name, matrix = _chosen(entries, entry, file)
        return _rigid(matrix), (WORLD, name) if isinstance(entries, PlacedScans) else UNNAMED
    except FormatError as error:
        # A file's own words may be quoted: one plain line, whatever they are.
        text = "".join(letter if letter.isprintable() else "?" for letter in str(error))
        raise InputError(f"{path}: {text}") from None


def _entries(data: bytes, suffix: str) -> Entries:
    """Return the transformations of a file by name, not yet checked for being rigid."""
    if suffix == ".npy":
        return _from_npy(data)
    if suffix == ".json":
        try:
            return entries_of_tree(json.loads(data))
        except RecursionError:
            raise FormatError("is not JSON (too many brackets); write it again") from None
        except ValueError as error:
            raise FormatError(f"is not JSON ({_one_line(error)}); write it again") from None
    if suffix in (".yaml", ".yml"):
        documents = [entries_of_tree(document) for document in parse_yaml(data)]
        if len(documents) == 1:
            return documents[0]
        several = [matrix for document in documents for _, matrix in document]
        return [(str(number), matrix) for number, matrix in enumerate(several, 1)]
    return entries_of_rows(data)


def _chosen(entries: Entries, wanted: str | None, file: Path) -> tuple[str, np.ndarray]:
    """Return the one transformation, or the one that was named, and its name."""
    if isinstance(entries, PlacedScans) and wanted in entries.left_out:
        raise FormatError(
            f"{wanted} was left out of the batch ({entries.left_out[wanted]}), so it has no pose"
        )
    if not entries:
        raise FormatError("holds no transformation; check what it is")
    if wanted is None:
        if len(entries) > 1:
            first, last = entries[0][0], entries[-1][0]
            poses = file.with_suffix(".json")
            # The rows of a batch have no names, its JSON has.
            table = file.name == "poses.txt" and poses.is_file()
            raise FormatError(
                f"holds {len(entries)} transformations ('{first}' to '{last}'); "
                f"name the one to take, as in '{file.name}#{first}'"
                + (f", or by its scan's name, as in '{poses}#NAME'" if table else "")
            )
        return entries[0]
    found = [one for one in entries if one[0] == wanted]
    if len(found) != 1:
        names = ", ".join(name for name, _ in entries[:6]) + (", ..." if len(entries) > 6 else "")
        what = "no entry" if not found else f"{len(found)} entries"
        raise FormatError(f"has {what} '{wanted}'; it holds {names or 'one transformation without a name'}")
    return found[0]


def _from_npy(data: bytes) -> Entries:
    stream = io.BytesIO(data)
    try:  # the header first: np.load would allocate whatever shape it promises
        version = np.lib.format.read_magic(stream)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(stream)
        several = len(shape) == 3 and shape[1:] == (4, 4) and 0 < shape[0] <= len(data)
        if (shape != (4, 4) and not several) or dtype.kind not in "fiu":
            raise FormatError(f"holds a {shape} array of {dtype}; a transformation is (4, 4) numbers")
        matrices = np.load(io.BytesIO(data), allow_pickle=False).astype(np.float64).reshape(-1, 4, 4)
    except FormatError:
        raise
    except Exception as error:  # NumPy's parser of headers raises whatever it meets
        raise FormatError(f"is not a NumPy array file ({_one_line(error)}); write it with np.save") from None
    if not several:
        return [("", matrices[0])]
    return [(str(number), matrix) for number, matrix in enumerate(matrices, 1)]


def _rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the nearest rigid transformation, or refuse what is not nearly one."""
    if not np.isfinite(matrix).all() or np.abs(matrix[3] - [0, 0, 0, 1]).max() > _TOLERANCE:
        raise FormatError("is no rigid transformation: the last row must be 0 0 0 1, and all numbers finite")
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max() if np.abs(rotation).max() <= 2 else np.inf
    if off > _TOLERANCE:
        raise FormatError("is no rigid transformation: it scales or shears; give a rotation and translation")
    if np.linalg.det(rotation) < 0:
        raise FormatError("is no rigid transformation: it mirrors; give a rotation and translation")
    if off > _EXACT:
        u, _, vt = np.linalg.svd(rotation)
        rotation = u @ vt
    rigid = np.eye(4)
    rigid[:3, :3] = rotation
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:80]
