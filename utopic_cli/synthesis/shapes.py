"""Libraries of triangle meshes: read from packed files, or procedural."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.synthesis.procedural import procedural_mesh

ARRAYS = ("vertices", "faces", "vertex_start", "face_start", "names", "split")
MORE_ARRAYS = ("sets", "samples", "skipped")


@dataclass(frozen=True)
class ShapeLibrary:
    """Triangle meshes, packed one after the other.

    Attributes:
        vertices: (V, 3) of all meshes.
        faces: (F, 3) vertex numbers within each mesh.
        vertex_start: (N + 1,) int64, mesh i has vertices[vertex_start[i] : vertex_start[i + 1]].
        face_start: (N + 1,) int64, likewise for faces.
        names: (N,) str.
        splits: (N,) str, ``train``, ``val`` or (ModelNet40 only) ``test``.
        sets: (N,) str, the collection each mesh comes from.
        samples: (N, S, 3) float16, the points that each mesh was reconstructed from, in the
            frame of its vertices, where a data set gives points; None for meshes.
        skipped: (name, reason) of each shape that was there but could not be used.
    """

    vertices: np.ndarray
    faces: np.ndarray
    vertex_start: np.ndarray
    face_start: np.ndarray
    names: np.ndarray
    splits: np.ndarray
    sets: np.ndarray
    samples: np.ndarray | None = None
    skipped: tuple[tuple[str, str], ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    def mesh(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (V, 3) float64 and faces (F, 3) int64 of one mesh."""
        vertices = self.vertices[self.vertex_start[number] : self.vertex_start[number + 1]]
        faces = self.faces[self.face_start[number] : self.face_start[number + 1]]
        return vertices.astype(np.float64), faces.astype(np.int64)

    def select(self, split: str) -> ShapeLibrary:
        """Return the meshes of one split.

        Raises:
            InputError: there are none.
        """
        chosen = np.flatnonzero(self.splits == split)
        if len(chosen) == 0:
            known = ", ".join(sorted(set(self.splits.tolist())))
            raise InputError(f"the shape library has no '{split}' shapes; its splits: {known or 'none'}")
        meshes = [self.mesh(int(i)) for i in chosen]
        packed = pack(meshes, self.names[chosen], self.splits[chosen], self.sets[chosen])
        samples = None if self.samples is None else self.samples[chosen]
        return replace(packed, samples=samples, skipped=self.skipped)

    def draw(self, rng: np.random.Generator) -> int:
        """Draw a mesh number: a set by the square root of its size, then any mesh of it.

        So large sets of similar shapes don't drown the small ones.
        """
        sets, counts = np.unique(self.sets, return_counts=True)
        weight = np.sqrt(counts)
        chosen = sets[rng.choice(len(sets), p=weight / weight.sum())]
        return int(rng.choice(np.flatnonzero(self.sets == chosen)))


def pack(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]],
    names: Sequence[str] | np.ndarray,
    splits: Sequence[str] | np.ndarray,
    sets: Sequence[str] | np.ndarray,
) -> ShapeLibrary:
    """Build a library from single meshes (vertices (V, 3), faces (F, 3))."""
    return ShapeLibrary(
        np.concatenate([vertices for vertices, _ in meshes]).astype(np.float32),
        np.concatenate([faces for _, faces in meshes]).astype(np.int32),
        np.cumsum([0] + [len(vertices) for vertices, _ in meshes]),
        np.cumsum([0] + [len(faces) for _, faces in meshes]),
        np.asarray(names),
        np.asarray(splits),
        np.asarray(sets),
    )


def procedural_shapes(rng: np.random.Generator, count: int, resolution: int = 48) -> ShapeLibrary:
    """Make ``count`` procedural meshes; every tenth is for validation.

    Args:
        rng: source of randomness.
        count: number of meshes.
        resolution: grid nodes along each side of a mesh.
    """
    meshes = [procedural_mesh(rng, resolution) for _ in range(count)]
    return pack(
        meshes,
        [f"procedural/{i:05d}" for i in range(count)],
        ["val" if i % 10 == 9 else "train" for i in range(count)],
        ["procedural"] * count,
    )


