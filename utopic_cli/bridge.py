"""Where NumPy becomes torch and back: sampled clouds in, what the network says of them out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import expit

from utopic_cli.errors import InputError
from utopic_cli.estimation.close_up import POINT_FEATURES, WHOLE_FEATURES, CloseUp
from utopic_cli.geometry import rigid
from utopic_cli.geometry.nearest import nearest, search_threads
from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.model.pose_verifier import PoseVerifier
from utopic_cli.model.uncertainty import normalise_uncertainty
from utopic_cli.model.utopic import EncodedCloud, Prediction, Utopic
from utopic_cli.model.weights import choose_device, load_weights
from utopic_cli.preprocess import PreparedPair, SampledCloud

Verify = Callable[[Sequence[CloseUp]], np.ndarray]
"""Says how plausible each pose is: log-odds (C,) float64."""


@dataclass(frozen=True)
class NetworkView:
    """What the network says about the sampled points of one pair, as float64 arrays.

    Attributes:
        matching_scores: (N, M) soft correspondences without slack.
        source_overlap: (N,), target_overlap: (M,) probabilities.
        source_uncertainty: (N,), target_uncertainty: (M,) min-max normalised over the pair.
        source_raw: (N,), target_raw: (M,) un-normalised.
        source_gap: (N,), target_gap: (M,) distances to the other cloud's nearest point under the
            transformation that the network was shown, in node spacings; None where it was shown none.
        verify: chooses among poses that follow from it; None where nothing has learned to.
    """

    matching_scores: np.ndarray
    source_overlap: np.ndarray
    target_overlap: np.ndarray
    source_uncertainty: np.ndarray
    target_uncertainty: np.ndarray
    source_raw: np.ndarray
    target_raw: np.ndarray
    source_gap: np.ndarray | None = None
    target_gap: np.ndarray | None = None
    verify: Verify | None = None


@lru_cache(maxsize=2)
def load_network(weights: str, device: str, verifier: bool = True) -> tuple[Utopic, dict[str, Any]]:
    """Load weights once a process: the network on its device, and its card.

    Args:
        weights: as of ``load_weights``.
        device: as of ``choose_device``.
        verifier: whether to load the verifier as well.

    Raises:
        InputError: the weights or the device can't be used.
    """
    model, card = load_weights(weights, verifier=verifier)
    read = {"point_features": POINT_FEATURES, "whole_features": WHOLE_FEATURES}
    if model.verifier is not None and not read.items() <= model.verifier.sizes.items():
        raise InputError(
            f"{card['name']}: the verifier reads other features than this version shows it; teach another "
            "with utopic teach"
        )
    return model.to(choose_device(device)), card


@contextmanager
def cpu_threads(count: int) -> Iterator[int]:
    """Give torch and searches ``count`` CPU threads for a while (0: what torch has); yields how many."""
    before = torch.get_num_threads()
    if count:
        torch.set_num_threads(count)
    try:
        with search_threads(torch.get_num_threads()):
            yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)


class Eye:
    """The network as one registration uses it: what depends on a single cloud is found once."""

    def __init__(self, model: Utopic, seed: int) -> None:
        """Take the network, and the seed of the overlap samples."""
        self.model = model
        self.seed = seed
        self._seen: list[tuple[SampledCloud, CloudInput, EncodedCloud]] = []

    def __call__(self, prepared: PreparedPair, hypothesis: np.ndarray | None = None) -> NetworkView:
        """Look at a prepared pair; see ``predict``."""
        device = next(self.model.parameters()).device
        with torch.inference_mode():
            source, encoded_source = self._encode(prepared.source, prepared.spacing)
            target, encoded_target = self._encode(prepared.target, prepared.spacing)
            prediction = self.model(
                source,
                target,
                generator=torch.Generator().manual_seed(self.seed),
                hypothesis=None
                if hypothesis is None
                else torch.from_numpy(hypothesis.astype(np.float32))[None].to(device),
                encoded=(encoded_source, encoded_target),
            )
        view = _as_view(prediction, self.model)
        if hypothesis is None:
            return view
        source_gap, target_gap = gaps(prepared, hypothesis)
        return replace(view, source_gap=source_gap, target_gap=target_gap)

    def _encode(self, cloud: SampledCloud, spacing: float) -> tuple[CloudInput, EncodedCloud]:
        for known, given, encoded in self._seen:
            if known is cloud:
                return given, encoded
        given = to_cloud_input(cloud, spacing, self.model.config.neighbours)
        given = given.to(next(self.model.parameters()).device)
        encoded = self.model.encode(given)
        self._seen.append((cloud, given, encoded))
        return given, encoded


def predict(
    model: Utopic, prepared: PreparedPair, seed: int, hypothesis: np.ndarray | None = None
) -> NetworkView:
    """Run the network on a prepared pair, on the device its weights are on.

    Args:
        model: the network.
        prepared: the pair.
        seed: seed of the overlap samples.
        hypothesis: (4, 4) transformation between the normalised clouds to judge the points by.
    """
    return Eye(model, seed)(prepared, hypothesis)


def gaps(prepared: PreparedPair, T_target_source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure how far each sampled point is from the other cloud's nearest, in node spacings.

    Args:
        prepared: the pair.
        T_target_source: (4, 4) between the normalised clouds.

    Returns:
        (N,) and (M,) float64.
    """
    moved = rigid.apply(T_target_source, prepared.source.points)
    there, _ = nearest(cKDTree(prepared.target.points), moved)
    back, _ = nearest(cKDTree(moved), prepared.target.points)
    return there / prepared.spacing, back / prepared.spacing


