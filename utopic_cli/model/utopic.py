"""UTOPIC, in the paper's order: features, uncertainty-aware enhancement, overlap-guided matching."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from utopic_cli.config import ModelConfig
from utopic_cli.model.attention import GeometryTransformer
from utopic_cli.model.cloud_input import CloudInput
from utopic_cli.model.feature_extractor import FeatureExtractor
from utopic_cli.model.geometric_embedding import geometric_embedding
from utopic_cli.model.hypothesis import HYPOTHESIS_FEATURES, hypothesis_features, inverse
from utopic_cli.model.matching import AffinityMatching
from utopic_cli.model.overlap_head import OverlapHead
from utopic_cli.model.pose_verifier import PoseVerifier
from utopic_cli.model.uncertainty import (
    OverlapDistribution,
    UncertaintyQuantification,
    UncertaintyWeighting,
    normalise_uncertainty,
)


class EncodedCloud(NamedTuple):
    """What the network finds in a cloud of N points whatever it is aligned with.

    Attributes:
        features: (B, N, V) extractor features F.
        descriptors: (B, N, D) unit descriptors.
    """

    features: Tensor
    descriptors: Tensor


class Prediction(NamedTuple):
    """Everything the network says about a batch of pairs of N and M points.

    Attributes:
        source_features: (B, N, V) extractor features F.
        target_features: (B, M, V).
        descriptor_similarity: (B, N, M) cosine of the unit descriptors.
        coarse_scores: (B, N + 1, M + 1) first soft correspondences, slack last.
        matching_scores: (B, N + 1, M + 1) final soft correspondences, slack last.
        source_distribution: overlap distribution after the first transformer.
        target_distribution: likewise.
        source_uncertainty: (B, N) min-max normalised over the pair.
        target_uncertainty: (B, M).
        source_overlap_logits: (B, N).
        target_overlap_logits: (B, M).
    """

    source_features: Tensor
    target_features: Tensor
    descriptor_similarity: Tensor
    coarse_scores: Tensor
    matching_scores: Tensor
    source_distribution: OverlapDistribution
    target_distribution: OverlapDistribution
    source_uncertainty: Tensor
    target_uncertainty: Tensor
    source_overlap_logits: Tensor
    target_overlap_logits: Tensor

    @property
    def source_overlap(self) -> Tensor:
        """(B, N) overlap probabilities."""
        return torch.sigmoid(self.source_overlap_logits)

    @property
    def target_overlap(self) -> Tensor:
        """(B, M) overlap probabilities."""
        return torch.sigmoid(self.target_overlap_logits)


class Utopic(nn.Module):
    """The inference network. Training wraps it and adds what only training needs.

    Attributes:
        config: its architecture.
        verifier: what chooses among poses; None until one has learned to (see ``teach_verifier``).
    """

    verifier: PoseVerifier | None

    def __init__(self, config: ModelConfig) -> None:
        """Build with random weights; ``weights.load_weights`` builds a trained one."""
        super().__init__()
        self.config = config
        self.verifier = None
        width = config.feature_width
        self.extractor = FeatureExtractor(config)
        self.first_transformer = GeometryTransformer(config)
        self.first_matching = AffinityMatching(width, config.sinkhorn_iterations, config.descriptor_skip)
        self.quantification = UncertaintyQuantification(
            width,
            config.uncertainty_scheme,
            config.uncertainty_samples,
            HYPOTHESIS_FEATURES if config.hypothesis else 0,
        )
        self.weighting = UncertaintyWeighting(width)
        self.second_transformer = GeometryTransformer(config)
        self.second_matching = AffinityMatching(width, config.sinkhorn_iterations, config.descriptor_skip)
        self.overlap_head = OverlapHead(width)
        if config.hypothesis:
            self.hypothesis = nn.Linear(HYPOTHESIS_FEATURES, width, bias=False)
            nn.init.zeros_(self.hypothesis.weight)

    def encode(self, cloud: CloudInput) -> EncodedCloud:
        """Find what depends on one cloud alone and takes little memory to keep."""
        return EncodedCloud(*self.extractor(cloud))

    def forward(
        self,
        source: CloudInput,
        target: CloudInput,
        *,
        generator: torch.Generator,
        masking: bool = False,
        hypothesis: Tensor | None = None,
        hypothesis_present: Tensor | None = None,
        encoded: tuple[EncodedCloud, EncodedCloud] | None = None,
    ) -> Prediction:
        """Predict correspondences, overlap and uncertainty.

        Args:
            source: clouds of N points.
            target: clouds of M points; N and M may differ.
            generator: CPU generator of the overlap samples and of random masking.
            masking: drop features at random in proportion to uncertainty (training only).
            hypothesis: (B, 4, 4) T_target_source under test, in normalised units, or None.
            hypothesis_present: (B,) 1 or 0 for each pair; all 1 if None.
            encoded: of source and target, where it is known already.
        """
        if encoded is None:
            encoded = self.encode(source), self.encode(target)
        (source_features, source_descriptors), (target_features, target_descriptors) = encoded
        similarity = source_descriptors @ target_descriptors.transpose(1, 2)

        source_embedding = target_embedding = None
        if self.config.positional_scheme == "geometric":
            source_embedding = geometric_embedding(source.points, source.neighbours)
            target_embedding = geometric_embedding(target.points, target.neighbours)
        where = (
            source.points,
            target.points,
            source_embedding,
            target_embedding,
            source.valid,
            target.valid,
        )
        valid = real = None
        if source.valid is not None or target.valid is not None:
            masks = [
                torch.ones_like(cloud.points[..., 0], dtype=torch.bool)
                if cloud.valid is None
                else cloud.valid
                for cloud in (source, target)
            ]
            valid = torch.cat(masks, dim=1)
            real = masks[0][:, :, None] & masks[1][:, None]

        source_known, target_known = source_features, target_features
        source_evidence = target_evidence = None
        if hypothesis is not None and self.config.hypothesis:
            if hypothesis_present is None:
                hypothesis_present = torch.ones(len(hypothesis), device=hypothesis.device)
            source_evidence = hypothesis_features(source, target, hypothesis, hypothesis_present)
            target_evidence = hypothesis_features(target, source, inverse(hypothesis), hypothesis_present)
            source_known = source_features + self.hypothesis(source_evidence)
            target_known = target_features + self.hypothesis(target_evidence)
        source_hybrid, target_hybrid = self.first_transformer(source_known, target_known, *where)
        coarse = self.first_matching(source_hybrid, target_hybrid, similarity, real)
        scores = coarse[:, :-1, :-1]
        source_distribution = self.quantification(
            source_hybrid, scores.max(dim=2).values, generator, source_evidence
        )
        target_distribution = self.quantification(
            target_hybrid, scores.max(dim=1).values, generator, target_evidence
        )
        source_uncertainty, target_uncertainty = normalise_uncertainty(
            source_distribution.raw_uncertainty, target_distribution.raw_uncertainty, valid
        )

        weighs = self.config.uncertainty_scheme != "none"
        source_keep = target_keep = None
        if masking and weighs:
            source_keep = source_uncertainty <= _uniform(source_uncertainty, generator)
            target_keep = target_uncertainty <= _uniform(target_uncertainty, generator)
        source_aware = self.weighting(
            source_hybrid, target_hybrid, scores, source_uncertainty if weighs else None, source_keep
        )
        target_aware = self.weighting(
            target_hybrid,
            source_hybrid,
            scores.transpose(1, 2),
            target_uncertainty if weighs else None,
            target_keep,
        )

        source_final, target_final = self.second_transformer(source_aware, target_aware, *where)
        matching = self.second_matching(source_final, target_final, similarity, real)
        return Prediction(
            source_features=source_features,
            target_features=target_features,
            descriptor_similarity=similarity,
            coarse_scores=coarse,
            matching_scores=matching,
            source_distribution=source_distribution,
            target_distribution=target_distribution,
            source_uncertainty=source_uncertainty,
            target_uncertainty=target_uncertainty,
            source_overlap_logits=self.overlap_head(
                source_final, matching[:, :-1, -1], source_distribution.mean
            ),
            target_overlap_logits=self.overlap_head(
                target_final, matching[:, -1, :-1], target_distribution.mean
            ),
        )


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.rand(like.shape, generator=generator).to(like.device)
