"""Labelled trials: pairs that can be aligned, and pairs that can't, for judging a verdict.

``trial(shapes, seed, number)`` makes one; about half of all have an answer that a good method finds.
The calibration of a confidence uses ``calibration_half`` of the held-out shapes, its measurement
``bench_half``; trials of the two never meet, not even those that need no shape.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from utopic_cli.benchmark import trial_scans, trial_solids
from utopic_cli.benchmark.held_out import held_out
from utopic_cli.benchmark.labelled import Trial
from utopic_cli.errors import InputError, UsageError
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.shapes import ShapeLibrary, pack
from utopic_cli.synthesis.surface import DegenerateShape

__all__ = ["KINDS", "Trial", "bench_half", "calibration_half", "trial"]

Maker = Callable[[ShapeLibrary, np.random.Generator], Trial]

MAKERS: dict[str, tuple[float, Maker]] = {
    "scans": (0.28, trial_scans.scans),
    "several-views": (0.05, trial_scans.several_views),
    "patch": (0.06, trial_scans.patch),
    "sparse": (0.07, trial_scans.sparse),
    "symmetric-shape": (0.04, trial_scans.symmetric_shape),
    "near-symmetric": (0.08, trial_solids.near_symmetric),
    "room": (0.07, trial_solids.room),
    "little": (0.07, trial_scans.little),
    "disjoint": (0.09, trial_scans.disjoint),
    "different": (0.07, trial_scans.different),
    "mirrored": (0.05, trial_scans.mirrored),
    "symmetric": (0.07, trial_solids.symmetric),
}
"""Share of all trials, and the recipe, of each kind."""

KINDS = tuple(MAKERS)
ATTEMPTS = 60
GOLDEN = (5**0.5 - 1.0) / 2.0


def trial(shapes: ShapeLibrary, seed: int, number: int, kinds: Sequence[str] = KINDS) -> Trial:
    """Make trial ``number`` of the set ``seed``; it depends on the arguments alone.

    The kinds come in their shares of ``MAKERS``, spread evenly over the numbers.

    Args:
        shapes: the shapes to scan, held out from training. Another library gives other trials
            throughout.
        seed: names the set.
        number: from 0.
        kinds: only these.

    Raises:
        DegeneratePair: no trial of the kind in ``ATTEMPTS`` draws.
        UsageError: an unknown kind, or none.
    """
    unknown = sorted(set(kinds) - set(MAKERS))
    if unknown or not kinds:
        raise UsageError(f"no such kind: {', '.join(unknown) or 'none given'}; choose {', '.join(KINDS)}")
    bounds = np.cumsum([MAKERS[kind][0] for kind in kinds])
    # Multiples of the golden ratio fill the unit interval evenly, whatever their number.
    place = (GOLDEN * (number + 0.5)) % 1.0 * bounds[-1]
    kind = kinds[min(int(np.searchsorted(bounds, place, side="right")), len(kinds) - 1)]
    rng = np.random.default_rng([seed, number, zlib.crc32("\n".join(shapes.names.tolist()).encode())])
    reason: DegenerateShape | None = None
    for _ in range(ATTEMPTS):
        try:
            return MAKERS[kind][1](shapes, rng)
        except DegenerateShape as error:
            reason = error
    raise DegeneratePair(f"no {kind} trial in {ATTEMPTS} draws; the last: {reason}")


def calibration_half(shapes: ShapeLibrary) -> ShapeLibrary:
    """Return the half of the held-out shapes that a calibration may see.

    Args:
        shapes: a library; only its ``test`` or else ``val`` shapes are taken.

    Raises:
        InputError: there are none.
    """
    return _half(shapes, 0)


def bench_half(shapes: ShapeLibrary) -> ShapeLibrary:
    """Return the other half of the held-out shapes, for measuring; see ``calibration_half``."""
    return _half(shapes, 1)


def _half(shapes: ShapeLibrary, parity: int) -> ShapeLibrary:
    """Choose by a hash of the name, so that a library that grows moves no shape to the other half."""
    library, split = held_out(shapes)
    hashes = np.array([zlib.crc32(name.encode()) for name in library.names.tolist()])
    chosen = np.flatnonzero(hashes % 2 == parity)
    if not len(chosen):
        raise InputError(
            f"the library's {len(library)} '{split}' shapes can't be halved: a tenth of all shapes is held "
            "out, so give a hundred or more"
        )
    meshes = [library.mesh(int(i)) for i in chosen]
    return pack(meshes, library.names[chosen], library.splits[chosen], library.sets[chosen])
