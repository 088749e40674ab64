"""The four losses of the paper (Sec. 3.5), the descriptors' contrastive loss, and reliability.

Every loss is a mean over pairs of a mean within the pair, so that it does not matter which
pairs share a batch, or a process.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, binary_cross_entropy_with_logits

from utopic_cli.model.uncertainty import OverlapDistribution
from utopic_cli.training.labels import Labels

EVEN_VARIANCE = 0.02
"""Raw uncertainty of a point that is as likely matched rightly as wrongly."""

FAR_WEIGHT = 0.3
"""What a point far from any counterpart counts, beside one near one: there are many, and all alike."""


def descriptor_loss(similarity: Tensor, temperature: Tensor, labels: Labels) -> Tensor:
    """Symmetric InfoNCE within a pair, over the points that have a counterpart.

    Args:
        similarity: (B, N, M) cosines of unit descriptors.
        temperature: scalar factor on the cosines.
        labels: soft positives; ignored entries take no part.
    """
    logits = (similarity.float() * temperature).masked_fill(labels.ignored, -1e4)
    return 0.5 * (
        _soft_cross_entropy(logits, labels.correspondences)
        + _soft_cross_entropy(logits.transpose(1, 2), labels.correspondences.transpose(1, 2))
    )


def registration_loss(scores: Tensor, labels: Labels) -> Tensor:
    """Cross entropy between predicted and known correspondences, per known correspondence.

    Args:
        scores: (B, N + 1, M + 1) soft correspondences with slack.
        labels: known answers; near misses are not counted as wrong.
    """
    core = scores[:, :-1, :-1].float().clamp(1e-7, 1.0 - 1e-6)
    right = labels.correspondences
    wrong = (1.0 - right).masked_fill(labels.ignored, 0.0)
    terms = right * core.log() + wrong * torch.log1p(-core)
    return -(terms.sum(dim=(1, 2)) / right.sum(dim=(1, 2)).clamp_min(1.0)).mean()


def overlap_loss(source_logits: Tensor, target_logits: Tensor, labels: Labels) -> Tensor:
    """Binary cross entropy of the overlap scores of both clouds."""
    source = binary_cross_entropy_with_logits(source_logits, labels.source_overlap, reduction="none")
    target = binary_cross_entropy_with_logits(target_logits, labels.target_overlap, reduction="none")
    return 0.5 * (_mean(source, labels.source_valid) + _mean(target, labels.target_valid))


def uncertainty_loss(
    distribution: OverlapDistribution, overlap: Tensor, valid: Tensor, kl_weight: float = 0.1
) -> Tensor:
    """Fit of the sampled overlaps to the known one, and the distance of their Gaussian to N(0, 1).

    The first term makes a confident wrong point expensive, the second keeps the variance
    from collapsing to zero where it costs nothing.

    Args:
        distribution: of one cloud, N points and K samples.
        overlap: (B, N) in {0, 1}.
        valid: (B, N) float, 0 for points that only fill a batch up.
        kl_weight: weight of the Kullback-Leibler term relative to the first.
    """
    samples = distribution.samples.clamp(1e-6, 1.0 - 1e-6)
    fit = binary_cross_entropy(samples, overlap[:, None].expand_as(samples), reduction="none").mean(dim=1)
    mean, log_variance = distribution.mean, distribution.log_variance
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance)
    return _mean(0.5 * fit + kl_weight * divergence, valid)


def reliability_loss(
    distribution: OverlapDistribution,
    scores: Tensor,
    near: Tensor,
    overlap: Tensor,
    valid: Tensor,
    shown: Tensor,
) -> Tensor:
    """Teach the raw uncertainty to tell points that are matched wrongly: cross entropy of its odds.

    The paper's loss leaves the variance of a sure point to the Kullback-Leibler term, so that it
    follows the mean and says little of its own. Here the variance over ``EVEN_VARIANCE`` is read as the odds
    that the point's best match is wrong: it has to be high where the surface shows nothing to go
    by, and at the border, where a counterpart is near but none is right. A point far from any counterpart
    has no match to be wrong: where the right transformation shows as much it should be low there. Otherwise
    nothing tells it from a point that can't be matched, and it takes no part.

    Args:
        distribution: of one cloud, N points and K samples.
        scores: (B, N, M) soft correspondences to the other cloud.
        near: (B, N, M) bool, pairs of real points that show about the same place.
        overlap: (B, N) in {0, 1}.
        valid: (B, N) float, 0 for points that only fill a batch up.
        shown: (B,) 1 where the network was shown the right transformation or nearly, else 0.
    """
    wrong, weight = reliability_targets(scores, near, overlap, valid, shown)
    odds = reliability_odds(distribution.raw_uncertainty)
    return _mean(binary_cross_entropy_with_logits(odds, wrong, reduction="none"), weight)


def reliability_odds(raw_uncertainty: Tensor) -> Tensor:
    """Read raw uncertainty as log-odds that a point's best match is wrong."""
    return (raw_uncertainty.clamp_min(1e-6) / EVEN_VARIANCE).log()


def reliability_targets(
    scores: Tensor, near: Tensor, overlap: Tensor, valid: Tensor, shown: Tensor
) -> tuple[Tensor, Tensor]:
    """Tell which points of one cloud are matched wrongly, (B, N) in {0, 1}, and what each counts (B, N).

    Arguments as of ``reliability_loss``.
    """
    best = scores.detach().argmax(dim=2, keepdim=True)
    reached = near.any(dim=2).float()
    wrong = reached * (1.0 - near.gather(2, best)[:, :, 0].float() * overlap)
    return wrong, torch.maximum(reached, FAR_WEIGHT * shown[:, None]) * valid


def chamfer_loss(predicted: Tensor, expected: Tensor, valid: Tensor) -> Tensor:
    """L1 Chamfer distance: mean nearest distance both ways, halved.

    Args:
        predicted: (B, P, 3).
        expected: (B, Q, 3).
        valid: (B, Q) float, 0 for expected points that only fill a batch up.
    """
    distance = torch.cdist(predicted, expected)
    to_expected = distance.masked_fill(valid[:, None] == 0, torch.inf).min(dim=2).values
    return 0.5 * (to_expected.mean() + _mean(distance.min(dim=1).values, valid))


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean over pairs of the weighted mean of (B, N) values; a pair without weight counts as 0."""
    return ((values * weight).sum(dim=1) / weight.sum(dim=1).clamp_min(1.0)).mean()


def _soft_cross_entropy(logits: Tensor, targets: Tensor) -> Tensor:
    """Cross entropy of rows with any target mass, mass normalised to one a row."""
    mass = targets.sum(dim=2)
    log_probability = torch.log_softmax(logits, dim=2)
    per_row = -(targets * log_probability).sum(dim=2) / mass.clamp_min(1e-6)
    return _mean(per_row, (mass > 1e-6).float())
