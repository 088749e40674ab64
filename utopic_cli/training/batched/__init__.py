"""Training pairs synthesised in batches on the training device.

What ``synthesis`` and ``preprocess`` do for one pair in NumPy, these modules do for a batch in
torch, with the same settings and the same distributions: a GPU would starve on pairs made one at
a time. ``meshes`` holds the shapes, ``surface`` samples and warps them, ``scanner``,
``range_pairs`` and ``surface_pairs`` make raw pairs, ``sampling`` (with ``voxels`` and
``normals``) what the network sees of them, ``hypotheses`` what it is shown, and ``pairs`` whole
batches.
"""

from utopic_cli.training.batched.pairs import BatchedPairs, batches_on_device

__all__ = ["BatchedPairs", "batches_on_device"]
