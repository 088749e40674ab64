"""Uncertainty quantification and uncertainty-aware weighting (Sec. 3.3.2, 3.3.3)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from utopic_cli.model.one_thread import one_thread


class OverlapDistribution(NamedTuple):
    """The learned distribution of each point's overlap and samples of it.

    Attributes:
        mean: (B, N) mu, in logits.
        log_variance: (B, N) log sigma^2, in logits squared.
        samples: (B, K, N) overlap scores in [0, 1].
        raw_uncertainty: (B, N) variance, not normalised; of what, the scheme says.
    """

    mean: Tensor
    log_variance: Tensor
    samples: Tensor
    raw_uncertainty: Tensor


LEAST_PEAK = 1e-3
"""A first correspondence weaker than this is as good as none."""


class UncertaintyQuantification(nn.Module):
    """Predict a Gaussian overlap per point, draw from it, take the variance (Eq. 8).

    What the variance is of, and what it is predicted from, depends on the scheme. ``sampled``: both moments
    from the features; the variance of samples squeezed into [0, 1]. ``predicted``: the predicted deviation
    itself. ``none``: nothing is uncertain. ``matched``: the variance is predicted from how sharply the point
    is matched at first, and from a hypothesis' evidence; squeezed are the samples' distances from the mean,
    since at a mean that is sure there is little room for any variance. Only ``reliability_loss`` teaches it.
    From the features it can't be told: they know which surface is plain, and that plain surface (a wall) is
    sure to overlap, not whether the point can be told from its neighbours.
    """

    def __init__(self, width: int, scheme: str, samples: int, evidence: int = 0) -> None:
        """Build.

        Args:
            width: channels of the features.
            scheme: ``matched``, ``sampled``, ``predicted`` or ``none`` (which still predicts the mean).
            samples: K.
            evidence: channels of a hypothesis' evidence, which reaches mean and log-variance
                directly; 0 without hypotheses.
        """
        super().__init__()
        self.scheme, self.samples = scheme, samples
        self.mean = nn.Linear(width, 1)
        self.log_variance = nn.Linear(1 if scheme == "matched" else width, 1)
        if evidence:
            self.evidence = nn.Linear(evidence, 2, bias=False)
            nn.init.zeros_(self.evidence.weight)

    @one_thread()
    def forward(
        self,
        features: Tensor,
        peak: Tensor,
        generator: torch.Generator,
        evidence: Tensor | None = None,
    ) -> OverlapDistribution:
        """Quantify overlap.

        Args:
            features: (B, N, V).
            peak: (B, N) largest soft correspondence of each point, in [0, 1].
            generator: draws the K samples, on the CPU.
            evidence: (B, N, E) of a hypothesis, or None.
        """
        mean = self.mean(features).squeeze(-1).float()
        if self.scheme == "matched":
            known = peak.detach().float().clamp_min(LEAST_PEAK).log()[..., None]
        else:
            known = features
        log_variance = self.log_variance(known).squeeze(-1).float()
        if evidence is not None:
            shift = self.evidence(evidence).float()
            mean, log_variance = mean + shift[..., 0], log_variance + shift[..., 1]
        log_variance = log_variance.clamp(-8.0, 4.0)
        # Points share their draws at inference: each point's samples have the same distribution,
        # but K draws of its own would speckle the variance by a fifth.
        shape = (mean.shape[0], self.samples, mean.shape[1] if self.training else 1)
        noise = torch.randn(shape, generator=generator).to(mean.device)
        deviation = (0.5 * log_variance).exp()
        if self.scheme == "matched":
            raw = self.spread(deviation)
            # What the samples teach is the mean's alone.
            log_variance, deviation = log_variance.detach(), deviation.detach()
        samples = torch.sigmoid(mean[:, None] + noise * deviation[:, None])
        if self.scheme == "sampled":
            raw = samples.var(dim=1, unbiased=False)
        elif self.scheme == "predicted":
            raw = deviation
        elif self.scheme == "none":  # nothing has taught the deviation anything
            raw = torch.zeros_like(mean)
        return OverlapDistribution(mean, log_variance, samples, raw)

    def spread(self, deviation: Tensor) -> Tensor:
        """Variance of K squeezed samples about a mean of 0, taken at even quantiles -> (B, N)."""
        steps = torch.arange(self.samples, dtype=torch.float32, device=deviation.device)
        noise = torch.special.ndtri((steps + 0.5) / self.samples)
        return torch.sigmoid(noise[:, None] * deviation[:, None]).var(dim=1, unbiased=False)


def normalise_uncertainty(
    source: Tensor, target: Tensor, valid: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Min-max normalise raw uncertainties over each pair; flat maps to 0.

    Args:
        source: (B, N).
        target: (B, M).
        valid: (B, N + M) bool, the points that count; None: all do.
    """
    both = torch.cat([source, target], dim=1)
    lowest, highest = both, both
    if valid is not None:
        lowest, highest = both.masked_fill(~valid, torch.inf), both.masked_fill(~valid, -torch.inf)
    low = lowest.min(dim=1, keepdim=True).values
    span = highest.max(dim=1, keepdim=True).values - low
    scale = torch.where(span > 1e-9, 1.0 / span.clamp_min(1e-9), torch.zeros_like(span))
    return (source - low) * scale, (target - low) * scale


class UncertaintyWeighting(nn.Module):
    """Fuse a point's features with those it corresponds to, and fade them by uncertainty."""

    def __init__(self, width: int) -> None:
        """Build for features of ``width`` channels."""
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, width))

    def forward(
        self, features: Tensor, other: Tensor, scores: Tensor, uncertainty: Tensor | None, keep: Tensor | None
    ) -> Tensor:
        """Return uncertainty-aware features.

        Args:
            features: (B, N, V) of this cloud.
            other: (B, M, V) of the other cloud.
            scores: (B, N, M) soft correspondences from this cloud to the other.
            uncertainty: (B, N) in [0, 1], or None for the variant without uncertainty.
            keep: (B, N) bool, False for points masked out in training, or None.

        Returns:
            (B, N, V): MLP(cat[F, C F_other]) * (1 - U), masked points zeroed.
        """
        with one_thread():
            partner = scores.to(other.dtype) @ other  # (B, N, V)
        fused = self.mlp(torch.cat([features, partner], dim=-1))
        if uncertainty is not None:
            fused = fused * (1.0 - uncertainty[..., None])
        if keep is not None:
            fused = fused * keep[..., None]
        return fused
