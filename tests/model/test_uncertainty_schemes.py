"""What the variants of the uncertainty call uncertain."""

from __future__ import annotations

import pytest
import torch

from utopic_cli.model.uncertainty import UncertaintyQuantification, normalise_uncertainty
from utopic_cli.training.losses import uncertainty_loss


@pytest.mark.parametrize("scheme", ["sampled", "predicted", "none"])
def test_raw_uncertainty_by_scheme(scheme, generator):
    part = UncertaintyQuantification(8, scheme, 4000).eval()
    torch.nn.init.zeros_(part.mean.weight)
    features = torch.randn(1, 6, 8, generator=generator)
    with torch.no_grad():
        found = part(features, torch.rand(1, 6, generator=generator), generator)
    raw, deviation = found.raw_uncertainty, (0.5 * found.log_variance).exp()
    if scheme == "none":  # a layer that nothing teaches must not say which points to believe
        assert not raw.any()
        assert not any(one.any() for one in normalise_uncertainty(raw, raw))
    elif scheme == "predicted":
        assert torch.equal(raw, deviation)
    else:
        assert torch.allclose(raw, found.samples.var(dim=1, unbiased=False))
        assert torch.equal(raw.argsort(), deviation.argsort())


def test_matched_uncertainty_follows_the_match_whatever_the_overlap(generator):
    part = UncertaintyQuantification(8, "matched", 50, evidence=3).eval()
    torch.nn.init.constant_(part.log_variance.weight, -0.5)
    features = 5.0 * torch.randn(1, 4, 8, generator=generator)  # overlap as good as certain
    peak = torch.tensor([[0.9, 0.3, 0.01, 0.0]])
    with torch.no_grad():
        found = part(features, peak, generator)
        again = part(-features, peak, generator)
    raw = found.raw_uncertainty[0]
    assert (raw.diff() > 0).all() and raw.max() < 0.25
    assert torch.equal(raw, again.raw_uncertainty[0])  # no draw, no feature


def test_matched_uncertainty_is_taught_by_reliability_alone(generator):
    part = UncertaintyQuantification(8, "matched", 50)
    peak = torch.rand(1, 4, generator=generator, requires_grad=True)
    found = part(torch.randn(1, 4, 8, generator=generator), peak, generator)
    uncertainty_loss(found, torch.ones(1, 4), torch.ones(1, 4)).backward()
    assert part.log_variance.weight.grad is None and part.mean.weight.grad.any()
    found.raw_uncertainty.sum().backward()
    assert part.log_variance.weight.grad.any() and peak.grad is None
