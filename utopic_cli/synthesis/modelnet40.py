"""ModelNet40 as point clouds: the HDF5 files ``modelnet40_ply_hdf5_2048`` of the PointNet authors.

Splits follow the paper's unseen categories: of the 40 categories in order, the first 20 are
trained on (the training files' shapes) and validated on (the test files'), and the last 20 of
the test files are the test.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError

SEEN_CATEGORIES = 20
_WHERE = (
    "the data set is distributed by Stanford/ModelNet, as modelnet40_ply_hdf5_2048.zip by the authors "
    "of PointNet"
)


@dataclass(frozen=True)
class CloudSet:
    """Clouds that belong to a data set.

    Attributes:
        points: (N, S, 3) float32, in the data set's own frame and scale.
        names: of each, file and row.
        splits: ``train``, ``val`` or ``test``.
        categories: of each.
    """

    points: np.ndarray
    names: list[str]
    splits: list[str]
    categories: list[str]


def find_modelnet40(root: Path) -> list[Path]:
    """List the data set's files in a folder, or in the folder of its usual name in that.

    Raises:
        InputError: training or test files are missing.
    """
    inner = root / "modelnet40_ply_hdf5_2048"
    for folder in (root, inner):
        train, test = sorted(folder.glob("ply_data_train*.h5")), sorted(folder.glob("ply_data_test*.h5"))
        if train and test:
            names = folder / "shape_names.txt"
            return train + test + ([names] if names.is_file() else [])
    raise InputError(f"{root}: no ply_data_train*.h5 and ply_data_test*.h5 here; {_WHERE}")


def read_modelnet40(root: Path) -> CloudSet:
    """Read the clouds that training, validation and test use.

    Raises:
        InputError: files are missing or damaged, or h5py is not installed.
    """
    files = find_modelnet40(root)
    names_file = next((file for file in files if file.suffix == ".txt"), None)
    known = names_file.read_text(encoding="utf-8", errors="replace").split() if names_file else []
    points, names, splits, categories = [], [], [], []
    for file in files:
        if file.suffix != ".h5":
            continue
        clouds, labels = _read(file)
        testing = file.name.startswith("ply_data_test")
        seen = labels < SEEN_CATEGORIES
        rows = np.flatnonzero(seen | testing)
        points.append(clouds[rows])
        for row in rows:
            label = int(labels[row])
            names.append(f"{file.stem}/{row:04d}")
            splits.append(("val" if seen[row] else "test") if testing else "train")
            categories.append(known[label] if label < len(known) else f"category {label}")
    if len({cloud.shape[1] for cloud in points}) != 1:
        raise InputError(f"{root}: its files have clouds of different sizes; download them again")
    return CloudSet(np.concatenate(points), names, splits, categories)


def _read(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the clouds (N, S, 3) float32 and labels (N,) int64 of one file."""
    h5py = _load_h5py()
    try:
        with h5py.File(file, "r") as content:
            clouds = np.asarray(content["data"], dtype=np.float32)
            labels = np.asarray(content["label"]).reshape(-1).astype(np.int64)
    except KeyError as error:
        raise InputError(f"{file}: has no arrays 'data' and 'label'; {_WHERE}") from error
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{file}: can't be read as HDF5 ({error}); download it again") from error
    if clouds.ndim != 3 or clouds.shape[2] != 3 or len(labels) != len(clouds) or (labels < 0).any():
        raise InputError(f"{file}: 'data' is not (N, 2048, 3) with one 'label' each; {_WHERE}")
    return clouds, labels


def _load_h5py() -> Any:
    try:
        import h5py
    except (ImportError, OSError) as error:
        raise InputError(
            f"ModelNet40 is read with h5py, which can't be loaded ({error}); pip install h5py"
        ) from error
    return h5py
