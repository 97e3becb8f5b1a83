"""The subspace that an in-between is sought in: modes of all bases, without rigid motions, on both meshes."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.geometry.rigid import infinitesimal_motions
from torch_modal.inbetween.alignment import KeyframeAlignment
from torch_modal.inbetween.coarse import CoarseMesh

# Combinations of modes whose squared norm is below this part of the largest are rounding, not directions.
DEPENDENT = 1e-9


def elastic_subspace(
    modes: Sequence[Tensor], alignment: KeyframeAlignment, coarse: CoarseMesh
) -> tuple[Tensor, Tensor]:
    """Independent combinations of modes, without rigid motions, orthonormal on the coarse mesh.

    The energy does not see translations, and rotations only to second order: left in, they are null directions of its
    Hessian. Modes of two key-frames are partly the same: what is dependent is dropped here, explicitly.

    Args:
        modes: In the frame, of any scale. *Shape of each:* ``(k, V, 3)``.
        alignment: The frame.
        coarse: The coarse mesh.

    Returns:
        The directions on the fine and on the coarse mesh, *shape* ``(n, V, 3), (n, V_coarse, 3)``: no more than two of
        the bases have modes; of more bases, what most of them have in common.
    """
    most = sum(sorted(len(each) for each in modes)[-2:])
    fine = torch.cat([infinitesimal_motions(alignment.references.mean(0)), *modes])
    rigid, others = coarse.restrict(fine).tensor_split([6])
    to_rigid = _orthonormalise(rigid, coarse.weights)
    rigid = _combine(to_rigid, rigid)
    parts = others.flatten(1) @ (rigid * coarse.weights[:, None]).flatten(1).mT
    elastic = others - _combine(parts, rigid)
    sizes = elastic.flatten(1).norm(dim=1)[:, None].clamp_min(torch.finfo(elastic.dtype).tiny)
    mix = _orthonormalise(elastic / sizes[:, None], coarse.weights, most) / sizes.T
    return _combine(torch.cat([-mix @ parts @ to_rigid, mix], 1), fine), _combine(mix, elastic)


def _combine(mix: Tensor, fields: Tensor) -> Tensor:
    """*Shape:* ``(n, m), (m, V, 3) -> (n, V, 3)``."""
    return (mix @ fields.flatten(1)).unflatten(1, (-1, 3))


def _orthonormalise(fields: Tensor, weights: Tensor, most: int | None = None) -> Tensor:
    """Combinations that are orthonormal, at most so many: those that the fields have most in common.

    Dependent ones are dropped. *Shape:* ``(m, V, 3), (V,) -> (n, m)``.
    """
    values, vectors = torch.linalg.eigh((fields * weights[:, None]).flatten(1) @ fields.flatten(1).mT)
    keep = values > DEPENDENT * values.amax().clamp_min(torch.finfo(values.dtype).tiny)
    return (vectors[:, keep] / values[keep].sqrt()).mT[-most if most else None :]
