"""What is known of a transformation before the scans are looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.geometry import rigid

ANY_ROTATION = 180.0
"""Degrees: no rotation turns by more."""


@dataclass(frozen=True)
class Prior:
    """What is known of a transformation beforehand.

    Attributes:
        initial: (4, 4) T_target_source to try as well, or None.
        max_rotation: degrees that the source is turned by at most: from where it lies, or from where
            ``initial`` puts it.
    """

    initial: np.ndarray | None = None
    max_rotation: float = ANY_ROTATION

    def __post_init__(self) -> None:
        """Refuse what is no prior.

        Raises:
            ValueError: an initial transformation that is not rigid, or no angle in (0, 180].
        """
        if self.initial is not None and not rigid.is_rigid(np.asarray(self.initial)):
            raise ValueError("the initial transformation is not rigid")
        if not 0.0 < self.max_rotation <= ANY_ROTATION:
            raise ValueError(f"the largest rotation is {self.max_rotation}; give degrees in (0, 180]")

    @property
    def bounded(self) -> bool:
        """Whether some rotations are excluded."""
        return self.max_rotation < ANY_ROTATION

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) rotation that ``max_rotation`` counts from."""
        return np.eye(3) if self.initial is None else np.asarray(self.initial, np.float64)[:3, :3]

    @property
    def least_cosine(self) -> float:
        """Cosine of ``max_rotation``: no direction is turned by more than the rotation's angle."""
        return float(np.cos(np.radians(self.max_rotation)))

    def admits(self, transformations: np.ndarray) -> np.ndarray:
        """Tell which of (H, 4, 4) transformations turn the source by no more than that -> (H,) bool."""
        if not self.bounded:
            return np.ones(len(transformations), dtype=bool)
        trace = np.einsum("hij,ij->h", transformations[:, :3, :3], self.rotation)
        return trace >= 1.0 + 2.0 * self.least_cosine


ANYWHERE = Prior()
"""Nothing is known."""
