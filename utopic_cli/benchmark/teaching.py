"""Teaching a verifier: what right and wrong poses look like close up, of simulated pairs.

The wrong ones are those that the solve itself proposes, which is what the verifier will have to tell from
right ones: half turns, neighbours in a row, and whatever fits of scans that share nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from utopic_cli.benchmark.lessons import Lesson, lesson_of
from utopic_cli.benchmark.pool import each
from utopic_cli.errors import InputError
from utopic_cli.estimation.close_up import NODES, POINT_FEATURES, WHOLE_FEATURES
from utopic_cli.estimation.confidence import fit_calibration
from utopic_cli.model.pose_verifier import UNREAD, PoseVerifier, meeting
from utopic_cli.synthesis.shapes import ShapeLibrary

WIDTH = 64
EPOCHS = 10
BATCH = 12  # pairs
RATE = 3e-3
MORE_RATE, MORE_EPOCHS = 5e-4, 4  # of one that goes on from another
WEIGHT_DECAY = 0.02
BY_ITSELF = 0.5
"""Weight of each pose's own right or wrong, beside which pose of a pair is the right one."""

FOLDS = 3
FEWEST = 30
FEWEST_SHOWN = 5


def teach(
    weights: str,
    shapes: ShapeLibrary,
    data: str,
    pairs: int,
    seed: int,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
    start: PoseVerifier | None = None,
) -> tuple[PoseVerifier, dict[str, Any]]:
    """Teach a verifier for some weights.

    Args:
        weights: as of ``load_network``.
        shapes: a library; only its ``train`` shapes are used.
        data: what to call it.
        pairs: how many to make.
        seed: of the pairs and of the verifier's first weights.
        workers: processes that solve pairs; the result does not depend on their number.
        progress: called with (done, in all, what goes on).
        start: a verifier that has learned to choose among poses of other matches, to go on from.

    Returns:
        The verifier, and what to write about it into the card.

    Raises:
        InputError: no pairs can be made of the shapes, or too few poses are right or wrong.
    """
    train = shapes.select("train")
    if not len(train):
        raise InputError(f"{data}: has no shapes to learn from")

    def tell(done: int, of: int) -> None:
        if progress is not None:
            progress(done, of, f"poses for pairs of {data}")

    found = each(partial(_task, weights, train, data, seed), pairs, workers, tell)
    lessons = [lesson for lesson in found if lesson is not None]
    about = {"data": data, "shapes": len(train), "seed": seed}
    return learn(lessons, about, seed, progress, start)


def learn(
    lessons: Sequence[Lesson],
    about: dict[str, Any],
    seed: int,
    progress: Callable[[int, int, str], None] | None = None,
    start: PoseVerifier | None = None,
) -> tuple[PoseVerifier, dict[str, Any]]:
    """Fit a verifier to lessons, after measuring it on shapes left out in turn.

    One that goes on from another is measured on pairs left out; their shapes the other may have seen.
    Unless it has a right pose first more often, the other stays as it was, and only overlap is read anew.

    Raises:
        InputError: too few lessons, or all of one kind.
    """
    both = sum(bool(lesson.right.any() and not lesson.right.all()) for lesson in lessons)
    if both < FEWEST:
        raise InputError(
            f"only {both} pairs have right and wrong poses; {FEWEST} are needed, so give more pairs"
        )
    fold = np.array([zlib.crc32(lesson.shape.encode()) % FOLDS for lesson in lessons])
    held: list[tuple[Lesson, np.ndarray]] = []
    for number in range(FOLDS):
        if progress is not None:
            progress(number, FOLDS + 1, "learning")
        rest = [lesson for lesson, its in zip(lessons, fold, strict=True) if its != number]
        verifier = fit(rest, seed, start)
        held += [
            (lesson, plausible(verifier, lesson))
            for lesson, its in zip(lessons, fold, strict=True)
            if its == number
        ]
    if progress is not None:
        progress(FOLDS, FOLDS + 1, "learning")
    description = {
        **about,
        "pairs": len(lessons),
        "poses": int(sum(len(lesson.right) for lesson in lessons)),
        "right": int(sum(lesson.right.sum() for lesson in lessons)),
        "epochs": EPOCHS if start is None else MORE_EPOCHS,
        "out_of_fold": _chosen(held),
    }
    if start is None:
        verifier = fit(lessons, seed)
    else:
        started = _chosen([(lesson, plausible(start, lesson)) for lesson in lessons])
        better = _first(description["out_of_fold"]) > _first(started)
        description |= {"as_it_started": started, "kept_as_it_started": not better}
        verifier = fit(lessons, seed, start) if better else deepcopy(start)
    verifier.overlap.copy_(torch.from_numpy(reading_of(lessons)))
    return verifier, {**description, "overlap": _told(verifier, lessons)}


