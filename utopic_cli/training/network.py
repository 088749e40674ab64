"""The training network: the inference network and what is thrown away after training."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from utopic_cli.config import ModelConfig
from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.model.utopic import Prediction, Utopic
from utopic_cli.training.completion import CompletionDecoder, canonical_frame
from utopic_cli.training.labels import Labels, label_pair
from utopic_cli.training.losses import (
    chamfer_loss,
    descriptor_loss,
    overlap_loss,
    registration_loss,
    reliability_loss,
    uncertainty_loss,
)

RIGHT_WITHIN = 4.0
"""Node spacings: a transformation is as good as right if it puts half of the points so near their place."""


class TrainingPair(NamedTuple):
    """A batch of pairs with known answers, in normalised units.

    Attributes:
        source: (B, N) points each.
        target: (B, M) points each.
        gt_T_target_source: (B, 4, 4) float32 between the normalised clouds.
        hypothesis: (B, 4, 4) transformation under test: right, nearly right or wrong.
        hypothesis_present: (B,) 1 where the network is shown it, else 0.
    """

    source: CloudInput
    target: CloudInput
    gt_T_target_source: Tensor
    hypothesis: Tensor
    hypothesis_present: Tensor


class LossWeights(NamedTuple):
    """Weights of the loss terms; the paper's are 1 except those it does not have.

    It has no ``descriptor``, no ``coarse`` and no ``reliability``.
    """

    descriptor: float
    registration: float
    coarse: float
    overlap: float
    uncertainty: float
    reliability: float
    completion: float


class TrainingNetwork(nn.Module):
    """Wraps ``Utopic`` with the descriptor temperature, the completion decoder and the losses."""

    def __init__(
        self, config: ModelConfig, correspondence_radius: float = 0.0, completion_points: int = 128
    ) -> None:
        """Build with random weights; see ``LossSettings`` for the radius and the points."""
        super().__init__()
        self.correspondence_radius = correspondence_radius
        self.inference = Utopic(config)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(13.0)))
        self.completion = CompletionDecoder(config.feature_width, completion_points)
        self.in_canonical_frame = config.input_features == "invariant"

    def label(self, pair: TrainingPair) -> Labels:
        """Label a batch of pairs."""
        return label_pair(pair.source, pair.target, pair.gt_T_target_source, self.correspondence_radius)

    def descriptor_stage(self, pair: TrainingPair) -> dict[str, Tensor]:
        """First stage: the extractor alone, by its descriptors. Returns loss terms."""
        labels = self.label(pair)
        _, source = self.inference.extractor(pair.source)
        _, target = self.inference.extractor(pair.target)
        similarity = source @ target.transpose(1, 2)
        return {"descriptor": descriptor_loss(similarity, self.log_temperature.exp(), labels)}

    def joint_stage(
        self, pair: TrainingPair, generator: torch.Generator, masking: bool, completion: bool
    ) -> dict[str, Tensor]:
        """Second stage: the whole network. Returns loss terms, not yet weighted."""
        labels = self.label(pair)
        prediction = self.inference(
            pair.source,
            pair.target,
            generator=generator,
            masking=masking,
            hypothesis=pair.hypothesis,
            hypothesis_present=pair.hypothesis_present,
        )
        temperature = self.log_temperature.exp()
        terms = {
            "descriptor": descriptor_loss(prediction.descriptor_similarity, temperature, labels),
            "registration": registration_loss(prediction.matching_scores, labels),
            "coarse": registration_loss(prediction.coarse_scores, labels),
            "overlap": overlap_loss(
                prediction.source_overlap_logits, prediction.target_overlap_logits, labels
            ),
            "uncertainty": uncertainty_loss(
                prediction.source_distribution, labels.source_overlap, labels.source_valid
            )
            + uncertainty_loss(prediction.target_distribution, labels.target_overlap, labels.target_valid),
        }
        if self.inference.config.uncertainty_scheme != "none":
            terms["reliability"] = self._reliability_loss(prediction, labels, shown_right(pair))
        if completion:
            terms["completion"] = self._completion_loss(
                pair, labels, prediction.source_features, forward=True
            ) + self._completion_loss(pair, labels, prediction.target_features, forward=False)
        return terms

    @staticmethod
    def _reliability_loss(prediction: Prediction, labels: Labels, shown: Tensor) -> Tensor:
        """Of both clouds, by the correspondences that are found from the features that tell it."""
        scores = prediction.coarse_scores[:, :-1, :-1]
        real = (labels.source_valid[:, :, None] * labels.target_valid[:, None]) > 0
        near = real & ((labels.correspondences > 0) | labels.ignored)
        return 0.5 * (
            reliability_loss(
                prediction.source_distribution,
                scores,
                near,
                labels.source_overlap,
                labels.source_valid,
                shown,
            )
            + reliability_loss(
                prediction.target_distribution,
                scores.transpose(1, 2),
                near.transpose(1, 2),
                labels.target_overlap,
                labels.target_valid,
                shown,
            )
        )

    def _completion_loss(
        self, pair: TrainingPair, labels: Labels, features: Tensor, *, forward: bool
    ) -> Tensor:
        """Chamfer loss of one cloud's completion against the union of both scans in its frame."""
        own, other = (pair.source, pair.target) if forward else (pair.target, pair.source)
        valid = (labels.source_valid, labels.target_valid)
        own_valid, other_valid = valid if forward else valid[::-1]
        rotation = pair.gt_T_target_source[:, :3, :3]
        translation = pair.gt_T_target_source[:, None, :3, 3]
        if forward:
            moved = (other.points - translation) @ rotation
        else:
            moved = other.points @ rotation.transpose(1, 2) + translation
        whole = torch.cat([own.points, moved], dim=1)
        if self.in_canonical_frame:
            centre, axes = canonical_frame(own.points, own_valid)
            whole = (whole - centre) @ axes
        coarse, fine = self.completion(features, own.valid)
        both = torch.cat([own_valid, other_valid], dim=1)
        return chamfer_loss(coarse.float(), whole, both) + chamfer_loss(fine.float(), whole, both)


def total_loss(terms: dict[str, Tensor], weights: LossWeights) -> Tensor:
    """Weigh and add the loss terms that are present."""
    weighed = weights._asdict()
    return torch.stack([weighed[name] * term for name, term in terms.items()]).sum()


def shown_right(pair: TrainingPair) -> Tensor:
    """Tell which pairs are shown the right transformation, or one that is off by little -> (B,) in {0, 1}."""
    offset = pair.hypothesis - pair.gt_T_target_source  # (B, 4, 4)
    shifts = pair.source.points @ offset[:, :3, :3].transpose(1, 2) + offset[:, None, :3, 3]
    near = shifts.norm(dim=2).median(dim=1).values < RIGHT_WITHIN * pair.source.spacing
    return pair.hypothesis_present * near
