"""A shape library on the training device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from utopic_cli.synthesis.shapes import ShapeLibrary
from utopic_cli.training.batched.draws import Draws


@dataclass(frozen=True)
class MeshBatch:
    """Some meshes side by side, padded.

    Attributes:
        vertices: (B, V, 3) float32; rows beyond a mesh's own repeat its first.
        vertex_mask: (B, V) bool.
        faces: (B, F, 3) int64 vertex numbers; faces beyond a mesh's own have no area.
    """

    vertices: Tensor
    vertex_mask: Tensor
    faces: Tensor


class Meshes:
    """All meshes of a library, uploaded once, drawn and laid side by side on the device."""

    def __init__(self, library: ShapeLibrary, device: torch.device) -> None:
        """Upload a library."""
        self.vertices = torch.from_numpy(np.asarray(library.vertices, dtype=np.float32)).to(device)
        self.faces = torch.from_numpy(np.asarray(library.faces, dtype=np.int64)).to(device)
        self.vertex_start = torch.from_numpy(np.asarray(library.vertex_start, dtype=np.int64)).to(device)
        self.face_start = torch.from_numpy(np.asarray(library.face_start, dtype=np.int64)).to(device)
        # ShapeLibrary.draw: a set by the square root of its size, then any mesh of it.
        _, which, counts = np.unique(library.sets, return_inverse=True, return_counts=True)
        weight = 1.0 / np.sqrt(counts)[which]
        self.cumulative = torch.from_numpy((np.cumsum(weight) / weight.sum()).astype(np.float32)).to(device)

    def draw(self, count: int, draws: Draws) -> Tensor:
        """Draw mesh numbers (count,) int64 by the library's rule."""
        numbers = torch.searchsorted(self.cumulative, draws.uniform(count), right=True)
        return numbers.clamp_max(len(self.cumulative) - 1)

    def batch(self, numbers: Tensor) -> MeshBatch:
        """Lay meshes ``numbers`` (B,) side by side."""
        first_vertex, first_face = self.vertex_start[numbers], self.face_start[numbers]
        vertex_count = self.vertex_start[numbers + 1] - first_vertex
        face_count = self.face_start[numbers + 1] - first_face
        most_vertices, most_faces = torch.stack([vertex_count.max(), face_count.max()]).tolist()
        column = torch.arange(most_vertices, device=numbers.device)
        vertex_mask = column < vertex_count[:, None]
        vertices = self.vertices[first_vertex[:, None] + torch.where(vertex_mask, column, 0)]
        column = torch.arange(most_faces, device=numbers.device)
        face_mask = column < face_count[:, None]
        faces = self.faces[first_face[:, None] + torch.where(face_mask, column, 0)]
        return MeshBatch(vertices, vertex_mask, torch.where(face_mask[..., None], faces, 0))
