"""HDF5 files of point clouds with labels, as classification data sets are distributed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError


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


def read_clouds(file: Path, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the clouds (N, S, 3) float32 and labels (N,) int64 of one file.

    Args:
        file: with the arrays ``data`` and ``label``.
        where: to get it, for messages.

    Raises:
        InputError: it is damaged or of another form, or h5py is not installed.
    """
    h5py = _load_h5py(file)
    try:
        with h5py.File(file, "r") as content:
            clouds = np.asarray(content["data"], dtype=np.float32)
            labels = np.asarray(content["label"]).reshape(-1).astype(np.int64)
    except KeyError as error:
        raise InputError(f"{file}: has no arrays 'data' and 'label'; {where}") from error
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{file}: can't be read as HDF5 ({error}); download it again") from error
    if clouds.ndim != 3 or clouds.shape[2] != 3 or len(labels) != len(clouds) or (labels < 0).any():
        raise InputError(f"{file}: 'data' is not (N, 2048, 3) with one 'label' each; {where}")
    return clouds, labels


def _load_h5py(file: Path) -> Any:
    try:
        import h5py
    except (ImportError, OSError) as error:
        raise InputError(
            f"{file}: is read with h5py, which can't be loaded ({error}); pip install h5py"
        ) from error
    return h5py
