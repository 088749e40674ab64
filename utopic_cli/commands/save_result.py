"""What ``utopic align --out-dir`` writes, for programs that call ``align`` themselves."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from utopic_cli.commands.outputs import check_outputs, plan_outputs, write_answer
from utopic_cli.config import DEFAULT_COLOUR_MAP, ColourMapName
from utopic_cli.errors import OutputError, UsageError
from utopic_cli.given import as_read, scan_of
from utopic_cli.io.colour import COLOUR_MAPS
from utopic_cli.result import RegistrationResult

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def save(
    result: RegistrationResult,
    source: str | PathLike[str] | ArrayLike,
    target: str | PathLike[str] | ArrayLike,
    out_dir: str | PathLike[str],
    *,
    colormap: ColourMapName = DEFAULT_COLOUR_MAP,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write the whole set of files that ``utopic align --out-dir`` writes.

    Args:
        result: what ``align`` returned.
        source: the scan that moved, as ``align`` was given it; an array becomes ``source.ply``.
        target: the scan that stayed, likewise.
        out_dir: the folder; made if only it itself is missing.
        colormap: the colours of overlap and uncertainty.
        overwrite: whether existing files may be replaced; inputs never are.

    Returns:
        The files: ``transformation.txt``, the aligned scan, four coloured clouds, ``report.html`` and,
        written last, ``report.json``.

    Raises:
        InputError: a scan can't be read any more.
        OutputError: a file exists or can't be written; then none is.
        UsageError: the scans are not those of the result, or there is no such colour map.
    """
    if colormap not in COLOUR_MAPS:
        raise UsageError(f"{colormap}: no such colour map; choose {', '.join(COLOUR_MAPS)}")
    seed = int(result.options.get("seed", 0))
    moving, still = scan_of(source, "source", seed), scan_of(target, "target", seed)
    plan = plan_outputs(moving.path, out_dir=Path(out_dir))
    read = [Path(scan) for scan in (source, target) if isinstance(scan, (str, PathLike))]
    try:
        check_outputs(plan, read, overwrite)
        own = as_read(result, moving, still)
        write_answer(plan, moving, still, own, colormap=colormap, overwrite=overwrite)
    except OutputError as error:
        raise OutputError(str(error).replace("pass --overwrite", "pass overwrite=True")) from None
    return plan.paths
