"""The shapes that a name or a folder stands for, packed once and kept in a cache."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.synthesis.hdf5_clouds import CloudSet
from utopic_cli.synthesis.mesh_form import PackedMesh, packed_mesh
from utopic_cli.synthesis.modelnet40 import find_modelnet40, read_modelnet40
from utopic_cli.synthesis.reconstruction import mesh_from_points
from utopic_cli.synthesis.scanobjectnn import find_scanobjectnn, read_scanobjectnn
from utopic_cli.synthesis.shape_cache import cached
from utopic_cli.synthesis.shape_files import (
    CLOUD_SUFFIXES,
    MESH_SUFFIXES,
    NO_SHAPE,
    find_shape_files,
    read_shape,
)
from utopic_cli.synthesis.shapes import ShapeLibrary, load_shapes, packed_files, procedural_shapes
from utopic_cli.synthesis.surface import DegenerateShape

PROCEDURAL = "procedural"
PROCEDURAL_SHAPES = 200
PROCEDURAL_RESOLUTION = 40  # 200 shapes take some ten seconds
PROCEDURAL_SEED = 20221015  # another stream than any training seed; the shapes are always the same
MODELNET40 = "modelnet40:"
SCANOBJECTNN = "scanobjectnn:"

Progress = Callable[[int, int, str], None]
Item = TypeVar("Item")
_POOL_FROM = 100  # fewer shapes are not worth starting processes for
_VALIDATION_SHARE = 10  # one shape of so many, by its name


def open_shapes(data: str, *, progress: Progress | None = None) -> ShapeLibrary:
    """Return the shapes that ``data`` stands for.

    - ``procedural``: 200 shapes made on the spot, always the same.
    - ``DIR`` with ``.npz`` files (or ``DIR/meshes``): packed meshes, see ``load_shapes``.
    - any other ``DIR``: the meshes and clouds below it, one shape a file. They are packed once,
      into the user's cache, and read from there until a file is added, changed or taken away.
      The folder itself is never written to. A subfolder of ``DIR`` is one set; a shape is for
      validation if the SHA-1 of its set, folder and stem says so, about one in ten.
    - ``modelnet40:DIR``: the HDF5 files of ``modelnet40_ply_hdf5_2048``, see ``modelnet40``;
      packed and cached likewise, the original points kept as ``samples``.
    - ``scanobjectnn:PATH``: the HDF5 test file of ScanObjectNN, or a folder with it, see
      ``scanobjectnn``; packed and cached in the same way.

    Args:
        data: as above.
        progress: told (shapes done, of, name of the last) while shapes are packed.

    Returns:
        The library; its ``skipped`` names what could not be used.

    Raises:
        InputError: nothing usable is there.
        OutputError: the cache can't be written.
    """
    if data == PROCEDURAL:
        rng = np.random.default_rng(PROCEDURAL_SEED)
        return procedural_shapes(rng, PROCEDURAL_SHAPES, PROCEDURAL_RESOLUTION)
    if not data.removeprefix(MODELNET40).removeprefix(SCANOBJECTNN):
        raise InputError(f"'{data}': no such folder of shapes; name one, or '{PROCEDURAL}'")
    if data.startswith(MODELNET40):
        root = _folder(data.removeprefix(MODELNET40))
        parts = find_modelnet40(root)
        return cached(root, MODELNET40, parts, lambda: _pack_clouds(root, read_modelnet40(root), progress))
    if data.startswith(SCANOBJECTNN):
        file = find_scanobjectnn(Path(data.removeprefix(SCANOBJECTNN)))
        kind = SCANOBJECTNN + file.name  # several such files may lie in one folder
        return cached(
            file.parent, kind, [file], lambda: _pack_clouds(file.parent, read_scanobjectnn(file), progress)
        )
    if Path(data).is_file() and Path(data).suffix.lower() != ".npz":
        raise InputError(f"{data}: is a file; name the folder of shapes, or packed meshes (.npz)")
    if packed_files(Path(data)):
        return load_shapes(data)
    root = _folder(data)
    files = find_shape_files(root)
    if not files:
        raise InputError(
            f"{root}: no shapes here or below: neither packed meshes (.npz) nor files ending in "
            f"{' '.join(MESH_SUFFIXES + CLOUD_SUFFIXES)}; download some (Objaverse, Thingi10K, ModelNet), "
            f"or use '{PROCEDURAL}'"
        )
    return cached(root, "files", files, lambda: _pack_files(root, files, progress))


def describe_data(data: str) -> str:
    """Say in words what shapes ``data`` stands for."""
    if data == PROCEDURAL:
        return "built-in procedural shapes"
    for prefix, name in ((MODELNET40, "ModelNet40"), (SCANOBJECTNN, "ScanObjectNN")):
        if data.startswith(prefix):
            return f"{name} in {data.removeprefix(prefix)}"
    return data


def describe_skipped(library: ShapeLibrary, most: int = 3) -> str | None:
    """Return which shapes were skipped and why as one line, or None if all were used.

    Text that is no shape at all (``NO_SHAPE``) is only counted, and deserves no line of its own.
    """
    shapes = [(name, reason) for name, reason in library.skipped if reason != NO_SHAPE]
    count, others = len(shapes), len(library.skipped) - len(shapes)
    if not count:
        return None
    named = "; ".join(f"{name}: {reason}" for name, reason in shapes[:most])
    rest = f"; and {count - most} more" if count > most else ""
    notes = f"; text files left out: {others}" if others else ""
    return f"skipped {count} shape{'s' if count > 1 else ''}: {named}{rest}{notes}"


def _folder(name: str) -> Path:
    root = Path(name)
    if not root.is_dir():
        raise InputError(f"{name}: no such folder of shapes; check the path")
    return root


# What is packed ----------------------------------------------------------------------------


def _pack_files(root: Path, files: Sequence[Path], progress: Progress | None) -> dict[str, np.ndarray]:
    names = [_plain(file.relative_to(root)) for file in files]
    outcomes = _each(_mesh_of_file, files, names, progress)
    kept, skipped = _sorted_out(names, outcomes)
    if not kept:
        name, reason = skipped[0]
        raise InputError(f"{root}: none of its {len(names)} shapes can be used; the first, {name}: {reason}")
    top = _plain(Path(root.resolve().name))
    sets = [names[i].split("/")[0] if "/" in names[i] else top for i in kept]
    keys = []
    for i, shape_set in zip(kept, sets):
        folder, _, file = names[i].rpartition("/")
        inner = folder.removeprefix(shape_set).strip("/") if "/" in names[i] else ""
        keys.append(f"{shape_set}/{inner}/{os.path.splitext(file)[0]}".lower())
    return _arrays(
        [outcomes[i] for i in kept],  # type: ignore[misc]
        [names[i] for i in kept],
        _splits(keys),
        sets,
        skipped,
    )


def _pack_clouds(root: Path, clouds: CloudSet, progress: Progress | None) -> dict[str, np.ndarray]:
    outcomes = _each(_mesh_of_points, clouds.points, clouds.names, progress)
    kept, skipped = _sorted_out(clouds.names, outcomes)
    if not kept:
        raise InputError(f"{root}: none of its {len(outcomes)} clouds can be used; {skipped[0][1]}")
    arrays = _arrays(
        [outcomes[i] for i in kept],  # type: ignore[misc]
        [clouds.names[i] for i in kept],
        [clouds.splits[i] for i in kept],
        [clouds.categories[i] for i in kept],
        skipped,
    )
    return arrays | {"samples": clouds.points[kept].astype(np.float16)}


def _sorted_out(
    names: Sequence[str], outcomes: Sequence[PackedMesh | str]
) -> tuple[list[int], list[tuple[str, str]]]:
    """Return the numbers of the shapes that can be used, and (name, reason) of the others."""
    kept = [i for i, outcome in enumerate(outcomes) if not isinstance(outcome, str)]
    return kept, [(name, outcome) for name, outcome in zip(names, outcomes) if isinstance(outcome, str)]


def _splits(keys: Sequence[str]) -> list[str]:
    """Split by the hash of each key; of two shapes or more, each split has one at least."""
    hashes = [int(hashlib.sha1(key.encode()).hexdigest()[:8], 16) for key in keys]
    splits = ["val" if number % _VALIDATION_SHARE == 0 else "train" for number in hashes]
    for missing in {"train", "val"} - set(splits) if len(keys) > 1 else ():
        splits[int(np.argmin(hashes))] = missing
    return splits


def _arrays(
    meshes: Sequence[PackedMesh],
    names: Sequence[str],
    splits: Sequence[str],
    sets: Sequence[str],
    skipped: Sequence[tuple[str, str]],
) -> dict[str, np.ndarray]:
    """Lay meshes one after the other, as ``load_shapes`` reads them."""
    return {
        "vertices": np.concatenate([mesh.vertices for mesh in meshes]),
        "faces": np.concatenate([mesh.faces for mesh in meshes]),
        "vertex_start": np.cumsum([0] + [len(mesh.vertices) for mesh in meshes], dtype=np.int64),
        "face_start": np.cumsum([0] + [len(mesh.faces) for mesh in meshes], dtype=np.int64),
        "names": np.array(names),
        "split": np.array(splits),
        "sets": np.array(sets),
        "decimated": np.array([mesh.decimated for mesh in meshes]),
        "skipped": np.array(skipped, dtype=np.str_).reshape(-1, 2),
    }


def _plain(path: Path) -> str:
    """Return a path as printable text with forward slashes, whatever bytes its name has."""
    text = os.fsencode(path.as_posix()).decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


# One shape each ----------------------------------------------------------------------------


def _mesh_of_file(path: Path) -> PackedMesh | str:
    try:
        return packed_mesh(*read_shape(path))
    except DegenerateShape as error:
        return str(error)


def _mesh_of_points(points: np.ndarray) -> PackedMesh | str:
    if not np.isfinite(points).all():
        return "has points that are NaN or infinite"
    try:
        return packed_mesh(*mesh_from_points(points))
    except DegenerateShape as error:
        return str(error)


def _each(
    work: Callable[[Item], PackedMesh | str],
    items: Sequence[Item] | np.ndarray,
    names: Sequence[str],
    progress: Progress | None,
) -> list[PackedMesh | str]:
    """Do the work for every item, in several processes where there are many."""
    outcomes: list[PackedMesh | str] = []
    processes = min(os.cpu_count() or 1, 16) if len(items) >= _POOL_FROM else 1
    with contextlib.ExitStack() as stack:
        results: Iterable[PackedMesh | str] = map(work, items)
        if processes > 1:
            # Not forked: the parent may hold the threads of torch.
            pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
            stack.callback(pool.shutdown, wait=True, cancel_futures=True)
            results = pool.map(work, items, chunksize=8)
        try:
            for name, outcome in zip(names, results):
                outcomes.append(outcome)
                if progress is not None:
                    progress(len(outcomes), len(items), name)
        except BrokenProcessPool as error:
            raise InputError(
                f"a process that packs shapes was killed near {names[len(outcomes)]}, for lack of memory "
                "perhaps; take that file away, or free some memory"
            ) from error
    return outcomes
