"""A key-frame as modal deformation takes it: modes scaled by the strain that they cause, and triangle frames."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.energy.bend import dihedral_gradient
from torch_modal.geometry.canonical import size
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.triangle_frames import Frames, frames, sides
from torch_modal.geometry.vectors import cross, norm
from torch_modal.precompute.basis import ModalBasis
from torch_modal.precompute.sheet import THICKNESS

# Eigenvalues below this part of the largest are loose pieces that move without deforming: no elastic modes.
_NOT_ELASTIC = 1e-8


class KeyframeReference(NamedTuple):
    """A key-frame with scaled modes and triangle frames, for modal deformation."""

    shape: Tensor
    """*Shape:* ``(V, 3)``."""
    modes: Tensor
    """Modes over the roots of their eigenvalues, so scaled that independent standard normal amplitudes give an expected
    root mean square strain of one, components first. *Shape:* ``(k, 3V)``. It is that of the edges; of sheets, where
    bending strains their sides more than that, it is the strain of their sides."""
    frames: Frames
    """Of its triangles, for a batch of one."""


def keyframe_reference(basis: ModalBasis, faces: Tensor, edges: Tensor, like: Tensor) -> KeyframeReference:
    """The reference of a basis, in the dtype and on the device of another tensor.

    Args:
        basis: Of the key-frame.
        faces: *Shape:* ``(F, 3)``.
        edges: *Shape:* ``(E, 2)``.
        like: Gives dtype and device.
    """
    x = basis.reference.double()
    values = basis.eigenvalues.double()
    elastic = values > _NOT_ELASTIC * values.amax()
    scale = torch.where(elastic, values, torch.inf).rsqrt()
    modes = basis.modes.double() * scale[:, None, None]
    i, j = edges.unbind(1)
    side = x[j] - x[i]
    slopes = ((modes[:, j] - modes[:, i]) * side).sum(-1) / side.square().sum(-1).clamp_min(1e-300)
    expected = _expected(slopes)
    bending, areas = _bending_strains(modes, x, faces)
    bending = _expected(bending, areas)
    if bending > _expected(slopes, side.square().sum(-1)):  # a sheet, which bends without a change of length
        expected = bending
    modes = modes / expected.clamp_min(torch.finfo(torch.float64).tiny)
    own = frames(sides(x.mT[:, None], faces))
    return KeyframeReference(x.to(like), modes.mT.flatten(1).to(like), Frames(*(part.to(like) for part in own)))


def _expected(strains: Tensor, weights: Tensor | None = None) -> Tensor:
    """Expected root mean square for standard normal amplitudes. *Shape:* ``(k, n), (n,) -> ()``."""
    squares = strains.square()
    means = squares.mean(1) if weights is None else squares @ weights / weights.sum()
    return means.sum().sqrt()


def _bending_strains(modes: Tensor, x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Strain of the sides of a sheet across each hinge, for the thickness that shell modes have, and the hinges' areas.

    *Shape:* ``(k, V, 3), (V, 3), (F, 3) -> (k, H), (H,)``, to first order.
    """
    hinges = torch.tensor(Connectivity(faces.numpy(), len(x)).hinges)
    first, *others = (torch.cat([x[None], modes])[:, corner] for corner in hinges.unbind(1))
    vectors = torch.stack([other - first for other in others]).movedim(-1, 1)
    rest, moves = vectors[:, :, 0], vectors[:, :, 1:]
    angles = (dihedral_gradient(rest)[:, :, None] * moves).sum((0, 1))
    e, a, b = rest
    tiny = torch.finfo(x.dtype).tiny
    areas = 0.5 * (norm(cross(e, a)) + norm(cross(e, b)))
    apart = 2 * areas / (3 * norm(e)).clamp_min(tiny)  # of the centroids
    thickness = THICKNESS * size(x.numpy(), faces.numpy())
    return 0.5 * thickness * angles / apart.clamp_min(tiny), areas
