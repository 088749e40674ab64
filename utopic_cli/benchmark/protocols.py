"""The synthetic protocols: which pairs they are made of, and in which units errors are counted.

Pair ``number`` depends on the shapes, the seed and its number alone: a longer run begins with the
pairs of a shorter one, and any process can make any pair.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from utopic_cli.errors import UsageError
from utopic_cli.preprocess import PreparedPair
from utopic_cli.synthesis.pairs import PairSettings, ScanPair, evaluation_pair, room_pair, surface_pair
from utopic_cli.synthesis.scan_pair import DegeneratePair
from utopic_cli.synthesis.settings import Range
from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.synthesis.surface import DegenerateShape
from utopic_cli.synthesis.warp import random_warp

POINTS = 1024
DETAIL_POINTS = 5000
DETAIL_RELIEF = 0.04
"""Amplitude over wavelength of the relief that plain shapes get under ``detail``."""

NOISE, CLIP = 0.01, 0.05
CROP_RADIUS = 0.075
"""The paper's r: points of two sparse clouds nearer than this overlap (radius of the object 1)."""

CROP_INLIER = 0.05
SCAN_REACH = 1.1
"""Nodes of two dense scans nearer than this many node spacings overlap (as training's labels have it)."""

SCAN_INLIER = 2.2
ATTEMPTS = 30
SAMPLINGS = ("shared", "independent")
ROTATIONS = ("uniform", "euler45")
SCAN_BANDS: tuple[Range, ...] = ((0.5, 0.9), (0.3, 0.5), (0.1, 0.3))


class AnyProtocol(Protocol):
    """What makes pairs and says how answers to them are measured."""

    @property
    def name(self) -> str:
        """Of the command."""
        ...

    @property
    def groups(self) -> tuple[str, ...]:
        """What the table's rows are grouped by."""
        ...

    @property
    def cleans(self) -> bool:
        """Whether scattered points are left out before sampling, as ``utopic align`` does."""
        ...

    def settings(self) -> dict[str, Any]:
        """Return the definition, JSON-ready."""
        ...

    def pair(self, library: ShapeLibrary, seed: int, number: int) -> ScanPair:
        """Make pair ``number`` of the test set ``seed``."""
        ...

    def unit(self, pair: ScanPair) -> float:
        """Length that errors are counted in."""
        ...

    def centre(self, pair: ScanPair) -> np.ndarray | None:
        """Source point at which translations are compared; None: the vectors."""
        ...

    def overlap_radius(self, prepared: PreparedPair) -> float:
        """Within which nodes overlap, normalised units."""
        ...

    def inlier_radius(self, prepared: PreparedPair) -> float:
        """Within which a match is an inlier, normalised units."""
        ...

    def group(self, number: int) -> str:
        """Name the group of a pair."""
        ...


@dataclass(frozen=True)
class CropProtocol:
    """The paper's (Sec. 4.1) half-space crops: ``modelnet``, ``modelonet``, ``scanobjectnn``, ``detail``.

    Each shape is scaled to the unit sphere, sampled, cropped on both sides by a half-space of random
    direction, disturbed by noise and moved. Shapes take turns in a seeded random order. Of a library
    that gives points (ModelNet40, ScanObjectNN) these are used, in their own scale.

    Attributes:
        name: of the command.
        keep: share of the points that each crop keeps (0.7; ``modelonet``: 0.5).
        sampling: ``shared`` (one sample, both clouds are crops of it: the paper's figures) or
            ``independent`` (two samples of one surface, as scanners make).
        rotations: ``euler45`` (each Euler angle uniform in 0 to 45 degrees, translation within 0.5:
            the paper's) or ``uniform`` over SO(3) for both clouds.
        points: sampled of each shape, before the crops.
        relief: strength of the relief that each shape gets (see ``random_warp``); 0: none.
    """

    name: str
    keep: float
    sampling: str
    rotations: str
    points: int = POINTS
    relief: float = 0.0

    def __post_init__(self) -> None:
        """Refuse unknown names.

        Raises:
            UsageError: of a sampling or of rotations.
        """
        for value, known in ((self.sampling, SAMPLINGS), (self.rotations, ROTATIONS)):
            if value not in known:
                raise UsageError(f"{value!r} is not known; choose {' or '.join(known)}")

    @property
    def groups(self) -> tuple[str, ...]:
        """What the table's rows are grouped by."""
        return (f"keep {self.keep:g}",)

    @property
    def cleans(self) -> bool:
        """Nothing is left out: what is measured is the network and the solve on the pair as it is."""
        return False

    def settings(self) -> dict[str, Any]:
        """Return the definition, JSON-ready."""
        compared = "of the vectors" if self.rotations == "euler45" else "at the source's centroid"
        return {
            **asdict(self),
            "noise": NOISE,
            "noise_clip": CLIP,
            "overlap_radius": CROP_RADIUS,
            "inlier_radius": CROP_INLIER,
            "length_unit": "radius of the object",
            "translation_error": compared,
        }

    def pair(self, library: ShapeLibrary, seed: int, number: int) -> ScanPair:
        """Make pair ``number`` of the test set ``seed``.

        Raises:
            DegeneratePair: no shape of many tried can be used.
        """
        rng = np.random.default_rng([seed, number])
        shape = int(np.random.default_rng(seed).permutation(len(library))[number % len(library)])
        reason: DegenerateShape | None = None
        for _ in range(ATTEMPTS):
            try:
                pair = surface_pair(
                    library.mesh(shape),
                    rng,
                    self.sampling,
                    self.keep,
                    count=self.points,
                    noise=NOISE,
                    clip=CLIP,
                    rotations=self.rotations,
                    sample=None if library.samples is None else library.samples[shape],
                    relief=random_warp(rng, strength=self.relief) if self.relief else None,
                    whole=True,
                )
            except DegenerateShape as error:
                reason = error
                shape = int(rng.integers(len(library)))
                continue
            return replace(pair, shape=str(library.names[shape]))
        raise DegeneratePair(f"no usable pair in {ATTEMPTS} draws; the last: {reason}")

    def unit(self, pair: ScanPair) -> float:
        """Length that errors are counted in: the object's radius."""
        return 1.0

    def centre(self, pair: ScanPair) -> np.ndarray | None:
        """Source point at which translations are compared; None: the vectors, as in the paper."""
        return None if self.rotations == "euler45" else pair.source.points.mean(axis=0)

    def overlap_radius(self, prepared: PreparedPair) -> float:
        """Within which nodes overlap, normalised units."""
        return CROP_RADIUS / prepared.scale

    def inlier_radius(self, prepared: PreparedPair) -> float:
        """Within which a match is an inlier, normalised units."""
        return CROP_INLIER / prepared.scale

    def group(self, number: int) -> str:
        """Name the group of a pair."""
        return self.groups[0]


