"""What a batch is asked to do, and what it is about to do; nothing here writes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from utopic_cli.config import AlignOptions
from utopic_cli.errors import UsageError
from utopic_cli.io.output import check_folder
from utopic_cli.multiway import folder
from utopic_cli.multiway import pairs as choice
from utopic_cli.multiway.journal import KINDS
from utopic_cli.multiway.scans import ScanList, find_scans


@dataclass(frozen=True)
class BatchRequest:
    """A batch as asked for.

    Attributes:
        inputs: folders, patterns and files.
        out_dir: where everything goes.
        pairs: ``auto``, ``all``, ``sequential``, ``to-first``, or the path of a CSV file.
        options: of the pairwise registration; threads are those of each worker, at least 1.
        workers: processes on this machine.
        cluster: address of a Dask scheduler whose workers do the jobs instead, or None.
        timeout_s: seconds a pair may take.
        resume: go on with what is in ``out_dir``.
        overwrite: begin anew there, whatever is in it.
        merge: write merged clouds.
        voxel: edge length of the cells of merged clouds, or None for all points.
        page: write ``report.html``.
    """

    inputs: tuple[Path, ...]
    out_dir: Path
    pairs: str = "auto"
    options: AlignOptions = field(default_factory=lambda: AlignOptions(threads=1))
    workers: int = 1
    cluster: str | None = None
    timeout_s: float = 600.0
    resume: bool = False
    overwrite: bool = False
    merge: bool = False
    voxel: float | None = None
    page: bool = False


@dataclass(frozen=True)
class BatchPlan:
    """What a batch is about to do.

    Attributes:
        scans: the inputs.
        usable: numbers of the scans to align: those without a problem, copies left out.
        first: the pairs to begin with; None where the network has to describe the scans first.
        earlier: the records and results of an earlier batch in ``out_dir``.
    """

    scans: ScanList
    usable: tuple[int, ...]
    first: tuple[choice.Pair, ...] | None
    earlier: tuple[Path, ...] = ()


def plan_batch(request: BatchRequest) -> BatchPlan:
    """Find the scans and the pairs to begin with; nothing is written.

    Raises:
        InputError: there are too few files, or the list of pairs is not sound.
        OutputError: ``out_dir`` is a file or can't be made.
        UsageError: an option names nothing known, or results would land among the scans.
    """
    for given in request.inputs:
        if given.is_dir() and os.path.realpath(given) == os.path.realpath(request.out_dir):
            raise UsageError(f"{given}: holds the scans; choose another --out-dir, or a folder inside it")
    if request.resume and request.overwrite:
        raise UsageError("--resume keeps what is done and --overwrite discards it; choose one")
    check_folder(request.out_dir)
    scans = find_scans(request.inputs)
    _keep_apart(scans, request.out_dir)
    usable = tuple(i for i, scan in enumerate(scans.scans) if scan.problem is None and scan.copy_of is None)
    earlier = tuple(folder.earlier(request.out_dir))
    return BatchPlan(scans, usable, first_pairs(request.pairs, scans, usable), earlier)


def _keep_apart(scans: ScanList, out_dir: Path) -> None:
    """Refuse scans that lie where results are written, and replaced."""
    own = {os.path.realpath(place) for place in (out_dir, *(out_dir / kind for kind in KINDS))}
    for scan in scans.scans:
        if os.path.realpath(scan.path.parent) in own:
            raise UsageError(f"{scan.path}: lies where the results go; choose another --out-dir")


def first_pairs(mode: str, scans: ScanList, usable: Sequence[int]) -> tuple[choice.Pair, ...] | None:
    """Return the pairs to begin with; None where the scans have to be described first.

    Args:
        mode: see ``BatchRequest.pairs``.
        scans: all scans.
        usable: numbers of those that can be aligned, ascending.

    Raises:
        InputError: the list of pairs is not sound.
        UsageError: there is no such mode.
    """
    if mode == "all" or (mode == "auto" and len(usable) <= choice.FEW_SCANS):
        return tuple(choice.every_pair(usable))
    if mode == "auto":
        return None
    if mode == "sequential":
        return tuple(choice.sequential_pairs(usable))
    if mode == "to-first":
        return tuple(choice.pairs_to_first(usable))
    if not mode.lower().endswith(".csv"):
        raise UsageError(f"--pairs {mode}: choose {', '.join(choice.MODES)} or a .csv file")
    numbers = {scan.name: number for number, scan in enumerate(scans.scans)}
    original = [i if scan.copy_of is None else numbers[scan.copy_of] for i, scan in enumerate(scans.scans)]
    listed = ((original[a], original[b]) for a, b in choice.read_pairs(Path(mode), scans.scans))
    once: dict[frozenset[int], choice.Pair] = {}
    for pair in listed:
        if len(set(pair)) == 2 and set(pair) <= set(usable):
            once.setdefault(frozenset(pair), pair)
    return tuple(once.values())
