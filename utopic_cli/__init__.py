"""Align overlapping 3D scans with an uncertainty-aware overlap prediction network.

Convention, everywhere: ``p_target = T_target_source @ p_source``. SOURCE is the scan that
moves and is named first; TARGET stays. Lengths are in the files' own units, angles in
degrees, overlap and uncertainty per point in [0, 1]. All geometry outside the network is
float64.

    >>> from utopic_cli import align, save
    >>> result = align("a.ply", "b.ply")  # paths or (N, 3) / (M, 3) arrays
    >>> result.T_target_source            # (4, 4) float64
    >>> save(result, "a.ply", "b.ply", "result")  # the files that "utopic align --out-dir" writes
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from utopic_cli.commands.save_result import save as save
    from utopic_cli.errors import InputError as InputError
    from utopic_cli.errors import OutputError as OutputError
    from utopic_cli.errors import UsageError as UsageError
    from utopic_cli.errors import UtopicError as UtopicError
    from utopic_cli.pipeline import align as align
    from utopic_cli.result import RegistrationResult as RegistrationResult

__version__ = "0.1.0"
__all__ = [
    "InputError",
    "OutputError",
    "RegistrationResult",
    "UsageError",
    "UtopicError",
    "__version__",
    "align",
    "save",
]

# Steps and warnings go to the logger "utopic_cli", silent until a program asks for it.
logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import on first use: ``align`` pulls in torch, which ``utopic --help`` must not."""
    if name == "align":
        from utopic_cli.pipeline import align

        return align
    if name == "save":
        from utopic_cli.commands.save_result import save

        return save
    if name == "RegistrationResult":
        from utopic_cli.result import RegistrationResult

        return RegistrationResult
    if name in ("InputError", "OutputError", "UsageError", "UtopicError"):
        from utopic_cli import errors

        return getattr(errors, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
