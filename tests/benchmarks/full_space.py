"""In-betweens over all vertices: the slow optimum that everything else is measured against.

No modes, no coarse mesh: sparse Newton steps on 3V unknowns (the discrete-shell mean of Heeren et al. 2012, at any t).
"""

from typing import NamedTuple

import numpy as np
import torch
from helpers.shapes import fraction
from scipy import sparse
from torch import Tensor

from torch_modal.elastic.bend import SquaredBend
from torch_modal.elastic.energy import Energy, EnergyAt, Reference, Rest, RestShapes
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import Volume
from torch_modal.geometry import connectivity
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.sparse import factorize
from torch_modal.geometry.vectors import cross, pick

STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.001)

# Added to the diagonal, relative to its mean: rigid motions change nothing.
RIDGE = 1e-9

# Eq. 5 has no area term, and some triangle always gains by becoming a needle. One whose altitude has fallen to this
# part of its longest side is held where it is: its dihedral angles would stop all others.
HELD_ALTITUDE = 0.005
HOLD = 1e9

# The energy stagnates when this many steps together gain less than this part of it.
STAGNATION_STEPS, TOLERANCE = 5, 1e-8


class FullSpaceResult(NamedTuple):
    """Where Newton's method ended."""

    shape: Tensor
    """In the caller's coordinates. *Shape:* ``(V, 3)``."""
    energies: list[float]
    """Eq. 5 at the start and after each step, at a bounding-box diagonal of 100; it never rises."""
    stagnated: bool
    """Whether there was nothing more to gain."""


def full_space(
    x_a: Tensor,
    x_b: Tensor,
    faces: Tensor,
    t: float = 0.5,
    *,
    start: Tensor | None = None,
    example_based: bool = False,
    fixed: Tensor | None = None,
    size: float | None = None,
    max_steps: int = 100,
) -> FullSpaceResult:
    r"""The shape that minimises :math:`(1-t)\, d(x_a, x) + t\, d(x_b, x)` (Eq. 5) over all vertices.

    It takes a second and more for each step of 10,000 vertices, and its minimum is a local one: a linear start can end
    a few percent higher than an in-between of a modal space.

    Args:
        x_a: Key-frame at 0. *Shape:* ``(V, 3)``.
        x_b: Key-frame at 1. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        t: Time in [0, 1].
        start: Where to start, in the caller's coordinates. Default: linear interpolation of the aligned key-frames.
            *Shape:* ``(V, 3)``.
        example_based: One reference whose lengths, angles, volume and weights are interpolated between those of the
            key-frames, in place of two (Froehlich and Botsch 2011).
        fixed: Vertices that stay where the start has them. *Shape:* ``(V,)``, bool.
        size: Bounding-box diagonal of the whole that these shapes are a part of. Default: that of ``x_a``.
        max_steps: Newton steps at most.
    """
    first, second = x_a.double(), x_b.double()
    scale = CANONICAL_SIZE / ((first.amax(0) - first.amin(0)).norm() if size is None else size)
    weights = torch.from_numpy(connectivity.vertex_areas(first.numpy(), faces.numpy()))
    first, second = first * scale, second * scale
    back = best_fit(second, first, weights)
    aligned = back.apply(second)
    motion = fraction(back.inverse(), torch.tensor(t, dtype=torch.float64))
    x = torch.lerp(first, aligned, t)
    if start is not None:
        x = motion.inverse().apply(start.double() * scale)

    energy = Energy(Mesh.of(faces, len(first)), [Stretch(), SquaredBend(), Volume()])
    at_t = torch.tensor([t], dtype=torch.float64)
    rests = [energy.rest(energy.extend(y.T[:, None].contiguous())) for y in (first, aligned)]
    stiffness = [500.0, 10.0, 1000.0]
    both, weights_of_both = torch.stack([first, aligned])[None], torch.stack([1 - at_t, at_t], -1)
    reference = RestShapes(both, weights_of_both, [at_t.new_full((1, 1), k) for k in stiffness]).reference(energy)
    if example_based:
        reference = energy.reference_of(_interpolated(energy, rests[0], rests[1], t), stiffness)
    fixed = torch.zeros(len(first), dtype=torch.bool) if fixed is None else fixed
    start_rows = x.T[:, None].contiguous()
    rows, energies, stagnated = _minimise(energy, faces, start_rows, reference, fixed, max_steps)
    return FullSpaceResult((motion.apply(rows[:, 0].T) / scale).to(x_a), energies, stagnated)


def _interpolated(energy: Energy, first: Rest, second: Rest, t: float) -> Rest:
    """Measures and weights between those of two rest shapes; angles the short way round."""
    measures = tuple(
        a + t * part.term.difference(b, a)
        for part, a, b in zip(energy.parts, first.measures, second.measures, strict=True)
    )
    return Rest(measures, tuple(torch.lerp(a, b, t) for a, b in zip(first.weights, second.weights, strict=True)))


