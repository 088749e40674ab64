"""KISS-Matcher (the package ``kiss-matcher``, MIT licence) behind the interface of `Method`."""

from __future__ import annotations

import faulthandler
import multiprocessing
import signal
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from utopic_cli.benchmark.method import Trial
from utopic_cli.errors import UsageError, optional_part
from utopic_cli.geometry.rigid import rigid

Answer = tuple[np.ndarray, np.ndarray]
"""A rotation (3, 3) and a translation (3,)."""


@dataclass(frozen=True)
class KissMatcher:
    """KISS-Matcher: Faster-PFH, k-core pruning of the matches, graduated non-convexity.

    It asks for a voxel size, refuses one under 0.005 and cuts its noise bounds off at 1, whatever
    the unit. So each pair is centred and scaled to a unit in which its own default, 0.3, is the
    voxel that did best for it on the very scans it is measured on: of the extent over 30, 50, 80,
    120, 160 and 200, the extent over 120. Sparse scans get larger ones, as it finds nothing with
    voxels near the points' own spacing. Everything else is as its authors set it.

    On some clouds (with voxels far below the spacing, for one) its native code crashes, which no
    ``except`` can catch. It therefore runs in a forked process, which costs some milliseconds:
    fork and not spawn, so that starting Python and importing it are not charged to it.

    Attributes:
        name: what the tables call it.
        voxels_per_extent: the voxel size is the pair's extent divided by this,
        spacings_per_voxel: but at least so many times the spacing of the sparser scan's points.
        voxel_size: the voxel size in the unit the pair is scaled to.
        patience_s: an estimate that takes longer is given up.
        refines: never by our own refinement; it is given its estimate to refine like everybody's.
    """

    name: str = "kiss-matcher"
    voxels_per_extent: float = 120.0
    spacings_per_voxel: float = 2.5
    voxel_size: float = 0.3
    patience_s: float = 300.0
    refines: bool = False

    def settings(self) -> dict[str, Any]:
        """Return the fields and the package's version (see `Method.settings`).

        Raises:
            UsageError: the package is missing, or there is no way to contain its crashes here.
        """
        if "fork" not in multiprocessing.get_all_start_methods():
            raise UsageError("the baseline kiss-matcher runs on Linux and macOS only; leave it out")
        return {**asdict(self), "kiss_matcher": load_kiss_matcher().__version__}

    def estimate(self, trial: Trial) -> np.ndarray:
        """Register the clouds of a trial.

        Raises:
            RuntimeError: it found no transformation, crashed, or took too long.
        """
        library = load_kiss_matcher()
        per_unit = self.voxel_size / trial.voxel(self.voxels_per_extent, self.spacings_per_voxel)
        source_centre, target_centre = (cloud.points.mean(axis=0) for cloud in (trial.source, trial.target))
        source, target = (
            ((cloud.points - centre) * per_unit).astype(np.float32)  # all that it takes
            for cloud, centre in ((trial.source, source_centre), (trial.target, target_centre))
        )

        def work() -> Answer | None:
            solution = library.KISSMatcher(library.KISSMatcherConfig(voxel_size=self.voxel_size)).estimate(
                list(source), list(target)
            )
            return (np.array(solution.rotation), np.array(solution.translation)) if solution.valid else None

        answer = answer_of_child(work, self.patience_s)
        if answer is None:
            raise RuntimeError("no valid solution")
        rotation, translation = answer
        return rigid(rotation, translation.ravel() / per_unit + target_centre - rotation @ source_centre)


def load_kiss_matcher() -> Any:
    """Import KISS-Matcher.

    Raises:
        UsageError: it can't be loaded; says why and the command that installs it.
    """
    with optional_part("the baseline kiss-matcher needs KISS-Matcher", "kiss-matcher"):
        import kiss_matcher
    return kiss_matcher


def answer_of_child(work: Callable[[], Answer | None], patience_s: float) -> Answer | None:
    """Run ``work`` in a forked process, so that native code that crashes takes nothing with it.

    Args:
        work: called in the child.
        patience_s: seconds after which the child is ended.

    Raises:
        RuntimeError: ``work`` raised, or the child died or took too long.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_send_answer, args=(work, there), daemon=True)
    child.start()
    there.close()  # else a dead child's end of the pipe would stay open here
    try:
        if not here.poll(patience_s):
            raise RuntimeError(f"no answer within {patience_s:g} s")
        try:
            answer, message = here.recv()
        except EOFError:
            child.join()
            raise RuntimeError(f"it crashed ({_how_it_ended(child.exitcode)})") from None
    finally:
        child.kill()  # after its answer it has nothing left to do
        child.join()  # which also counts its CPU time
        here.close()
    if message is not None:
        raise RuntimeError(message)
    return answer


def _send_answer(work: Callable[[], Answer | None], there: Connection) -> None:
    faulthandler.disable()  # a crash is told in the parent, in one line

    def answer() -> None:
        try:
            there.send((work(), None))
        except Exception as error:  # whatever it raises is told in the parent
            there.send((None, f"{type(error).__name__}: {error}"))

    # Where the parent has used OpenMP, the thread that was forked would wait for ever for its other
    # threads, which were not. A new one brings its own.
    thread = threading.Thread(target=answer)
    thread.start()
    thread.join()


def _how_it_ended(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return signal.Signals(-exitcode).name
    return f"exit code {exitcode}"
