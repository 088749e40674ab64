"""Where NumPy becomes torch: sampled clouds as network input."""

from __future__ import annotations

import numpy as np
import torch

from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.preprocess import SampledCloud


def to_cloud_input(cloud: SampledCloud, spacing: float, neighbours: int) -> CloudInput:
    """Return a sampled cloud as a batch of one.

    Args:
        cloud: in normalised units.
        spacing: node spacing h, same units.
        neighbours: k of the network's graph; clouds of fewer points repeat their farthest one.
    """
    index = cloud.neighbours[:, :neighbours]
    if index.shape[1] < neighbours:
        index = np.pad(index, ((0, 0), (0, neighbours - index.shape[1])), mode="edge")
    return CloudInput(
        points=_tensor(cloud.points),
        normals=_tensor(cloud.normals),
        spacing=torch.tensor([spacing], dtype=torch.float32),
        neighbours=torch.from_numpy(index.astype(np.int64))[None],
        patches=tuple(_tensor(patch) for patch in cloud.patches),
        patch_masks=tuple(torch.from_numpy(mask)[None] for mask in cloud.patch_masks),
    )


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))[None]
