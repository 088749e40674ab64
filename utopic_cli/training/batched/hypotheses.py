"""Transformations shown to the network, for a batch: the batched ``training.hypotheses``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from utopic_cli.estimation.refinement import Stage
from utopic_cli.training.batched.draws import Draws
from utopic_cli.training.batched.ragged import cross, product, rotations, squared_distances, turned
from utopic_cli.training.batched.sampling import DenseClouds
from utopic_cli.training.batched.voxels import rows_of
from utopic_cli.training.hypotheses import MOST_ROTATION_DEG, MOST_SHIFT, NEARLY_RIGHT, NONE, SETTLING


def draw_hypotheses(dense: DenseClouds, gt: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
    """Draw what the network is shown: nothing, (nearly) the known answer, or a settled wrong one.

    Args:
        dense: the dense clouds of B pairs.
        gt: (B, 4, 4) known answers.
        draws: source of randomness.

    Returns:
        (B, 4, 4) transformations, and (B,) 1.0 where one is shown, else 0.0.
    """
    count = len(gt)
    kind = draws.uniform(count)
    amount = draws.uniform(count).square()  # mostly as near as a refined answer comes
    turn = rotations(draws.direction(count) * (math.radians(MOST_ROTATION_DEG) * amount)[:, None])
    shift = MOST_SHIFT * (dense.spacing[::2] * amount)[:, None] * draws.uniform(count, 3, low=-1.0, high=1.0)
    shown = product(rigid(turn, shift), gt)
    wrong = (kind >= NEARLY_RIGHT).nonzero()[:, 0]
    if len(wrong):
        shown[wrong] = _settled(dense, wrong, draws)
    absent = kind < NONE
    shown = torch.where(absent[:, None, None], torch.eye(4, device=gt.device), shown)
    return shown, (~absent).float()


def _settled(dense: DenseClouds, pairs: Tensor, draws: Draws) -> Tensor:
    """Let random starts settle by point-to-plane ICP, as a solver's wrong hypotheses do (W, 4, 4)."""
    voxels = dense.voxels
    rows, mask = rows_of(torch.cat([voxels.means, dense.normals], dim=1), voxels)
    source, target = rows[2 * pairs], rows[2 * pairs + 1]
    source_mask, target_mask = mask[2 * pairs], mask[2 * pairs + 1]
    rotation = draws.rotation(len(pairs))
    onto, from_point = (
        values.gather(1, draws.rows(there, 1)[..., None].expand(-1, -1, 6))[..., :3]
        for values, there in ((target, target_mask), (source, source_mask))
    )
    current = rigid(rotation, (onto - turned(from_point, rotation))[:, 0])
    voxel = voxels.size[2 * pairs + 1]
    for stage in SETTLING:
        sample = source.gather(1, draws.rows(source_mask, stage.samples)[..., None].expand(-1, -1, 6))
        for _ in range(stage.iterations):
            current = product(_step(sample, target, target_mask, current, stage, voxel), current)
    return current


def _step(
    sample: Tensor, target: Tensor, mask: Tensor, current: Tensor, stage: Stage, voxel: Tensor
) -> Tensor:
    """One step of point-to-plane ICP (W, 4, 4); the rules are those of ``refinement.refine_coarse``."""
    moved = turned(sample[..., :3], current[:, :3, :3]) + current[:, None, :3, 3]
    normals = turned(sample[..., 3:], current[:, :3, :3])
    squared, index = torch.where(mask[:, None], squared_distances(moved, target[..., :3]), torch.inf).min(
        dim=2
    )
    distance = squared.sqrt()
    partner = target.gather(1, index[..., None].expand(-1, -1, 6))
    plane = partner[..., 3:]
    radius = (stage.radius * voxel)[:, None]
    near = (distance < radius) & ((normals * plane).sum(-1) > 0.5)
    weight = torch.where(near, 1.0 - (distance / radius).square(), 0.0)
    offset = ((partner[..., :3] - moved) * plane).sum(-1)
    centre = moved.mean(dim=1, keepdim=True)
    jacobian = torch.cat([cross(moved - centre, plane), plane], dim=2)  # (W, S, 6)
    normal_matrix = (weight[..., None, None] * jacobian[..., :, None] * jacobian[..., None, :]).sum(dim=1)
    right = (weight[..., None] * jacobian * offset[..., None]).sum(dim=1)
    spread = jacobian[..., :3].square().sum(-1).mean(dim=1)
    total = weight.sum(dim=1).clamp_min(1e-6)
    damping = torch.stack([spread * total, total], dim=1).repeat_interleave(3, dim=1)
    solution, _ = torch.linalg.solve_ex(normal_matrix + torch.diag_embed(1e-3 * damping), right)
    solved = (near.sum(dim=1) >= 6) & solution.isfinite().all(dim=1)
    solution = torch.where(solved[:, None], solution, 0.0)
    rotation = rotations(solution[:, :3])
    shift = centre[:, 0] + solution[:, 3:] - turned(centre, rotation)[:, 0]
    return rigid(rotation, shift)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return the matrices (W, 4, 4) of ``p -> rotation @ p + translation``."""
    result = torch.zeros(len(rotation), 4, 4, device=rotation.device)
    result[:, :3, :3], result[:, :3, 3], result[:, 3, 3] = rotation, translation, 1.0
    return result
