"""As many coarse faces as it takes to resolve the modes of a shape."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_modal.energy.energy import Energy
from torch_modal.energy.stretch import Stretch
from torch_modal.energy.term import Mesh
from torch_modal.geometry.inspect import is_flat
from torch_modal.precompute.coarsening import Coarsening, Collapses, coarsen

ENOUGH_FACES = 1000
"""Up to so many are tried; coarse meshes of more are not checked."""
MORE = 1.5
"""As many times the faces are tried next."""

MOST_SPREAD = 40.0
"""Largest over smallest ratio of coarse to fine stiffness that is accepted. Of bodies without thin limbs 300 faces have
5 to 37; where results were wrong, they had 60 to 5,000."""
RIDGE = 1e-6
"""Relative stiffness below which directions are not compared: those in which loose pieces move rigidly."""


def resolving(
    shapes: Tensor,
    faces: Tensor,
    n_faces: int,
    collapses: Callable[[int, int], Coarsening] | None,
    modes: Sequence[Tensor],
) -> Coarsening:
    """A coarse mesh of so many faces, or of more, where those do not resolve the modes.

    A flat shape does not tell where the other one bends: the collapses are then those of the other, and there are
    ``ENOUGH_FACES`` or more.

    Args:
        shapes: Float64 on the CPU. *Shape:* ``(2, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: How many are wanted.
        collapses: As for :func:`torch_modal.precompute.coarsening.coarsen`.
        modes: Of the shapes, in their axes; none if it does not matter. *Shape of each:* ``(k, V, 3)``.
    """
    enough = min(ENOUGH_FACES, len(faces))
    flat = [is_flat(x[faces.unique()].numpy()) for x in shapes]
    if any(flat):
        n_faces, curved = max(n_faces, enough), flat.index(False) if False in flat else 0
        given = collapses or Collapses(faces.numpy()).of(range(len(shapes)), shapes.numpy())

        def collapses(keyframe: int, n: int) -> Coarsening:
            return given(curved if flat[keyframe] else keyframe, n)

    found = coarsen(shapes.numpy(), faces.numpy(), n_faces, collapses)
    if n_faces >= enough:
        return found
    whole, ends = Mesh.of(faces, shapes.shape[1]), [(x, y) for x, y in zip(shapes, modes, strict=False) if len(y)]
    fine = [stretching(whole, *end) for end in ends]
    while n_faces < enough:
        mesh = Mesh.of(torch.from_numpy(found.faces), found.n_vertices)
        coarse = [[torch.from_numpy(found.restrict(part.numpy())) for part in end] for end in ends]
        pairs = zip(fine, coarse, strict=True)
        if all(spread(own, stretching(mesh, x, moves)) <= MOST_SPREAD for own, (x, moves) in pairs):
            break
        n_faces = min(round(MORE * n_faces), ENOUGH_FACES)
        found = coarsen(shapes.numpy(), faces.numpy(), n_faces, collapses)
    return found


def stretching(mesh: Mesh, x: Tensor, modes: Tensor) -> Tensor:
    """Hessian of the stretching energy in the amplitudes of modes, with the shape at rest.

    Bending is left out: it is a small part of the stiffness of closed thin limbs, and three times the work.

    Args:
        mesh: The mesh.
        x: The shape. *Shape:* ``(V, 3)``.
        modes: Displacements. *Shape:* ``(k, V, 3)``.

    Returns:
        *Shape:* ``(k, k)``.
    """
    energy = Energy(mesh, [Stretch()])
    rest, field = (energy.extend(part.movedim(-1, 0).contiguous()) for part in (x[None], modes))
    reference = energy.against(energy.rest(rest), [1.0])
    (rates,) = energy.rates(energy.linearise(rest, reference), field)
    rows = rates * reference.weights[0][0].sqrt()
    return rows @ rows.mT


def spread(fine: Tensor, coarse: Tensor) -> float:
    """Largest over smallest ratio of two stiffnesses, over all combinations of modes.

    A uniform factor does no harm. But where the coarse mesh is soft, as where a limb has become flat, a minimisation
    goes far astray; where it is stiff, as where few long triangles follow a limb, it does not move at all.

    Args:
        fine: Of the fine mesh. *Shape:* ``(k, k)``.
        coarse: Of the coarse mesh. *Shape:* ``(k, k)``.
    """
    size = fine.diagonal().clamp_min(torch.finfo(fine.dtype).tiny).rsqrt()
    fine, coarse = (size[:, None] * x * size for x in (fine, coarse))
    eye = RIDGE * torch.eye(len(fine), dtype=fine.dtype)
    level = coarse.diagonal().mean().clamp_min(torch.finfo(fine.dtype).tiny)
    lower = torch.linalg.cholesky(fine + eye)
    half = torch.linalg.solve_triangular(lower, coarse / level + eye, upper=False)
    ratios = torch.linalg.eigvalsh(torch.linalg.solve_triangular(lower, half.mT, upper=False))
    return float(ratios[-1] / ratios[0].clamp_min(torch.finfo(fine.dtype).tiny))
