"""Quick validation during training: how good the matches are, without solving for a pose."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from utopic_cli.model.utopic import Prediction, Utopic
from utopic_cli.synthesis.pairs import random_pair
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training.config import Schedule, TrainingConfig
from utopic_cli.training.data import sample_pair, to_training_pair
from utopic_cli.training.labels import POSITIVE_REACH, Labels, label_pair
from utopic_cli.training.network import TrainingPair
from utopic_cli.training.pace import Limits
from utopic_cli.training.run import Run

VALIDATION_SEED = 900_001
VALIDATION_POINTS = 768
SECONDS_A_PAIR = 10.0
FEWEST_PAIRS = 4


@torch.no_grad()
def validate(
    model: Utopic, pairs: Sequence[TrainingPair], seed: int, *, descriptors_only: bool = False
) -> dict[str, float]:
    """Measure a network on held-out pairs.

    Args:
        model: the network.
        pairs: batches of one.
        seed: seed of the overlap samples.
        descriptors_only: only the hit rate, for which the extractor alone is run.

    Returns:
        ``hit_rate``: share of overlapping source points whose most similar target descriptor
        lies within reach of the true place; ``match_rate``: the same for the final matching
        scores; ``inlier_ratio``: share of right ones among the 250 surest matches;
        ``overlap_accuracy``: share of points whose overlap is told right at 0.5;
        ``known_overlap_accuracy``: the same when shown the right transformation;
        ``uncertainty_auc``: probability, when shown it, that an overlapping source point whose best
        match is wrong is more uncertain than one whose is right (one half where all are alike).
    """
    model.eval()
    names = (
        "hit_rate",
        "match_rate",
        "inlier_ratio",
        "overlap_accuracy",
        "known_overlap_accuracy",
        "uncertainty_auc",
    )
    sums = dict.fromkeys(names[:1] if descriptors_only else names, 0.0)
    for number, pair in enumerate(pairs):
        if descriptors_only:
            similarity = model.extractor(pair.source)[1] @ model.extractor(pair.target)[1].transpose(1, 2)
            overlapping = label_pair(pair.source, pair.target, pair.gt_T_target_source).source_overlap[0]
            sums["hit_rate"] += _share_within(similarity[0], _match_errors(pair), overlapping > 0.5)
            continue
        generator = torch.Generator().manual_seed(seed + number)
        prediction = model(pair.source, pair.target, generator=generator)
        labels = label_pair(pair.source, pair.target, pair.gt_T_target_source)
        error = _match_errors(pair)
        overlapping = labels.source_overlap[0] > 0.5
        scores = prediction.matching_scores[0, :-1, :-1]
        sums["hit_rate"] += _share_within(prediction.descriptor_similarity[0], error, overlapping)
        sums["match_rate"] += _share_within(scores, error, overlapping)
        surest = scores.max(dim=1)
        order = surest.values.argsort(descending=True)[:250]
        right = error[order, surest.indices[order]] < 2.0 * POSITIVE_REACH
        sums["inlier_ratio"] += float(right.float().mean())
        sums["overlap_accuracy"] += _overlap_accuracy(prediction, labels)
        if model.config.hypothesis:
            generator.manual_seed(seed + number)
            prediction = model(
                pair.source, pair.target, generator=generator, hypothesis=pair.gt_T_target_source
            )
        sums["known_overlap_accuracy"] += _overlap_accuracy(prediction, labels)
        chosen = prediction.matching_scores[0, :-1, :-1].argmax(dim=1, keepdim=True)
        right = error.gather(1, chosen)[:, 0] < 2.0 * POSITIVE_REACH
        raw = prediction.source_distribution.raw_uncertainty[0]
        sums["uncertainty_auc"] += _share_above(raw[overlapping & ~right], raw[overlapping & right])
    return {name: value / max(len(pairs), 1) for name, value in sums.items()}


def _share_above(high: Tensor, low: Tensor) -> float:
    """Share of all pairs of values in which the first is above the second, ties counting half."""
    if not (len(high) and len(low)):
        return 0.5
    difference = high[:, None] - low
    return float(((difference > 0).float() + 0.5 * (difference == 0).float()).mean())


def _overlap_accuracy(prediction: Prediction, labels: Labels) -> float:
    told = torch.cat([prediction.source_overlap[0], prediction.target_overlap[0]]) > 0.5
    known = torch.cat([labels.source_overlap[0], labels.target_overlap[0]]) > 0.5
    return float((told == known).float().mean())


def _match_errors(pair: TrainingPair) -> Tensor:
    """Distance of each target node from the true place of each source node, in spacings -> (N, M)."""
    rotation, translation = pair.gt_T_target_source[0, :3, :3], pair.gt_T_target_source[0, :3, 3]
    moved = pair.source.points[0] @ rotation.T + translation
    return torch.cdist(moved, pair.target.points[0]) / pair.source.spacing


def _share_within(scores: Tensor, error: Tensor, rows: Tensor) -> float:
    """Share of the given rows whose best-scored column is within twice the positive reach."""
    if not bool(rows.any()):
        return 0.0
    chosen = scores.argmax(dim=1, keepdim=True)
    return float((error.gather(1, chosen)[rows, 0] < 2.0 * POSITIVE_REACH).float().mean())


class PeriodicValidation:
    """Validates now and then, and never for more than a tenth of the time."""

    def __init__(self, pairs: list[TrainingPair], schedule: Schedule, limits: Limits) -> None:
        """Validate on these pairs."""
        self.pairs, self.seed = pairs, schedule.seed
        self.seconds = 0.0  # how long the last one took
        self.patience = min(schedule.validation_seconds, limits.seconds_left() / 8)
        self.last = time.monotonic()

    def due(self) -> bool:
        """Whether it is time again."""
        return time.monotonic() - self.last > max(self.patience, 9.0 * self.seconds)

    def __call__(self, run: Run, joint: bool) -> dict[str, float]:
        """Measure the averaged weights; before the joint stage only what is being trained."""
        begun = time.monotonic()
        model = run.average.network(run.network.inference)
        measured = validate(model, self.pairs, self.seed, descriptors_only=not joint)
        self.last = time.monotonic()
        self.seconds = self.last - begun
        return {name: round(value, 4) for name, value in measured.items()}


def validation_pairs(
    shapes: ShapeLibrary, config: TrainingConfig, minutes: float | None = None
) -> list[TrainingPair]:
    """Make the held-out pairs of a run: always the same for the same shapes and settings.

    Args:
        shapes: to make them of.
        config: settings of the run.
        minutes: how long the run may take. Of a short one they would eat the time: it gets the first of them,
            one for each ``SECONDS_A_PAIR``, at least ``FEWEST_PAIRS``.
    """
    count = config.schedule.validation_pairs
    if minutes is not None:
        count = min(count, max(FEWEST_PAIRS, int(60.0 * minutes / SECONDS_A_PAIR)))
    return list(fixed_pairs(shapes, config, VALIDATION_SEED, count))


def fixed_pairs(
    shapes: ShapeLibrary, config: TrainingConfig, seed: int, count: int
) -> Iterator[TrainingPair]:
    """Make ``count`` pairs of a run's kinds, batches of one, the same for the same arguments."""
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        pair = random_pair(shapes, rng, config.pairs)
        yield to_training_pair(sample_pair(pair, VALIDATION_POINTS, rng), config.model.neighbours)