def load_shapes(path: str | Path) -> ShapeLibrary:
    """Read packed meshes.

    Each ``.npz`` holds one set: vertices (V, 3), faces (F, 3) numbered within each mesh,
    vertex_start and face_start (N + 1), names and split (N). It may also hold sets (N), where
    it has several, samples (N, S, 3), and skipped (K, 2) names and reasons.

    Args:
        path: a ``.npz`` file, a folder of them, or a folder whose ``meshes`` holds them.

    Raises:
        InputError: nothing there, or a file is not of this form.
    """
    files = packed_files(Path(path))
    if not files:
        raise InputError(f"{path}: no .npz file of packed meshes here")
    loaded = [_read(file) for file in files]
    samples = [one["samples"] for one in loaded if "samples" in one]
    skipped = [tuple(row) for one in loaded for row in one.get("skipped", np.empty((0, 2))).tolist()]
    return ShapeLibrary(
        np.concatenate([one["vertices"] for one in loaded]),
        np.concatenate([one["faces"] for one in loaded]),
        _joined_starts([one["vertex_start"] for one in loaded]),
        _joined_starts([one["face_start"] for one in loaded]),
        np.concatenate([one["names"] for one in loaded]),
        np.concatenate([one["split"] for one in loaded]),
        np.concatenate([one["sets"] for one in loaded]),
        np.concatenate(samples) if len(samples) == len(loaded) else None,
        tuple(skipped),
    )


def packed_files(root: Path) -> list[Path]:
    """List the ``.npz`` files that ``load_shapes`` reads for a file or folder; may be none."""
    if root.is_file():
        return [root]
    return sorted((root / "meshes").glob("*.npz")) or sorted(root.glob("*.npz"))


def _read(file: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(file, allow_pickle=False) as packed:
            missing = [name for name in ARRAYS if name not in packed]
            if missing:
                raise InputError(f"{file}: not packed meshes: no array {', '.join(missing)}")
            arrays = {name: packed[name] for name in (*ARRAYS, *MORE_ARRAYS) if name in packed}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{file}: can't be read as packed meshes: {error}") from error
    arrays.setdefault("sets", np.full(len(arrays["names"]), file.stem))
    _check(file, arrays)
    return arrays


def _check(file: Path, arrays: dict[str, np.ndarray]) -> None:
    vertices, faces = arrays["vertices"], arrays["faces"]
    count = len(arrays["names"])
    starts_fit = all(
        len(starts) == count + 1 and starts[0] == 0 and starts[-1] == total and (np.diff(starts) > 0).all()
        for starts, total in ((arrays["vertex_start"], len(vertices)), (arrays["face_start"], len(faces)))
    )
    shapes_fit = (
        vertices.shape[1:] == (3,)
        and faces.shape[1:] == (3,)
        and all(len(arrays[name]) == count for name in ("split", "sets", "samples") if name in arrays)
    )
    if not (starts_fit and shapes_fit):
        raise InputError(f"{file}: the packed meshes' arrays don't fit together")
    if not np.isfinite(vertices).all():
        raise InputError(f"{file}: vertices are not all finite")
    largest = np.maximum.reduceat(faces.max(axis=1), arrays["face_start"][:-1])
    smallest = np.minimum.reduceat(faces.min(axis=1), arrays["face_start"][:-1])
    if (largest.astype(np.int64) >= np.diff(arrays["vertex_start"])).any() or (smallest < 0).any():
        raise InputError(f"{file}: a face names a vertex its mesh doesn't have")


def _joined_starts(parts: list[np.ndarray]) -> np.ndarray:
    lengths = np.concatenate([np.diff(part.astype(np.int64)) for part in parts])
    return np.concatenate([[0], np.cumsum(lengths)])
