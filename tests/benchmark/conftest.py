"""Scans written by the tests: two partial views of one bumpy object, in frames of their own."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from utopic_cli.geometry.rigid import apply, invert, random_rotation, rigid
from utopic_cli.io.ply_writer import scalar_cloud_ply


@dataclass(frozen=True)
class ScanFolder:
    """A folder with ``a.ply``, ``b.ply`` and a gt.json that can be rewritten."""

    path: Path
    gt_T_target_source: np.ndarray

    def pair(self, **changes: Any) -> dict[str, Any]:
        entry = {
            "source": "a.ply",
            "target": "b.ply",
            "T_target_source": self.gt_T_target_source.tolist(),
            "overlap_source": 0.8,
            "overlap_target": 0.7,
        }
        return {**entry, **changes}

    def write(self, content: Any) -> Path:
        (self.path / "gt.json").write_text(json.dumps(content))
        return self.path


def bumpy_object(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) points of a sphere with three different horns: no symmetry, plenty of shape."""
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = np.ones(count)
    for horn, height, width in (([1, 0, 0.2], 0.6, 0.3), ([0, 1, 0], 0.4, 0.5), ([0.5, -0.6, 0.6], 0.5, 0.2)):
        axis = np.array(horn, float) / np.linalg.norm(horn)
        radius += height * np.exp((directions @ axis - 1.0) / width**2)
    return directions * radius[:, None]


@pytest.fixture
def folder(tmp_path: Path) -> ScanFolder:
    rng = np.random.default_rng(3)
    world = bumpy_object(rng, 12_000)
    source, target = world[world[:, 0] > -0.3], world[world[:, 0] < 1.2]
    source_from_world = rigid(random_rotation(rng), np.array([5.0, 2.0, 1.0]))
    grey = np.uint8(128)
    for name, points in (("a", apply(source_from_world, source[::2])), ("b", target[1::2])):
        colours = np.full(points.shape, grey)
        (tmp_path / f"{name}.ply").write_bytes(scalar_cloud_ply(points, colours, {}))
    scans = ScanFolder(tmp_path, invert(source_from_world))
    scans.write({"pairs": [scans.pair()]})
    return scans
