"""What the variants of the uncertainty call uncertain."""

from __future__ import annotations

import pytest
import torch

from utopic_cli.model.uncertainty import UncertaintyQuantification, normalise_uncertainty


@pytest.mark.parametrize("scheme", ["sampled", "predicted", "none"])
def test_raw_uncertainty_by_scheme(scheme, generator):
    part = UncertaintyQuantification(8, scheme, 4000).eval()
    torch.nn.init.zeros_(part.mean.weight)
    features = torch.randn(1, 6, 8, generator=generator)
    with torch.no_grad():
        found = part(features, generator)
    raw, deviation = found.raw_uncertainty, (0.5 * found.log_variance).exp()
    if scheme == "none":  # a layer that nothing teaches must not say which points to believe
        assert not raw.any()
        assert not any(one.any() for one in normalise_uncertainty(raw, raw))
    elif scheme == "predicted":
        assert torch.equal(raw, deviation)
    else:
        assert torch.allclose(raw, found.samples.var(dim=1, unbiased=False))
        assert torch.equal(raw.argsort(), deviation.argsort())
