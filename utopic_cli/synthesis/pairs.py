"""The training mixture and the seeded test pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from utopic_cli.synthesis.range_pairs import range_scan_pair
from utopic_cli.synthesis.rooms import room_pair
from utopic_cli.synthesis.scan_pair import DegeneratePair, ScanPair
from utopic_cli.synthesis.settings import KINDS, PairSettings, Range
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.synthesis.surface import DegenerateShape
from utopic_cli.synthesis.surface_pairs import patch_pair, surface_pair

__all__ = [
    "DegeneratePair",
    "PairSettings",
    "ScanPair",
    "evaluation_pair",
    "evaluation_pairs",
    "patch_pair",
    "random_pair",
    "range_scan_pair",
    "room_pair",
    "surface_pair",
]

EVALUATION_BANDS: tuple[Range, ...] = ((0.1, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 1.0))


def random_pair(
    library: ShapeLibrary, rng: np.random.Generator, settings: PairSettings | None = None
) -> ScanPair:
    """Draw a pair from the mixture.

    The kind is drawn once, so that the shares of the kinds are as set; shapes that turn out
    degenerate are replaced by others.

    Args:
        library: the meshes.
        rng: source of randomness; the same state gives the same pair.
        settings: probabilities and ranges; the training mixture's if None.

    Raises:
        DegeneratePair: no usable pair in ``settings.attempts`` draws.
    """
    settings = settings or PairSettings()
    weight = np.asarray(settings.kinds, dtype=np.float64)
    kind = KINDS[rng.choice(len(weight), p=weight / weight.sum())]
    band = settings.bands[rng.integers(len(settings.bands))]
    reason: DegenerateShape | None = None
    for _ in range(settings.attempts):
        try:
            if kind == "room":
                return room_pair(library, rng, settings)
            mesh = library.mesh(library.draw(rng))
            if kind == "range_scan":
                return range_scan_pair(mesh, rng, settings, band)
            if kind == "patch":
                return patch_pair(mesh, rng, settings)
            return _sparse_pair(mesh, rng, settings, kind)
        except DegenerateShape as error:
            reason = error
    raise DegeneratePair(f"no usable {kind} pair in {settings.attempts} draws; the last: {reason}")


def evaluation_pairs(
    library: ShapeLibrary,
    seed: int,
    count: int,
    bands: Sequence[Range] = EVALUATION_BANDS,
    settings: PairSettings | None = None,
) -> Iterator[ScanPair]:
    """Yield range-scan pairs for validation, the bands taking turns.

    Pair i depends on the library, the seed and i alone, so a longer run begins with the
    pairs of a shorter one.

    Args:
        library: the meshes, usually ``library.select("val")``.
        seed: names the test set.
        count: number of pairs.
        bands: overlap of the smaller side, [low, high) each; every pair lies in its band.
        settings: probabilities and ranges; the training mixture's if None.

    Raises:
        DegeneratePair: a band was not met in four times ``settings.attempts`` draws.
    """
    for number in range(count):
        yield evaluation_pair(library, seed, number, bands, settings)


def evaluation_pair(
    library: ShapeLibrary,
    seed: int,
    number: int,
    bands: Sequence[Range] = EVALUATION_BANDS,
    settings: PairSettings | None = None,
    *,
    whole: bool = False,
) -> ScanPair:
    """Make pair ``number`` of the test set of ``evaluation_pairs`` alone.

    Args:
        library: see there, as for ``seed``, ``bands`` and ``settings``.
        seed: names the test set.
        number: of the pair, from 0.
        bands: the band is the ``number``-th, round and round.
        settings: the training mixture's if None.
        whole: let a sample of the whole object travel with the pair.

    Raises:
        DegeneratePair: the band was not met in four times ``settings.attempts`` draws.
    """
    settings = settings or PairSettings()
    rng = np.random.default_rng([seed, number])
    low, high = bands[number % len(bands)]
    for _ in range(4 * settings.attempts):
        shape = library.draw(rng)
        try:
            pair = range_scan_pair(library.mesh(shape), rng, settings, (low, high), whole=whole)
        except DegenerateShape:
            continue
        if low <= pair.smaller_overlap < high:
            return replace(pair, shape=str(library.names[shape]))
    raise DegeneratePair(f"no pair with an overlap of {low:g} to {high:g} in {4 * settings.attempts} draws")


def _sparse_pair(
    mesh: tuple[np.ndarray, np.ndarray], rng: np.random.Generator, settings: PairSettings, kind: str
) -> ScanPair:
    pair = surface_pair(
        mesh,
        rng,
        sampling=kind,
        keep=rng.uniform(*settings.surface_keep),
        count=int(np.exp(rng.uniform(*np.log(settings.surface_points)))),
        noise=rng.uniform(*settings.surface_noise),
        clip=settings.surface_clip,
        rotations=settings.surface_rotations,
    )
    if pair.smaller_overlap < settings.minimum_overlap:
        raise DegeneratePair(f"overlap {pair.smaller_overlap:.2f} is under {settings.minimum_overlap:g}")
    return pair
