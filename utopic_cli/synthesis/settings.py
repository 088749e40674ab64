"""What synthetic pairs are like: probabilities and ranges, all in one place."""

from __future__ import annotations

from dataclasses import dataclass

from utopic_cli.errors import InputError

Range = tuple[float, float]

KINDS = ("range_scan", "independent", "shared", "patch", "room")
"""The recipes of pairs, in the order of ``PairSettings.kinds``."""


@dataclass(frozen=True)
class PairSettings:
    """Settings of the pair mixture. The defaults are what validation uses.

    Lengths are shares of the object's *extent* (the diagonal of its bounding box) unless said
    otherwise. A range is drawn from uniformly unless said otherwise.

    Attributes:
        kinds: relative weights of ``KINDS``, in their order; 0 for those left out at the end.
        bands: overlap bands (smaller side) that range pairs are drawn for, equally often.
        minimum_overlap: pairs below (smaller side) are never returned.
        thin_above: range pairs that come out above this overlap are kept only with
            probability ``keep_above``.
        keep_above: see ``thin_above``.
        view_angle: degrees between the two viewing directions.
        compact_probability: share of shapes that are made stouter if they are rods or plates, so
            that no principal standard deviation is less than the largest over ``compact``.
        compact: see above.
        stretch_probability: share of shapes stretched along random axes, by up to ``stretch``.
        stretch: largest factor.
        warp_probability: share of shapes warped smoothly; shapes that map onto themselves by
            half a turn (boxes, rods) are always warped.
        warp_strength: amplitude over wavelength of each octave of the warp.
        points: most points of a range scan, log-uniform; fewer if fewer are visible.
        dense_samples: samples of the whole surface a pair of scans is drawn from, per point wanted; and
            the least and the most in all.
        grazing_cosine: surfaces seen at a smaller cosine return nothing.
        noise: standard deviation of the range error along the ray; drawn as high * u^2, so
            that most scans are clean. Cut off at three standard deviations.
        rough_probability: share of scans whose noise is drawn from ``rough_noise`` instead.
        rough_noise: see above.
        slant_probability: share of scans whose density falls with the cosine of the viewing
            angle, as on a scanner's regular raster.
        ramp_probability: share of scans whose density changes across the object, up to 5 : 1.
        hole_probability: share of scans with 1 to 4 holes.
        hole_radius: radius of a hole.
        outlier_probability: share of scans with outliers.
        outlier_share: share of outliers in those.
        several_views_probability: share of scans merged from 2 or 3 views up to
            ``several_views_spread`` degrees from the first; they carry no viewpoint.
        several_views_spread: see above.
        translation: each scan is moved by up to this much along each axis (times the extent).
        surface_points: points per cloud of independent and shared pairs, log-uniform.
        surface_keep: share kept by the half-space crop of each.
        surface_noise: jitter per coordinate in units of the object's radius, cut off at
            ``surface_clip``.
        surface_clip: see above.
        surface_rotations: ``uniform`` over SO(3), or the paper's ``euler45``.
        patch_points: points per cloud of patch pairs, log-uniform.
        patch_keep: share of the whole surface in each patch.
        room_points: fewest and most points per scan of room pairs, log-uniform.
        attempts: draws tried before giving up on a pair.
    """

    kinds: tuple[float, ...] = (0.7, 0.13, 0.05, 0.07, 0.05)
    bands: tuple[Range, ...] = ((0.1, 0.3), (0.3, 0.5), (0.5, 0.9))
    minimum_overlap: float = 0.1
    thin_above: float = 0.7
    keep_above: float = 0.5
    view_angle: Range = (20.0, 150.0)
    compact_probability: float = 0.75
    compact: Range = (1.3, 4.0)
    stretch_probability: float = 0.5
    stretch: float = 1.6
    warp_probability: float = 0.75
    warp_strength: Range = (0.01, 0.045)
    points: tuple[int, int] = (4000, 40000)
    dense_samples: tuple[int, int, int] = (4, 80_000, 140_000)
    grazing_cosine: Range = (0.1, 0.25)
    noise: Range = (0.0, 0.004)
    rough_probability: float = 0.0
    rough_noise: Range = (0.004, 0.02)
    slant_probability: float = 0.5
    ramp_probability: float = 0.25
    hole_probability: float = 0.25
    hole_radius: Range = (0.03, 0.1)
    outlier_probability: float = 0.15
    outlier_share: Range = (0.002, 0.02)
    several_views_probability: float = 0.12
    several_views_spread: float = 35.0
    translation: float = 1.0
    surface_points: tuple[int, int] = (300, 1500)
    surface_keep: Range = (0.5, 0.9)
    surface_noise: Range = (0.0, 0.01)
    surface_clip: float = 0.05
    surface_rotations: str = "uniform"
    patch_points: tuple[int, int] = (4000, 20000)
    patch_keep: Range = (0.2, 0.5)
    room_points: tuple[int, int] = (2000, 20000)
    attempts: int = 30

    def __post_init__(self) -> None:
        """Refuse weights that no kind can be drawn by.

        Raises:
            InputError: too many kinds, a negative weight, or none above 0.
        """
        fits = len(self.kinds) <= len(KINDS) and min(self.kinds, default=0) >= 0 and sum(self.kinds) > 0
        if not fits:
            raise InputError(
                f"kinds is {list(self.kinds)}; give weights of {', '.join(KINDS)}, none negative, not all 0"
            )
