"""What a worker process does: describe one scan, or register two; plain data in and out."""

from __future__ import annotations

import base64
import socket
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli import __version__
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError
from utopic_cli.io.scan import Scan, read_scan
from utopic_cli.multiway.journal import fingerprint
from utopic_cli.multiway.vocabulary import LENGTH, shorten
from utopic_cli.multiway.workers import NotNow

MOST_POINTS_HELD = 6_000_000
"""A worker remembers scans up to this many points together, two at least."""

SAMPLE = 2000
"""Points of a scan that its description holds, to draw it."""


@dataclass(frozen=True)
class ScanRef:
    """A file to read, and the bytes it must still have."""

    path: Path
    sha256: str


@dataclass(frozen=True)
class DescribeJob:
    """Describe a scan; ``descriptors``: what the network sees of it, too."""

    scan: ScanRef
    descriptors: bool


@dataclass(frozen=True)
class RegisterJob:
    """Register a pair."""

    source: ScanRef
    target: ScanRef


Job = DescribeJob | RegisterJob


def make_worker(options: AlignOptions, version: str, card: str) -> Callable[[Job], dict[str, Any]]:
    """Return the task of one process: a job in, its record out.

    The task raises ``InputError`` for scans that can't be read or pairs that can't be registered, and
    ``NotNow`` for pairs of scans that could be read before.

    Args:
        options: of the pairwise registration.
        version: of this package, that the batch runs with.
        card: fingerprint of the weights' card there.

    Raises:
        NotNow: on this machine, or by now, one of these is another.
    """
    from utopic_cli.bridge import load_network

    _, own_card = load_network(options.weights, options.device)  # before there is a job to take its time
    for kind, own, wanted in (
        ("version of utopic-cli", __version__, version),
        ("card of the weights", fingerprint(own_card), card),
    ):
        if own != wanted:
            raise NotNow(
                f"{socket.gethostname()} has another {kind} ({own[:12]}) than the batch ({wanted[:12]}); "
                "install the same there"
            )
    reader = Reader(options.seed)

    def work(job: Job) -> dict[str, Any]:
        if isinstance(job, DescribeJob):
            return describe(reader(job.scan), options, job.descriptors)
        try:
            both = reader(job.source), reader(job.target)
        except InputError as error:  # it could be read when it was described
            raise NotNow(str(error)) from None
        return register(*both, options)

    return work


def describe(scan: Scan, options: AlignOptions, descriptors: bool) -> dict[str, Any]:
    """Return a scan's size and shape as JSON-ready data.

    Keys: ``points``; ``centroid`` (3) and ``moments`` (3, 3), the covariance of the points, file
    units; ``warnings``; ``sample``, see ``sample_of``; ``descriptors`` if asked for, see
    ``descriptors_of``.
    """
    points = scan.cloud.points
    centroid = points.mean(axis=0)
    centred = points - centroid
    rng = np.random.default_rng(options.seed)
    drawn = np.sort(rng.choice(len(points), min(SAMPLE, len(points)), replace=False))
    record = {
        "points": len(points),
        "centroid": centroid.tolist(),
        "moments": (centred.T @ centred / len(points)).tolist(),
        "warnings": list(scan.warnings),
        # As text it is small on the disk and in memory, however many scans there are.
        "sample": _as_text(centred[drawn].astype("<f4")),
    }
    if descriptors:
        record["descriptors"] = _as_text(shorten(_point_descriptors(scan, options)))
    return record


def _as_text(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")


def sample_of(description: Mapping[str, Any]) -> np.ndarray:
    """Return some points of a scan, (K, 3) float64 in file units, from its description."""
    stored = np.frombuffer(base64.b64decode(description["sample"]), "<f4").reshape(-1, 3)
    return stored.astype(np.float64) + description["centroid"]


def descriptors_of(description: Mapping[str, Any]) -> np.ndarray:
    """Return what the network sees of a scan, (N, LENGTH) int8, from its description; see ``vocabulary``."""
    return np.frombuffer(base64.b64decode(description["descriptors"]), np.int8).reshape(-1, LENGTH)


def _point_descriptors(scan: Scan, options: AlignOptions) -> np.ndarray:
    """Return the descriptors (N, D) of a scan's sampled points, the same in any pose."""
    import torch

    from utopic_cli.bridge import cpu_threads, load_network, to_cloud_input
    from utopic_cli.preprocess import prepare

    model, _ = load_network(options.weights, options.device)
    with cpu_threads(options.threads), torch.inference_mode():
        prepared = prepare(scan.cloud, scan.cloud, options.points)
        cloud = to_cloud_input(prepared.source, prepared.spacing, model.config.neighbours)
        _, descriptors = model.extractor(cloud.to(next(model.parameters()).device))
    return np.asarray(descriptors[0].cpu().numpy(), np.float64)


def register(source: Scan, target: Scan, options: AlignOptions) -> dict[str, Any]:
    """Return the report of one registration, as ``utopic align`` writes it."""
    from utopic_cli import pipeline
    from utopic_cli.report import build_report

    result = pipeline.register(source.cloud, target.cloud, options)
    return build_report(source, target, result)


class Reader:
    """Reads scans, and remembers the last few."""

    def __init__(self, seed: int) -> None:
        """Prepare; ``seed`` is that of points drawn from meshes."""
        self._seed = seed
        self._held: OrderedDict[Path, Scan] = OrderedDict()

    def __call__(self, wanted: ScanRef) -> Scan:
        """Return a scan.

        Raises:
            InputError: it can't be read, or is not what it was.
        """
        scan = self._held.pop(wanted.path, None)
        if scan is None:
            scan = read_scan(wanted.path, seed=self._seed)
            if scan.sha256 != wanted.sha256:
                raise InputError(f"{wanted.path}: has changed since the batch began; run it again")
        self._held[wanted.path] = scan
        while len(self._held) > 2 and sum(held.records for held in self._held.values()) > MOST_POINTS_HELD:
            self._held.popitem(last=False)
        return scan
