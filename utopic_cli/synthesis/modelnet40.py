"""ModelNet40 as point clouds: the HDF5 files ``modelnet40_ply_hdf5_2048`` of the PointNet authors.

Splits follow the paper's unseen categories: of the 40 categories in order, the first 20 are
trained on (the training files' shapes) and validated on (the test files'), and the last 20 of
the test files are the test.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.synthesis.hdf5_clouds import CloudSet, read_clouds

SEEN_CATEGORIES = 20
_WHERE = (
    "the data set is distributed by Stanford/ModelNet, as modelnet40_ply_hdf5_2048.zip by the authors "
    "of PointNet"
)


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
        clouds, labels = read_clouds(file, _WHERE)
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
