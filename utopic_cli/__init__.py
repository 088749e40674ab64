"""Align overlapping 3D scans with an uncertainty-aware overlap prediction network.

Convention, everywhere: ``p_target = T_target_source @ p_source``. SOURCE is the scan that
moves and is named first; TARGET stays. Lengths are in the files' own units, angles in
degrees, overlap and uncertainty per point in [0, 1]. All geometry outside the network is
float64.

    >>> from utopic_cli import align
    >>> result = align("a.ply", "b.ply")  # paths or (N, 3) / (M, 3) arrays
    >>> result.T_target_source            # (4, 4) float64
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from utopic_cli.pipeline import align as align

__version__ = "0.1.0"
__all__ = ["__version__", "align"]


def __getattr__(name: str) -> Any:
    """Import ``align`` on first use: it pulls in torch, which ``utopic --help`` must not."""
    if name == "align":
        from utopic_cli.pipeline import align

        return align
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