def _minimise(
    energy: Energy, faces: Tensor, rows: Tensor, reference: Reference, fixed: Tensor, max_steps: int
) -> tuple[Tensor, list[float], bool]:
    assembly = _Assembly(energy)
    energies = [float(energy.value(energy.extend(rows), reference))]
    for _ in range(max_steps):
        held = _held(faces, rows) | fixed
        direction = assembly.direction(EnergyAt(energy, energy.extend(rows), reference), held)
        for length in STEP_LENGTHS:
            moved = rows + length * torch.where(fixed, 0, direction)
            found = float(energy.value(energy.extend(moved), reference))
            if found < energies[-1]:
                break
        else:
            return rows, energies, True
        rows = moved
        energies.append(found)
        if len(energies) > STAGNATION_STEPS and energies[-1 - STAGNATION_STEPS] - found < TOLERANCE * found:
            return rows, energies, True
    return rows, energies, False


def _held(faces: Tensor, rows: Tensor) -> Tensor:
    """Vertices of collapsed triangles. *Shape:* ``(V,)``, bool."""
    p, q, r = (pick(rows[:, 0], corner) for corner in faces.unbind(1))
    longest = torch.stack([q - p, r - q, p - r]).square().sum(1).amax(0)
    altitude = cross(q - p, r - p).norm(dim=0) / longest.clamp_min(torch.finfo(rows.dtype).tiny)
    held = torch.zeros(rows.shape[-1], dtype=torch.bool)
    held[faces[altitude < HELD_ALTITUDE].flatten()] = True
    return held


class _Assembly:
    """The sparse Hessian, of one 3 x 3 block for each pair of vertices that an element couples.

    The volume couples all vertices, by a matrix of rank one that is treated apart. On an open surface the second
    derivative of the volume leaves out that the centroid moves along; its gradient does not.
    """

    def __init__(self, energy: Energy) -> None:
        self.energy, self.n = energy, energy.n_vertices

    def direction(self, at: EnergyAt, held: Tensor) -> Tensor:
        """Newton's direction, or a convex one where the Hessian is not positive definite. *Shape:* ``(3, 1, V)``."""
        energy = self.energy
        volume = torch.where(held, 0, energy.fold(at.terms[2].gradients)[:, 0])
        gradient = torch.where(held, 0, energy.fold(at.gradient())[:, 0])
        right = torch.stack([gradient, volume], -1)
        for convex in (False, True):
            solved = self._solve(self._matrix(at, held, convex), right)
            if solved is not None:
                break
        else:
            raise RuntimeError("the convex Hessian is not positive definite: the shape has numbers out of range")
        by_gradient, by_volume = solved.unbind(-1)
        # Sherman and Morrison.
        weight = at.terms[2].curvature
        part = weight * (volume * by_gradient).sum() / (1 + weight * (volume * by_volume).sum())
        return (part * by_volume - by_gradient)[:, None]

    def _matrix(self, at: EnergyAt, held: Tensor, convex: bool) -> sparse.csc_matrix:
        axes, size = torch.arange(3), 3 * self.energy.n_extended
        total = sparse.csc_matrix((size, size))
        for part, one in zip(self.energy.parts, at.terms, strict=True):
            n, gradients = len(part.corners), one.gradients
            # Second derivatives of edges that pull are never negative.
            curved = isinstance(part.term, Stretch) or not convex
            slope = (one.slope.clamp_min(0) if convex else one.slope) * curved
            local = slope * part.term.hessians(one.edge_vectors)
            if not part.term.total:
                local = local + (one.curvature * gradients)[:, :, None, None] * gradients
            ends = torch.cat([-torch.ones(1, n - 1), torch.eye(n - 1)]).to(local)
            values = torch.einsum("si,tj,icjdm->sctdm", ends, ends, local[..., 0, :])
            places = 3 * part.corners[:, None] + axes[:, None]
            row, column = places[:, :, None, None].expand_as(values), places.expand_as(values)
            entries = values.flatten().numpy(), (row.flatten().numpy(), column.flatten().numpy())
            total = total + sparse.csc_matrix(entries, (size, size))
        inner = total[: 3 * self.n, : 3 * self.n]
        ridge = np.repeat(RIDGE + HOLD * held.double().numpy(), 3) * abs(inner.diagonal().sum()) / (3 * self.n)
        return sparse.csc_matrix(inner + sparse.diags(ridge))

    @staticmethod
    def _solve(matrix: sparse.csc_matrix, right: Tensor) -> Tensor | None:
        """None where the matrix is not positive definite. *Shape:* ``(3, V, m) -> (3, V, m)``."""
        factor = factorize(matrix)
        # Without row exchanges the signs of the pivots are those of the eigenvalues.
        if (factor.U.diagonal() <= 0).any():
            return None
        flat = right.transpose(0, 1).flatten(0, 1).numpy()
        return torch.from_numpy(factor.solve(np.ascontiguousarray(flat))).unflatten(0, (-1, 3)).transpose(0, 1)
