"""Stand-ins for the pairwise step, importable by worker processes; what they do is in the scans' names."""

from __future__ import annotations

import base64
import json
import os
import time
from functools import partial
from pathlib import Path

import numpy as np

from utopic_cli.config import AlignOptions
from utopic_cli.errors import InputError
from utopic_cli.geometry.rigid import invert, random_rotation, rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply
from utopic_cli.io.scan import read_scan
from utopic_cli.multiway.tasks import DescribeJob, describe
from utopic_cli.multiway.vocabulary import LENGTH


def report(T_target_source, *, confidence=0.97, trusted=True, overlap=0.6, centre=(0.0, 0.0, 0.0)):
    """The part of a registration's report that the graph reads."""
    return {
        "T_target_source": np.asarray(T_target_source).tolist(),
        "confidence": confidence,
        "trusted": trusted,
        "reasons": ["where the scans meet, their surfaces agree as well as one scan does with itself"],
        "ambiguous_with": [],
        "overlap_ratio": {"source": overlap, "target": overlap},
        "covariance": (1e-8 * np.eye(6)).tolist(),
        "covariance_about": list(centre),
        "unobservable": [],
    }


def jittered(transformation, rng, *, degrees=0.2, shift=0.002):
    """A transformation that is a little off."""
    axis = rng.standard_normal(3)
    turn = np.radians(degrees) * axis / np.linalg.norm(axis)
    skew = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    u, _, vt = np.linalg.svd(np.eye(3) + skew)
    return rigid(u @ vt, shift * rng.standard_normal(3)) @ transformation


def random_motion(rng, shift=2.0):
    return rigid(random_rotation(rng), rng.uniform(-shift, shift, 3))


def write_scans(folder: Path, names, *, seed=0, objects=1):
    """Write small scans of one object or more, each in a frame of its own, and what a stub has to know."""
    rng = np.random.default_rng(seed)
    shapes = [rng.standard_normal((200, 3)) * (1.0, 0.8, 0.6) for _ in range(objects)]
    folder.mkdir(parents=True, exist_ok=True)
    truth = {}
    for i, name in enumerate(names):
        world = random_motion(rng)
        points = shapes[i % objects] + 1e-3 * rng.standard_normal((200, 3))
        points = (points - world[:3, 3]) @ world[:3, :3]
        colours = np.full((200, 3), 10 * i, np.uint8)
        (folder / name).write_bytes(scalar_cloud_ply(points, colours, {}))
        truth[name] = {"world": world.tolist(), "object": i % objects}
    (folder / "truth.json").write_text(json.dumps(truth))
    return {name: np.array(entry["world"]) for name, entry in truth.items()}


def make_stub(log: str = "", calibrated: bool = True, sleep: float = 0.0):
    """Knows the answers from ``truth.json`` beside the scans; between objects it answers nonsense."""
    return partial(_stub, log, calibrated, sleep)


def _stub(log, calibrated, sleep, job):
    if isinstance(job, DescribeJob):
        record = describe(read_scan(job.scan.path), AlignOptions(), False)
        if job.descriptors:
            truth = json.loads((job.scan.path.parent / "truth.json").read_text())[job.scan.path.name]
            looks = np.random.default_rng(truth["object"]).integers(-100, 100, (50, LENGTH), np.int8)
            record["descriptors"] = base64.b64encode(looks.tobytes()).decode("ascii")
        return record
    source, target = job.source.path, job.target.path
    if log:
        with open(log, "a") as stream:
            stream.write(f"{source.stem}--{target.stem}\n")
    both = source.stem + target.stem
    time.sleep(sleep)
    if "crash" in both:
        os._exit(139)
    if "hang" in both:
        time.sleep(1000)
    if "refuse" in both:
        raise InputError("these don't go together")
    if "bug" in both:
        raise ValueError("a bug")
    truth = json.loads((source.parent / "truth.json").read_text())
    # A generator for each pair, so that an answer does not depend on what was asked before.
    rng = np.random.default_rng(sum(map(ord, source.stem + "-" + target.stem)))
    known = [np.array(truth[path.name]["world"]) for path in (source, target)]
    if truth[source.name]["object"] != truth[target.name]["object"]:
        confidence = 0.2 if calibrated else None
        return report(random_motion(rng), confidence=confidence, trusted=False, overlap=0.2)
    answer = jittered(invert(known[1]) @ known[0], rng, shift=0.0)
    centre = (answer @ [*read_scan(source).cloud.points.mean(axis=0), 1.0])[:3]
    confidence = 0.97 if calibrated else None
    return report(answer, confidence=confidence, trusted=calibrated, centre=centre)