@dataclass(frozen=True)
class SceneProtocol:
    """What protocols of dense scans in any pose have in common: errors are counted in extents of the scene.

    Attributes:
        pairs: what the scans are like; the training mixture's if not given.
    """

    pairs: PairSettings = field(default_factory=PairSettings)

    @property
    def cleans(self) -> bool:
        """Nothing is left out: what is measured is the network and the solve on the pair as it is."""
        return False

    def settings(self) -> dict[str, Any]:
        """Return the definition, JSON-ready."""
        return {
            **asdict(self),
            "overlap_reach_in_spacings": SCAN_REACH,
            "inlier_reach_in_spacings": SCAN_INLIER,
            "length_unit": "extent of the scene",
            "translation_error": "at the source's centroid",
        }

    def unit(self, pair: ScanPair) -> float:
        """Length that errors are counted in: the extent of the whole object or room."""
        return pair.extent

    def centre(self, pair: ScanPair) -> np.ndarray | None:
        """Source point at which translations are compared: its centroid."""
        return pair.source.points.mean(axis=0)

    def overlap_radius(self, prepared: PreparedPair) -> float:
        """Within which nodes overlap, normalised units."""
        return SCAN_REACH * prepared.spacing

    def inlier_radius(self, prepared: PreparedPair) -> float:
        """Within which a match is an inlier, normalised units."""
        return SCAN_INLIER * prepared.spacing


@dataclass(frozen=True)
class RangeProtocol(SceneProtocol):
    """``range-scans``: virtual range scans of whole objects from two sides, in random poses.

    The pairs of ``synthesis.pairs.evaluation_pairs``: dense, noisy, with holes and outliers as in
    training, rotations uniform over SO(3); the overlap bands take turns.

    Attributes:
        bands: overlap of the smaller side, at least the first number, less than the second.
        name: of the protocol.
    """

    bands: tuple[Range, ...] = SCAN_BANDS
    name: str = "range-scans"

    @property
    def groups(self) -> tuple[str, ...]:
        """What the table's rows are grouped by."""
        return tuple(f"{low:g}-{high:g}" for low, high in self.bands)

    def pair(self, library: ShapeLibrary, seed: int, number: int) -> ScanPair:
        """Make pair ``number`` of the test set ``seed``.

        Raises:
            DegeneratePair: the shapes have no such pair of views.
        """
        return evaluation_pair(library, seed, number, self.bands, self.pairs, whole=True)

    def group(self, number: int) -> str:
        """Name the group of a pair."""
        return self.groups[number % len(self.groups)]


@dataclass(frozen=True)
class RoomProtocol(SceneProtocol):
    """``rooms``: panoramic scans from two places in a room furnished with the shapes, in random poses.

    Attributes:
        least_overlap: of the smaller side.
        name: of the protocol.
    """

    least_overlap: float = 0.15
    name: str = "rooms"

    @property
    def groups(self) -> tuple[str, ...]:
        """What the table's rows are grouped by."""
        return ("rooms",)

    def pair(self, library: ShapeLibrary, seed: int, number: int) -> ScanPair:
        """Make pair ``number`` of the test set ``seed``.

        Raises:
            DegeneratePair: no usable pair in many draws.
        """
        rng = np.random.default_rng([seed, number])
        wanted = replace(self.pairs, minimum_overlap=self.least_overlap)
        reason: DegenerateShape | None = None
        for _ in range(ATTEMPTS):
            try:
                return replace(room_pair(library, rng, wanted, whole=True), shape="room")
            except DegenerateShape as error:
                reason = error
        raise DegeneratePair(f"no usable room in {ATTEMPTS} draws; the last: {reason}")

    def group(self, number: int) -> str:
        """Name the group of a pair."""
        return self.groups[0]
