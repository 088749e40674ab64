"""A batch as a few verbs: find scans, describe them, try pairs, connect, write."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from utopic_cli import __version__
from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError, optional_part
from utopic_cli.io.output import write_together
from utopic_cli.multiway import folder
from utopic_cli.multiway import pairs as choice
from utopic_cli.multiway.edges import ScanShape
from utopic_cli.multiway.journal import Journal, fingerprint
from utopic_cli.multiway.lock import locked
from utopic_cli.multiway.merge import fields_lost, write_merged
from utopic_cli.multiway.model import Model, build_model
from utopic_cli.multiway.outcome import BatchOutcome, ScanEntry, pair_name, why_alone
from utopic_cli.multiway.pace import Pace, Progress
from utopic_cli.multiway.page import batch_page
from utopic_cli.multiway.plan import BatchPlan, BatchRequest, first_pairs, plan_batch
from utopic_cli.multiway.scans import ScanFile
from utopic_cli.multiway.tables import poses_csv, poses_json, poses_txt, summary_csv
from utopic_cli.multiway.tasks import DescribeJob, RegisterJob, ScanRef, descriptors_of, make_worker
from utopic_cli.multiway.vocabulary import word_frequencies
from utopic_cli.multiway.workers import Task, Workers

if TYPE_CHECKING:
    from utopic_cli.multiway.cluster import Cluster

Record = dict[str, Any]

RECORD_VERSION = 2
MOST_PROBLEMS_SAID = 10
CONTENT = {"scans": "description", "pairs": "report"}


def run_batch(
    request: BatchRequest,
    *,
    progress: Progress | None = None,
    make_task: Callable[[], Task] | None = None,
    planned: Callable[[BatchPlan], None] | None = None,
) -> BatchOutcome:
    """Align scans into groups and write everything asked for.

    Args:
        request: see ``BatchRequest``.
        progress: called with a word on what is at work.
        make_task: stands in for ``tasks.make_worker``, see ``Workers``.
        planned: called with what is about to be done, once nothing is in its way.

    Returns:
        What it came to; its ``exit_code`` says whether all scans connect.

    Raises:
        InputError: no scan can be read, the weights can't be used, or the cluster can't.
        OutputError: a file can't be written, an earlier batch is in the way, or another is at
            work in ``out_dir``. What is done stays.
        UsageError: options contradict each other, or a part that one needs is not installed.
    """
    return _Batch(request, progress or (lambda step: None), make_task).run(planned)


class _Batch:
    """One batch at work."""

    def __init__(
        self, request: BatchRequest, progress: Progress, make_task: Callable[[], Task] | None
    ) -> None:
        options = replace(request.options, threads=max(1, request.options.threads))
        self._request = request
        self._options = options
        self._progress = progress
        self._make_task = make_task
        self._resumed = 0
        self._waited_s = 0.0

    def run(self, planned: Callable[[BatchPlan], None] | None) -> BatchOutcome:
        """Do everything, in order."""
        begin = time.monotonic()
        request = self._request
        self._progress("looking at the scans")
        plan = plan_batch(request)
        self._files = plan.scans.scans
        self._weights = weights_of(self._options)
        with self._staff() as workers:
            self._workers = workers
            folder.make_folder(request.out_dir)
            with locked(request.out_dir):
                if not (request.resume or request.overwrite):
                    folder.check_earlier(request.out_dir)
                self._journal = Journal(request.out_dir)
                folder.sweep(request.out_dir)
                if request.overwrite:
                    # First the mark of a whole set, which it no longer is.
                    (request.out_dir / "poses.json").unlink(missing_ok=True)
                    self._journal.clear()
                if planned is not None:
                    planned(plan)
                described = self._describe(plan)
                model, records = self._align(plan, described)
                workers.close()  # merging can do with their memory
                outcome = self._outcome(plan, described, model, records, time.monotonic() - begin)
                self._write(outcome)
        return outcome

    def _staff(self) -> Workers | Cluster:
        """Return who does the jobs: processes here, or those of a cluster."""
        make_task = self._make_task or partial(make_worker, self._options, __version__, self._weights["card"])
        limits = (self._request.timeout_s, self._options.threads)
        if self._request.cluster is None:
            return Workers(make_task, self._request.workers, *limits)
        with optional_part("--cluster needs Dask", "'utopic-cli[cluster]'"):
            from utopic_cli.multiway.cluster import Cluster
        self._progress("reaching the cluster")
        return Cluster(self._request.cluster, make_task, *limits)

    def _describe(self, plan: BatchPlan) -> dict[int, Record]:
        """Describe every usable scan; records by number."""
        wanted = plan.first is None
        jobs, names, marks = [], [], []
        for number in plan.usable:
            scan = self._files[number]
            jobs.append(DescribeJob(_ref(scan), wanted))
            names.append(scan.name)
            marks.append(self._mark("scan", "descriptors" if wanted else "", scan.sha256))
        records = dict(zip(plan.usable, self._do("scans", names, marks, jobs), strict=True))
        if not any(record["status"] == "done" for record in records.values()):
            problems = [scan.problem for scan in self._files if scan.problem]
            problems += [record["problem"] for record in records.values()]
            said = " | ".join(problems[:MOST_PROBLEMS_SAID])
            more = f" | and {len(problems) - MOST_PROBLEMS_SAID} more" * (len(problems) > MOST_PROBLEMS_SAID)
            raise InputError(f"none of {len(self._files)} scans can be read: {said}{more}")
        return records

    def _align(
        self, plan: BatchPlan, described: dict[int, Record]
    ) -> tuple[Model, dict[choice.Pair, Record]]:
        """Try pairs, round by round, until nothing more is promising."""
        shapes, seen = {}, {}
        for number, record in described.items():
            if record["status"] == "done":
                content = record["description"]
                shapes[number] = ScanShape(np.array(content["centroid"]), np.array(content["moments"]))
                if plan.first is None:
                    seen[number] = descriptors_of(content)
                    del content["descriptors"]  # long, and not asked for again
        records: dict[choice.Pair, Record] = {}
        # Neighbours, and the first, are those among the scans that turned out to be readable.
        first = None if plan.first is None else first_pairs(self._request.pairs, plan.scans, sorted(shapes))
        looks = word_frequencies(seen)
        todo = list(first) if first is not None else choice.similar_pairs(looks)
        rounds = choice.MOST_ROUNDS if plan.first is None else 1
        model = build_model(records, shapes)
        while todo and rounds:
            records.update(self._register([pair for pair in todo if set(pair) <= shapes.keys()]))
            self._progress("connecting")
            model = build_model(records, shapes)
            rounds -= 1
            todo = choice.further_pairs(model, looks, set(records)) if rounds else []
        return model, records

    def _register(self, pairs: Sequence[choice.Pair]) -> dict[choice.Pair, Record]:
        jobs, names, marks = [], [], []
        for source, target in pairs:
            both = (self._files[source], self._files[target])
            jobs.append(RegisterJob(*map(_ref, both)))
            names.append(pair_name(*both))
            marks.append(self._mark("pair", both[0].sha256, both[1].sha256))
        return dict(zip(pairs, self._do("pairs", names, marks, jobs), strict=True))

    def _do(self, kind: str, names: list[str], marks: list[str], jobs: list[Any]) -> list[Record]:
        """Do jobs that no record is there for; returns the records in the order of the jobs."""
        found = {i: self._journal.load(kind, names[i], marks[i]) for i in range(len(jobs))}
        records = {i: record for i, record in found.items() if record is not None}
        if kind == "pairs":
            self._resumed += len(records)
        left = [i for i in range(len(jobs)) if i not in records]
        pace = Pace(kind, len(jobs), len(left), self._progress)
        begin = time.monotonic()
        for place, outcome in self._workers.run([jobs[i] for i in left]):
            i = left[place]
            status = "done" if outcome.problem is None else "refused" if outcome.lasting else "failed"
            record: Record = {
                "status": status,
                "problem": outcome.problem,
                "seconds": round(outcome.seconds, 3),
            }
            if outcome.result is not None:
                record[CONTENT[kind]] = outcome.result
            records[i] = self._journal.commit(kind, names[i], marks[i], record)
            pace.step(names[i])
        self._waited_s += time.monotonic() - begin
        return [records[i] for i in range(len(jobs))]

    def _mark(self, *content: Any) -> str:
        """Return the fingerprint of a job: all that its answer follows from."""
        version = [RECORD_VERSION, __version__]
        options = {name: value for name, value in asdict(self._options).items() if name != "weights"}
        return fingerprint([version, self._weights, options, *content])

    def _outcome(
        self,
        plan: BatchPlan,
        described: dict[int, Record],
        model: Model,
        records: dict[choice.Pair, Record],
        seconds: float,
    ) -> BatchOutcome:
        group_of = model.group_of()
        numbers = {scan.name: number for number, scan in enumerate(self._files)}
        entries = []
        for own, scan in enumerate(self._files):
            number = own if scan.copy_of is None else numbers[scan.copy_of]
            record = described.get(number)
            problem = scan.problem or (record["problem"] if record else None)
            if problem is not None:
                doubtful = scan.doubtful and (not record or record["status"] == "refused")
                reasons = (None, problem) if doubtful else (problem, None)
                entries.append(ScanEntry(scan, None, left_out=reasons[0], passed_over=reasons[1]))
                continue
            assert record is not None  # what has no problem has been described
            entry = ScanEntry(scan, int(record["description"]["points"]))
            if number in group_of:
                group = group_of[number]
                place = model.groups[group].T_world_scan[number]
                entries.append(replace(entry, group=group + 1, T_world_scan=place))
            else:
                entries.append(replace(entry, left_out=why_alone(number, model, self._files, records)))
        warnings = [
            text if str(self._files[number].path) in text else f"{self._files[number].path}: {text}"
            for number, record in described.items()
            if record["status"] == "done"
            for text in record["description"]["warnings"]
        ]
        if self._request.merge:
            warnings += fields_lost(self._files[number] for number in sorted(group_of))
        return BatchOutcome(
            tuple(entries),
            model,
            {n: record["description"] for n, record in described.items() if record["status"] == "done"},
            records,
            (*plan.scans.notes, *warnings),
            self._weights,
            asdict(self._options),
            self._request.pairs,
            seconds,
            self._waited_s,
            self._resumed,
            plan.scans.aside,
        )

    def _write(self, outcome: BatchOutcome) -> None:
        """Write the results; ``poses.json`` is last: with it the set is whole."""
        out = self._request.out_dir
        merged = []
        if self._request.merge:
            files = dict(enumerate(self._files))
            for number, group in enumerate(outcome.model.groups, 1):
                merged.append(out / folder.merged_name(number))
                write_merged(
                    merged[-1],
                    group.T_world_scan,
                    files,
                    seed=self._options.seed,
                    voxel=self._request.voxel,
                    overwrite=True,
                    progress=self._progress,
                )
        self._progress("writing")
        contents = {
            out / "summary.csv": summary_csv(outcome),
            out / "poses.txt": poses_txt(outcome),
            out / "poses.csv": poses_csv(outcome),
        }
        if self._request.page:
            contents[out / "report.html"] = batch_page(outcome)
        contents[out / "poses.json"] = poses_json(outcome)
        write_together(contents, overwrite=True)
        for path in folder.results(out):  # of an earlier run, and not of this one
            if path not in contents and path not in merged:
                path.unlink(missing_ok=True)


def weights_of(options: AlignOptions) -> dict[str, str]:
    """Make sure that the network can be loaded before any work, and say which it is.

    Keys: ``name``, ``sha256``, ``card``: the fingerprint of the card, which holds the verdict's calibration.

    Raises:
        InputError: the weights or the device can't be used.
    """
    from utopic_cli.bridge import load_network

    _, card = load_network(options.weights, options.device)
    return {"name": str(card["name"]), "sha256": str(card["sha256"]), "card": fingerprint(card)}


def _ref(scan: ScanFile) -> ScanRef:
    return ScanRef(scan.path, scan.sha256)