def weigh(model: Utopic, first: NetworkView, shown: NetworkView, odds: float) -> NetworkView:
    """Weigh what follows of each point if a transformation is right with what does if it is not.

    Overlap is read from where the scans meet under it. Uncertainty is the network's, shown the
    transformation, and what it was at first: a point without a counterpart under a wrong one is not certain.

    Args:
        model: the network; without a verifier ``shown`` is returned as it is.
        first: of the network at first sight.
        shown: of the network, shown the transformation.
        odds: log-odds that it is right.
    """
    verifier = model.verifier
    if verifier is None or shown.source_gap is None or shown.target_gap is None:
        return shown
    right = float(expit(odds))
    source_raw = right * shown.source_raw + (1.0 - right) * first.source_raw
    target_raw = right * shown.target_raw + (1.0 - right) * first.target_raw
    normalised = normalise_uncertainty(*(torch.from_numpy(raw)[None] for raw in (source_raw, target_raw)))
    return replace(
        shown,
        source_overlap=verifier.read_overlap(shown.source_gap, odds),
        target_overlap=verifier.read_overlap(shown.target_gap, odds),
        source_raw=source_raw,
        target_raw=target_raw,
        source_uncertainty=_array(normalised[0]),
        target_uncertainty=_array(normalised[1]),
    )


def verify(verifier: PoseVerifier, shown: Sequence[CloseUp]) -> np.ndarray:
    """Ask how plausible poses are, on the device the verifier is on -> (C,) float64 log-odds."""
    device = next(verifier.parameters()).device
    with torch.inference_mode():
        points = torch.from_numpy(np.stack([one.points for one in shown])).to(device)
        whole = torch.from_numpy(np.stack([one.whole for one in shown])).to(device)
        return verifier(points, whole).cpu().numpy().astype(np.float64)


def _as_view(prediction: Prediction, model: Utopic) -> NetworkView:
    source_overlap, target_overlap = prediction.source_overlap, prediction.target_overlap
    if not model.config.overlap:  # the variant without O weighs all correspondences alike
        source_overlap, target_overlap = torch.ones_like(source_overlap), torch.ones_like(target_overlap)
    return NetworkView(
        _array(prediction.matching_scores[:, :-1, :-1]),
        _array(source_overlap),
        _array(target_overlap),
        _array(prediction.source_uncertainty),
        _array(prediction.target_uncertainty),
        _array(prediction.source_distribution.raw_uncertainty),
        _array(prediction.target_distribution.raw_uncertainty),
        verify=None if model.verifier is None else partial(verify, model.verifier),
    )


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


def _array(batch: torch.Tensor) -> np.ndarray:
    """Return the only item of a batch as float64."""
    return batch[0].detach().cpu().numpy().astype(np.float64)
