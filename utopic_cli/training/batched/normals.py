"""Surface normals of many clouds at once: direction by local PCA, sign by a spanning tree."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from utopic_cli.training.batched.draws import Draws, unit
from utopic_cli.training.batched.ragged import cross, group_sums

NEIGHBOURS, TREE_NEIGHBOURS = 30, 16
"""Points a plane is fitted to, and graph neighbours signs are carried along: as in ``geometry.normals``."""

NONE = torch.iinfo(torch.int64).max


def plane_normals(points: Tensor, distance: Tensor, index: Tensor, softness: Tensor, draws: Draws) -> Tensor:
    """Fit a plane to each point's neighbourhood; see ``geometry.normals.estimate_normals``.

    Args:
        points: (K, 3).
        distance: (K, k) to the nearest points, infinity where there are fewer in reach.
        index: (K, k) rows of ``points``.
        softness: (K,) standard deviation of the Gaussian by which neighbours count.
        draws: a point with fewer than three in reach gets a random normal: an outlier's own
            plane means nothing either.

    Returns:
        (K, 3) unit normals of arbitrary sign.
    """
    near = distance.isfinite()
    weight = torch.exp(-0.5 * (distance / softness[:, None]).square())
    weight[:, :3] = near[:, :3].float()
    weight = (weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-30))[..., None]
    offsets = points[index] - points[:, None]
    offsets = offsets - (weight * offsets).sum(dim=1, keepdim=True)
    x, y, z = offsets.unbind(-1)
    products = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    covariance = torch.stack([(weight[..., 0] * a * b).sum(dim=1) for a, b in products], dim=1)
    return torch.where(
        near.sum(dim=1, keepdim=True) >= 3, smallest_eigenvector(covariance), draws.direction(len(points))
    )


def smallest_eigenvector(matrices: Tensor) -> Tensor:
    """Eigenvector (K, 3) of the smallest eigenvalue of symmetric 3 x 3 matrices.

    The eigenvalue comes from the trigonometric solution of the cubic, the vector from the
    largest cross product of rows, in double precision. Where two eigenvalues coincide any
    vector of their plane would do; there the vector is of no use and may be none of them.

    Args:
        matrices: (K, 6) float32: xx, xy, xz, yy, yz, zz.
    """
    xx, xy, xz, yy, yz, zz = matrices.double().unbind(1)
    scale = ((xx + yy + zz) / 3.0).clamp_min(1e-300)
    xx, xy, xz, yy, yz, zz = (entry / scale for entry in (xx, xy, xz, yy, yz, zz))
    a, b, c = xx - 1.0, yy - 1.0, zz - 1.0  # trace zero, since the mean eigenvalue is now 1
    half = ((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0).clamp_min(1e-300).sqrt()
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = (determinant / (2.0 * half**3)).clamp(-1.0, 1.0)
    smallest = 1.0 + 2.0 * half * ((cosine.acos() + 2.0 * math.pi) / 3.0).cos()
    rows = [
        torch.stack(row, dim=1)
        for row in ((xx - smallest, xy, xz), (xy, yy - smallest, yz), (xz, yz, zz - smallest))
    ]
    crosses = torch.stack([cross(rows[i], rows[(i + 1) % 3]) for i in range(3)], dim=1)  # (K, 3, 3)
    best = crosses.square().sum(-1).argmax(dim=1)
    vector = crosses.gather(1, best[:, None, None].expand(-1, 1, 3))[:, 0]
    poor = vector.square().sum(-1) < 1e-20
    upright = torch.zeros_like(vector)
    upright[:, 2] = 1.0
    return torch.where(poor[:, None], upright, unit(vector)).float()


def faced(normals: Tensor, towards: Tensor) -> Tensor:
    """Flip normals (K, 3) to the side that ``towards`` (K, 3) points to."""
    return torch.where(((normals * towards).sum(-1) < 0)[:, None], -normals, normals)


def guessed_signs(
    points: Tensor,
    normals: Tensor,
    distance: Tensor,
    index: Tensor,
    cloud: Tensor,
    clouds: int,
    chosen: Tensor,
) -> Tensor:
    """Guess the signs of normals from the points alone, as ``geometry.normals.orient_normals`` does.

    Signs are carried along a minimum spanning tree of the neighbour graph, with its mistakes at
    creases and thin walls. Between pieces the graph does not connect they are right (there the
    bridges of ``orient_normals`` nearly always are), and last, each cloud is turned so that its
    normals point away from its centroid on the whole, be that right or wrong.

    Args:
        points: (K, 3).
        normals: (K, 3) unit normals on the right side.
        distance: (K, k) to the nearest points, the point itself first; infinity for none.
        index: (K, k) rows of ``points``.
        cloud: (K,) int64.
        clouds: number of clouds C.
        chosen: (C,) bool, clouds to do it for; the others keep their signs.

    Returns:
        (K,) float32, 1 where a normal is kept and -1 where it is reversed.
    """
    piece, sign = spanning_signs(normals, distance, index, chosen[cloud])
    # The normals given are right, so a piece is right where its signs are + on the whole.
    vote = group_sums(sign[:, None], piece, len(points))[:, 0]
    sign = sign * torch.where(vote < 0, -1.0, 1.0)[piece]
    size = torch.bincount(cloud, minlength=clouds).clamp_min(1)
    centre = (group_sums(points, cloud, clouds) / size[:, None]).float()
    height = sign * (normals * (points - centre[cloud])).sum(-1)
    outward = group_sums(height[:, None], cloud, clouds)[:, 0]
    sign = sign * torch.where(outward < 0, -1.0, 1.0)[cloud]
    return torch.where(chosen[cloud], sign, 1.0)


def spanning_signs(normals: Tensor, distance: Tensor, index: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Carry signs along the minimum spanning forest of the neighbour graph (Boruvka's algorithm).

    An edge costs 1 - |n . n'|. In every round each piece joins the neighbour its cheapest edge
    leads to, and takes the sign over that the edge asks for: ten rounds or so, each in parallel.

    Args:
        normals: (K, 3) unit.
        distance: (K, k), infinity for none; the first column is the point itself.
        index: (K, k).
        chosen: (K,) bool, points that take part.

    Returns:
        piece: (K,) int64, the same for points that are connected.
        sign: (K,) float32 in {-1, 1}, consistent within a piece.
    """
    count = len(normals)
    use = distance[:, 1 : TREE_NEIGHBOURS + 1].isfinite() & chosen[:, None]
    first, column = use.nonzero(as_tuple=True)
    second = index[first, column + 1]
    agreement = (normals[first] * normals[second]).sum(-1)
    asked = torch.where(agreement < 0, -1.0, 1.0)
    cost = (1.0 - agreement.abs()).clamp_min(0.0).contiguous().view(torch.int32).long()
    # Bits of a float that is not negative order like the float; the edge's number breaks ties.
    code = (cost << 32) | torch.arange(len(first), device=normals.device)
    piece = torch.arange(count, device=normals.device)
    every, sign = piece.clone(), torch.ones(count, device=normals.device)
    left, right, open_code = first, second, code
    while True:
        at_left, at_right = piece[left], piece[right]
        apart = at_left != at_right
        if not bool(apart.any()):
            return piece, sign
        left, right, open_code = left[apart], right[apart], open_code[apart]
        best = torch.full((count,), NONE, device=normals.device)
        best.scatter_reduce_(0, at_left[apart], open_code, "amin")
        best.scatter_reduce_(0, at_right[apart], open_code, "amin")
        joins = best != NONE
        edge = torch.where(joins, best & 0xFFFFFFFF, 0)
        near_end, far_end = piece[first[edge]], piece[second[edge]]
        parent = torch.where(joins, torch.where(near_end == every, far_end, near_end), every)
        turn = torch.where(joins, sign[first[edge]] * sign[second[edge]] * asked[edge], 1.0)
        root = (parent[parent] == every) & (every < parent)  # two pieces that chose one edge
        parent, turn = torch.where(root, every, parent), torch.where(root, 1.0, turn)
        while not torch.equal(parent, parent[parent]):
            turn, parent = turn * turn[parent], parent[parent]
        sign, piece = sign * turn[piece], parent[piece]