def fit(lessons: Sequence[Lesson], seed: int, start: PoseVerifier | None = None) -> PoseVerifier:
    """Train a verifier: of a pair's poses the right one, and of each pose whether it is right.

    Args:
        lessons: some with right and wrong poses.
        seed: of the first weights, the order, and which points are looked at.
        start: to go on from, more slowly and not as long, so that it keeps what it knows; None: from nothing.
    """
    rate, epochs = (RATE, EPOCHS) if start is None else (MORE_RATE, MORE_EPOCHS)
    rng = np.random.default_rng(seed)
    points = [_evenly(lesson.points) for lesson in lessons]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if start is None:
            verifier = PoseVerifier(POINT_FEATURES, WHOLE_FEATURES, WIDTH)
            verifier.normalise(
                torch.from_numpy(
                    np.concatenate([one[:, ::16].reshape(-1, POINT_FEATURES) for one in points])
                ),
                torch.from_numpy(np.concatenate([lesson.whole for lesson in lessons])),
            )
        else:
            verifier = deepcopy(start).train()
        optimiser = torch.optim.AdamW(verifier.parameters(), rate, weight_decay=WEIGHT_DECAY)
        steps = epochs * -(-len(lessons) // BATCH)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
        for _ in range(epochs):
            for chosen in _batches(rng.permutation(len(lessons))):
                some = rng.permutation(2 * NODES)[:NODES]
                odds = verifier(
                    torch.from_numpy(np.concatenate([points[i][:, some] for i in chosen])).float(),
                    torch.from_numpy(np.concatenate([lessons[i].whole for i in chosen])),
                )
                loss = _loss(odds, [torch.from_numpy(lessons[i].right) for i in chosen])
                optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                nn.utils.clip_grad_norm_(verifier.parameters(), 1.0)
                optimiser.step()
                schedule.step()
    return verifier.eval()


def reading_of(lessons: Sequence[Lesson]) -> np.ndarray:
    """Fit how to read overlap from a pose (3,), by maximum likelihood; see ``PoseVerifier``.

    Slope and shift are those of a verifier that learned nothing where fewer than ``FEWEST_SHOWN`` pairs have
    a right pose, or their points overlap all or not at all, or none the more the nearer the other scan is.
    """
    without = [lesson.overlaps.mean() for lesson in lessons if len(lesson.overlaps) > len(lesson.gap)]
    usual = float(np.mean(without)) if without else 0.0
    unread = np.array([*UNREAD[:2], usual])
    met, overlaps = _shown(lessons)
    if sum(bool(len(one.gap)) for one in lessons) < FEWEST_SHOWN or not overlaps.any() or overlaps.all():
        return unread
    model = fit_calibration(("met",), met[:, None], overlaps, threshold=0.5)
    slope = model.coefficients[0] / model.deviation[0]
    return np.array([slope, model.intercept - slope * model.mean[0], usual]) if slope > 0 else unread


def _shown(lessons: Sequence[Lesson]) -> tuple[np.ndarray, np.ndarray]:
    """How far the points (N,) of all lessons with a right pose meet the other scan, and what is true."""
    shown = [lesson for lesson in lessons if len(lesson.gap)]
    if not shown:
        return np.zeros(0), np.zeros(0, bool)
    gap = np.concatenate([one.gap for one in shown]).astype(np.float64)
    return meeting(gap), np.concatenate([one.overlaps for one in shown])


def _told(verifier: PoseVerifier, lessons: Sequence[Lesson]) -> dict[str, float]:
    """Describe how overlap is read, and the share of points told right."""
    met, overlaps = _shown(lessons)
    slope, shift, usual = verifier.overlap.tolist()
    counted = {"slope": slope, "shift": shift, "usual_without_a_right_pose": usual, "points": len(met)}
    if len(met):
        counted["accuracy"] = float(((slope * met + shift > 0) == overlaps).mean())
    return counted


def plausible(verifier: PoseVerifier, lesson: Lesson) -> np.ndarray:
    """Return the log-odds (C,) of a lesson's poses."""
    with torch.inference_mode():
        odds = verifier(torch.from_numpy(lesson.points).float(), torch.from_numpy(lesson.whole))
    return odds.numpy()


def _batches(order: np.ndarray) -> Iterator[np.ndarray]:
    for start in range(0, len(order), BATCH):
        yield order[start : start + BATCH]


def _evenly(points: np.ndarray) -> np.ndarray:
    """Repeat points of small clouds, so that all lessons have 2 ``NODES``."""
    return points[:, np.arange(2 * NODES) * points.shape[1] // (2 * NODES)]


def _loss(odds: torch.Tensor, right: Sequence[torch.Tensor]) -> torch.Tensor:
    loss = BY_ITSELF * nn.functional.binary_cross_entropy_with_logits(odds, torch.cat(list(right)).float())
    for own, is_right in zip(odds.split([len(one) for one in right]), right, strict=True):
        if is_right.any() and not is_right.all():
            loss = loss + (own.logsumexp(0) - own[is_right].logsumexp(0)) / len(right)
    return loss


def _chosen(held: Sequence[tuple[Lesson, np.ndarray]]) -> dict[str, Any]:
    """Count, by kind of pair, where a right pose was proposed, and where it comes first."""
    counts: dict[str, list[int]] = {}
    for lesson, odds in held:
        if not lesson.right[lesson.proposed].any():
            continue
        right = lesson.right[lesson.proposed]
        count = counts.setdefault(lesson.kind, [0, 0, 0])
        count[0] += 1
        count[1] += int(right[lesson.by_surfaces[lesson.proposed].argmax()])
        count[2] += int(right[odds[lesson.proposed].argmax()])
    names = ("right_proposed", "first_by_surfaces", "first_by_verifier")
    return {kind: dict(zip(names, counts[kind], strict=True)) for kind in sorted(counts)}


def _first(chosen: dict[str, Any]) -> int:
    """Of all kinds of pairs, how many have a right pose first by the verifier."""
    return sum(count["first_by_verifier"] for count in chosen.values())


def _task(weights: str, shapes: ShapeLibrary, data: str, seed: int) -> Callable[[int], Lesson | None]:
    return partial(lesson_of, weights, shapes, data, seed)
