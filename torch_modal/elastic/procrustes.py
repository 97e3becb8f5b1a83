"""The poses of pairs of shapes by kernels, which do what hundreds of small operations do in torch."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal.elastic.kernels.function import Operation
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.geometry import procrustes


def mean_pose(to_reference: Tensor, among: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`torch_modal.geometry.procrustes.mean_pose`; of two shapes by a kernel, in float64."""
    if weights.shape[1] != 2:
        return procrustes.mean_pose(to_reference, among, weights)
    rotations, pose = _MeanPose()(to_reference, among, weights)
    return rotations.to(among), pose.to(among)


class _MeanPose(Operation):
    """*Shape:* ``(B, 2, 3, 3), (B, 2, 2, 3, 3), (B, 2) -> (B, 2, 3, 3), (B, 3, 3)``."""

    n_results = n_differentiable = 2
    by_torch = staticmethod(procrustes.mean_pose)

    @staticmethod
    def run(kept: list[Any] | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        rotations, pose = torch.empty_like(tensors[0]), torch.empty_like(tensors[0][:, 0])
        launch(kernels("procrustes").mean_pose, (len(pose),), [*tensors, rotations, pose])
        return rotations, pose

    @staticmethod
    def back(kept: list[Any], grads: Sequence[Tensor], *tensors: Tensor) -> tuple[Tensor | None, ...]:
        gradients = [torch.zeros_like(x) for x in tensors]
        scratch = [torch.empty_like(x) for x in grads]
        launch(kernels("rotations_adjoint").mean_pose, (len(tensors[0]),), [*tensors, *scratch], [*gradients, *grads])
        return tuple(gradients)
