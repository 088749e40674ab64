"""The head of the variance, fitted by itself: a few numbers, to what the whole network matches wrongly.

In the joint stage it follows the network's other parts, and sees wrong transformations as well, under which
nothing far off is certain. Fitted afterwards, to pairs that are shown the right transformation or none, it
says what it is asked at inference.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from utopic_cli.model.hypothesis import HYPOTHESIS_FEATURES
from utopic_cli.model.uncertainty import LEAST_PEAK
from utopic_cli.model.utopic import Utopic
from utopic_cli.training.labels import label_pair
from utopic_cli.training.losses import reliability_odds, reliability_targets
from utopic_cli.training.network import TrainingPair

STRIDE = 3
"""Every so many of a pair's points count: neighbours say the same."""

STEPS = 60
RIDGE = 1e-4
"""What the squares of the numbers cost: much of the evidence says nearly the same."""


class _Seen(NamedTuple):
    """What the head sees of some points, and what it ought to say."""

    known: Tensor  # (P, 1 + HYPOTHESIS_FEATURES)
    wrong: Tensor  # (P,)
    weight: Tensor  # (P,)


def fit_variance(model: Utopic, pairs: Iterable[TrainingPair]) -> tuple[float, float]:
    """Fit the head of the variance of the scheme ``matched``, in place, by ``reliability_loss``.

    Args:
        model: a trained network that knows hypotheses.
        pairs: batches of one; their own hypotheses are not looked at.

    Returns:
        The loss before and after.

    Raises:
        ValueError: another scheme, or no hypotheses.
    """
    if model.config.uncertainty_scheme != "matched" or not model.config.hypothesis:
        raise ValueError("only the variance of matched points, with hypotheses, has a head of its own")
    seen = [one for pair in pairs for shown in (True, False) for one in _look(model, pair, shown)]
    known, wrong, weight = (torch.cat(parts) for parts in zip(*seen, strict=True))
    head = model.quantification
    numbers = torch.cat(
        [head.log_variance.weight[0], head.evidence.weight[1], head.log_variance.bias]
    ).detach()
    numbers.requires_grad_()
    optimiser = torch.optim.LBFGS([numbers], max_iter=STEPS, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        log_variance = (known @ numbers[:-1] + numbers[-1]).clamp(-8.0, 4.0)
        odds = reliability_odds(head.spread((0.5 * log_variance).exp()[None])[0])
        terms = binary_cross_entropy_with_logits(odds, wrong, reduction="none")
        return (terms * weight).sum() / weight.sum()

    def step() -> Tensor:
        optimiser.zero_grad()
        value = loss() + RIDGE * numbers.square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    before = float(loss().detach())
    optimiser.step(step)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        head.log_variance.weight[0].copy_(numbers[:1])
        head.evidence.weight[1].copy_(numbers[1:-1])
        head.log_variance.bias.copy_(numbers[-1:])
        return before, float(loss())


@torch.no_grad()
def _look(model: Utopic, pair: TrainingPair, shown: bool) -> list[_Seen]:
    """Let the network look at a pair, shown the right transformation or none, and note what the head sees."""
    asked: list[tuple[Tensor, Tensor | None]] = []

    def note(_: nn.Module, arguments: tuple[Tensor, Tensor, torch.Generator, Tensor | None]) -> None:
        asked.append((arguments[1], arguments[3]))

    handle = model.quantification.register_forward_pre_hook(note)
    try:
        prediction = model.eval()(
            pair.source,
            pair.target,
            generator=torch.Generator().manual_seed(0),
            hypothesis=pair.gt_T_target_source if shown else None,
        )
    finally:
        handle.remove()
    labels = label_pair(pair.source, pair.target, pair.gt_T_target_source)
    scores = prediction.coarse_scores[:, :-1, :-1]
    near = (labels.correspondences > 0) | labels.ignored
    present = scores.new_full((1,), float(shown))
    both = (
        (scores, near, labels.source_overlap, labels.source_valid),
        (scores.transpose(1, 2), near.transpose(1, 2), labels.target_overlap, labels.target_valid),
    )
    found = []
    for (peak, evidence), answers in zip(asked, both, strict=True):
        wrong, weight = reliability_targets(*answers, present)
        sharp = peak.clamp_min(LEAST_PEAK).log()[..., None]
        if evidence is None:
            evidence = peak.new_zeros(*peak.shape, HYPOTHESIS_FEATURES)
        known = torch.cat([sharp, evidence], dim=-1)[0]
        share = weight[0] / weight.sum().clamp_min(1.0)  # pairs count alike, however many points they have
        found.append(_Seen(known[::STRIDE], wrong[0, ::STRIDE], share[::STRIDE]))
    return found
