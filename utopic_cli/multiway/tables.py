"""A model as files for people and programs: poses.json, poses.txt, poses.csv, summary.csv."""

from __future__ import annotations

import csv
import io
import json
from typing import Any

import numpy as np

from utopic_cli import __version__
from utopic_cli.multiway.outcome import BatchOutcome, ScanEntry
from utopic_cli.report import quaternion

SCHEMA_VERSION = 1
CONVENTION = "p_world = T_world_scan @ p_scan; p_target = T_target_source @ p_source"


def poses_json(outcome: BatchOutcome) -> bytes:
    """Return every scan's transformation, the groups, and the scans left out and why."""
    model = outcome.model
    names = [entry.file.name for entry in outcome.scans]
    groups = [
        {
            "group": number,
            "world_frame_of": names[min(group.T_world_scan)],
            "weakest_join": group.evidence,
            "scans": [names[scan] for scan in group.T_world_scan],
        }
        for number, group in enumerate(model.groups, 1)
    ]
    content = {
        "schema_version": SCHEMA_VERSION,
        "utopic_cli": __version__,
        "convention": CONVENTION,
        "weights": outcome.weights,
        "options": outcome.options,
        "pairs_mode": outcome.pairs_mode,
        "groups": groups,
        "scans": [_scan_entry(entry) for entry in outcome.scans],
        "left_out": [
            {"scan": entry.file.name, "file": str(entry.file.path), "reason": entry.left_out}
            for entry in outcome.scans
            if entry.left_out is not None
        ],
        "passed_over": [
            {"file": str(entry.file.path), "reason": entry.passed_over}
            for entry in outcome.scans
            if entry.passed_over is not None
        ]
        + [{"file": str(one.path), "reason": one.reason} for one in outcome.aside],
        "pairs": [_pair_entry(outcome, index) for index in range(len(model.pairs))],
        "notes": list(outcome.notes),
    }
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode("ascii")


def poses_txt(outcome: BatchOutcome) -> bytes:
    """Return the largest group's transformations, a line of 3 x 4 numbers, row by row, for each scan."""
    rows = [
        " ".join(f"{value:.17g}" for value in entry.T_world_scan[:3].ravel())
        for entry in outcome.scans
        if entry.group == 1 and entry.T_world_scan is not None
    ]
    return "".join(f"{row}\n" for row in rows).encode("ascii")


def poses_csv(outcome: BatchOutcome) -> bytes:
    """Return every scan that has a place: name, group, translation, quaternion and matrix."""
    header = ["scan", "file", "group", "line_of_poses_txt", "tx", "ty", "tz", "qw", "qx", "qy", "qz"]
    header += [f"m{row}{column}" for row in range(3) for column in range(4)]
    rows: list[list[Any]] = []
    line = 0
    for entry in outcome.scans:
        if entry.T_world_scan is None:
            continue
        line += entry.group == 1
        turn = quaternion(entry.T_world_scan[:3, :3])
        numbers = [*entry.T_world_scan[:3, 3], *(turn[part] for part in "wxyz")]
        numbers += list(entry.T_world_scan[:3].ravel())
        rows.append(
            [
                entry.file.name,
                entry.file.path,
                entry.group,
                line if entry.group == 1 else "",
                *(f"{number:.17g}" for number in numbers),
            ]
        )
    return _table(header, rows)


def summary_csv(outcome: BatchOutcome) -> bytes:
    """Return what became of every scan and every pair, one a line."""
    header = ["kind", "name", "status", "group", "overlap", "confidence", "loops_agree", "loops_disagree"]
    header += ["missed", "seconds", "reason"]
    rows: list[list[Any]] = []
    for entry in outcome.scans:
        status, reason = entry.status
        rows.append(["scan", entry.file.name, status, entry.group or "", *[""] * 6, reason])
    group_of = outcome.model.group_of()
    for pair, record in zip(outcome.model.pairs, outcome.records.values(), strict=True):
        together = pair.verdict == "used"
        rows.append(
            [
                "pair",
                outcome.pair_name(pair.source, pair.target),
                pair.verdict,
                group_of[pair.source] + 1 if together else "",
                _number(pair.overlap),
                _number(record["report"]["confidence"] if record["status"] == "done" else None),
                *(pair.loops or ("", "")),
                _number(pair.missed),
                f"{record['seconds']:.1f}",
                pair.reason,
            ]
        )
    return _table(header, rows)


def _scan_entry(entry: ScanEntry) -> dict[str, Any]:
    status, _ = entry.status
    return {
        "scan": entry.file.name,
        "file": str(entry.file.path),
        "sha256": entry.file.sha256 or None,
        "points": entry.points,
        "copy_of": entry.file.copy_of,
        "status": status,
        "group": entry.group,
        "T_world_scan": None if entry.T_world_scan is None else np.asarray(entry.T_world_scan).tolist(),
    }


def _pair_entry(outcome: BatchOutcome, index: int) -> dict[str, Any]:
    pair = outcome.model.pairs[index]
    return {
        "pair": outcome.pair_name(pair.source, pair.target),
        "verdict": pair.verdict,
        "reason": pair.reason,
        "loops_agree": pair.loops[0] if pair.loops else None,
        "loops_disagree": pair.loops[1] if pair.loops else None,
        "missed": pair.missed,
    }


def _table(header: list[str], rows: list[list[Any]]) -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream)
    writer.writerow(header)
    writer.writerows(rows)
    # File names that are no UTF-8 come out as the bytes they are.
    return stream.getvalue().encode("utf-8", "surrogateescape")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
