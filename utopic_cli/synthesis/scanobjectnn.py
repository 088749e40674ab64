"""ScanObjectNN as point clouds: objects cut out of scans of rooms (Uy et al. 2019).

Of its HDF5 files this reads one, the test part: ``data`` (N, 2048, 3), ``label`` (N,) and ``mask``
(N, 2048), which says what is background and is not looked at. ``main_split/test_objectdataset.h5``
holds the 581 test objects as they were scanned, their surroundings included; the file of the same
name in ``main_split_nobg`` holds them cut out cleanly, those whose names go on in ``_augmented...``
were moved, turned and scaled.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.synthesis.hdf5_clouds import CloudSet, read_clouds
from utopic_cli.synthesis.surface import DegenerateShape, normalised

NAME = "test_objectdataset.h5"
FOLDERS = (".", "main_split", "h5_files/main_split")
_WHERE = (
    "it is part of h5_files.zip of ScanObjectNN, which its authors give on request at "
    "hkust-vgd.github.io/scanobjectnn"
)


def find_scanobjectnn(path: Path) -> Path:
    """Return the data set's test file: ``path`` itself, or in that folder.

    Raises:
        InputError: it is not there.
    """
    if path.is_file():
        return path
    for folder in FOLDERS:
        if (path / folder / NAME).is_file():
            return path / folder / NAME
    raise InputError(f"{path}: no {NAME} here, in main_split or in h5_files/main_split; {_WHERE}")


def read_scanobjectnn(file: Path) -> CloudSet:
    """Read the clouds, each centred and scaled to the unit sphere, all for testing.

    Raises:
        InputError: the file is damaged or of another form, or h5py is not installed.
    """
    clouds, labels = read_clouds(file, _WHERE)
    try:
        points = np.array([normalised(cloud.astype(np.float64)) for cloud in clouds], dtype=np.float32)
    except DegenerateShape as error:
        raise InputError(f"{file}: has a cloud that can't be used ({error}); download it again") from error
    return CloudSet(
        points,
        [f"{file.stem}/{row:04d}" for row in range(len(points))],
        ["test"] * len(points),
        [f"category {label}" for label in labels.tolist()],
    )
