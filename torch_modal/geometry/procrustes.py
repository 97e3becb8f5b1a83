"""Generalised Procrustes analysis: the rotations that turn K shapes on to each other, from their covariances alone."""

import torch
from torch import Tensor

from torch_modal.geometry.rigid import best_rotation
from torch_modal.geometry.rotations import matrix, mean, quaternion, signs_of_mean

# Rounds in which more than two shapes are turned on to their mean, and the last of them, which have derivatives: of
# the poses of a gallop, each leaves a tenth.
ROUNDS, LAST_ROUNDS = 6, 5


def mean_pose(to_reference: Tensor, among: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations of shapes on to their weighted mean, this turned on to a reference, and the mean of the way back.

    The weighted squared distances of all pairs are least. Of two shapes, it is their best fit.

    Args:
        to_reference: Covariances of the reference with each shape, ``sum_v w_v y_v x_v^T``. *Shape:* ``(B, K, 3, 3)``.
        among: Covariances of all pairs. *Shape:* ``(B, K, K, 3, 3)``.
        weights: They add up to one. *Shape:* ``(B, K)``.

    Returns:
        The rotations, *shape* ``(B, K, 3, 3)``; the mean of their inverses, *shape* ``(B, 3, 3)``.
    """
    factors = weights[..., None, None]
    if weights.shape[1] > 2:
        with torch.no_grad():
            rotations = best_rotation(to_reference)
            for _ in range(ROUNDS):
                rotations = best_rotation(((factors * rotations)[:, :, None] @ among).sum(1))
        rotations = rotations.detach()  # forward mode goes through no_grad
        for _ in range(LAST_ROUNDS):
            rotations = best_rotation(((factors * rotations)[:, :, None] @ among).sum(1))
    else:
        rotations = torch.cat([torch.eye(3).to(among).expand(len(among), 1, 3, 3), best_rotation(among[:, 0, 1:])], 1)
    rotations = best_rotation((factors * to_reference @ rotations.mT).sum(1))[:, None] @ rotations
    poses = quaternion(rotations.mT.movedim((-2, -1), (0, 1)))  # (4, B, K)
    signs = signs_of_mean(torch.einsum("ibk,ibl->bkl", poses, poses).detach(), weights.detach())
    pose = mean((signs * poses)[..., None], weights[..., None]).squeeze(-1)
    return rotations, matrix(pose).movedim(-1, 0)
