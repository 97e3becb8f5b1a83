"""In-betweens over all vertices: the slow optimum that everything else is measured against.

No modes, no coarse mesh: sparse Newton steps on 3V unknowns (the discrete-shell mean of Heeren et al. 2012, at any t).
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu
from torch import Tensor

from torch_modal.energy.linearised import Linearised, Reference, energy_of, gradient, linearise
from torch_modal.energy.shell import Measures, Rest, ShellEnergy, dihedral_hessian, length_hessian, wrap_angle
from torch_modal.geometry import connectivity
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.vectors import cross, pick
from torch_modal.nn.frame import DIAGONAL

STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.001)

# Added to the diagonal, relative to its mean: rigid motions change nothing.
RIDGE = 1e-9

# Eq. 5 has no area term, and some triangle always gains by becoming a needle. One whose altitude has fallen to this
# part of its longest side is held where it is: its dihedral angles would stop all others.
HELD_ALTITUDE = 0.005
HOLD = 1e9

# The energy stagnates when this many steps together gain less than the tolerance.
STAGNATION_STEPS = 5


class FullSpaceResult(NamedTuple):
    """Where Newton's method ended."""

    shape: Tensor
    """In the caller's coordinates. *Shape:* ``(V, 3)``."""
    energies: list[float]
    """Eq. 5 at the start and after each step, at a bounding-box diagonal of 100; it never rises."""
    stagnated: bool
    """Whether there was nothing more to gain."""
    n_held: int
    """Vertices of collapsed triangles that were held in the last step."""


def full_space(
    x_a: Tensor,
    x_b: Tensor,
    faces: Tensor,
    t: float = 0.5,
    *,
    start: Tensor | None = None,
    alpha: float = 500.0,
    beta: float = 10.0,
    gamma: float = 1000.0,
    example_based: bool = False,
    max_steps: int = 100,
    tolerance: float = 1e-8,
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
        alpha: Stretching stiffness.
        beta: Bending stiffness.
        gamma: Volume stiffness.
        example_based: One reference whose lengths, angles, volume and weights are interpolated between those of the
            key-frames, in place of two (Froehlich and Botsch 2011).
        max_steps: Newton steps at most.
        tolerance: The energy stagnates when five steps together gain less than this part of it.

    Raises:
        ValueError: Shapes that do not fit, or a time outside [0, 1].
    """
    if not 0 <= t <= 1:
        raise ValueError(f"t lies in [0, 1], from key-frame to key-frame; got {t}")
    if x_a.shape != x_b.shape or x_a.dim() != 2 or x_a.shape[-1] != 3:
        raise ValueError(f"x_a and x_b are both of shape (V, 3); got {tuple(x_a.shape)} and {tuple(x_b.shape)}")
    first, second = (x.detach().cpu().double() for x in (x_a, x_b))
    size = (first.amax(0) - first.amin(0)).norm()
    if not bool(torch.isfinite(size + second.sum())) or size == 0:
        raise ValueError("x_a and x_b must be finite and x_a must have a size; check them for NaN and infinity")
    scale = DIAGONAL / size
    shell = ShellEnergy(faces, alpha, beta, gamma)
    weights = torch.from_numpy(connectivity.vertex_areas(first.numpy(), shell.faces.numpy()))
    first, second = first * scale, second * scale
    back = best_fit(second, first, weights)
    aligned = back.apply(second)
    motion = back.inverse().fraction(torch.tensor(t, dtype=torch.float64))
    x = torch.lerp(first, aligned, t)
    if start is not None:
        x = motion.inverse().apply(start.detach().cpu().double() * scale)

    pulls = torch.tensor([1 - t]).double(), torch.tensor([t]).double()
    rests = [shell.rest(y[None]) for y in (first, aligned)]
    references = [Reference(rest, pull) for rest, pull in zip(rests, pulls, strict=True)]
    if example_based:
        references = [Reference(_interpolated(rests[0], rests[1], t), torch.ones(1, dtype=torch.float64))]
    rows, energies, stagnated, n_held = _minimise(shell, x.T[:, None].contiguous(), references, max_steps, tolerance)
    shape = motion.apply(rows[:, 0].T) / scale
    return FullSpaceResult(shape.to(x_a), energies, stagnated, n_held)


def _interpolated(first: Rest, second: Rest, t: float) -> Rest:
    """Measures and weights between those of two rest shapes; angles the short way round."""
    lengths, angles, volumes = (torch.lerp(a, b, t) for a, b in zip(first.measures, second.measures, strict=True))
    turn = wrap_angle(second.measures.angle - first.measures.angle)
    angles = first.measures.angle + t * turn
    weights = Measures(*(torch.lerp(a, b, t) for a, b in zip(first.weights, second.weights, strict=True)))
    return Rest(Measures(lengths, angles, volumes), weights)


def _minimise(
    shell: ShellEnergy, rows: Tensor, references: list[Reference], max_steps: int, tolerance: float
) -> tuple[Tensor, list[float], bool, int]:
    assembly = _Assembly(shell, rows.shape[-1])
    energies = [float(energy_of(shell, shell.measure_rows(rows), references))]
    held = torch.zeros(rows.shape[-1], dtype=torch.bool)
    for _ in range(max_steps):
        at = linearise(shell, rows, references)
        held = _held(shell, rows)
        direction = assembly.direction(rows, at, held)
        for length in STEP_LENGTHS:
            moved = rows + length * direction
            energy = float(energy_of(shell, shell.measure_rows(moved), references))
            if energy < energies[-1]:
                break
        else:
            return rows, energies, True, int(held.sum())
        rows = moved
        energies.append(energy)
        if len(energies) > STAGNATION_STEPS and energies[-1 - STAGNATION_STEPS] - energy < tolerance * energy:
            return rows, energies, True, int(held.sum())
    return rows, energies, False, int(held.sum())


def _held(shell: ShellEnergy, rows: Tensor) -> Tensor:
    """Vertices of collapsed triangles. *Shape:* ``(V,)``, bool."""
    p, q, r = (pick(rows[:, 0], corner) for corner in shell.faces.unbind(1))
    longest = torch.stack([q - p, r - q, p - r]).square().sum(1).amax(0)
    altitude = cross(q - p, r - p).norm(dim=0) / longest.clamp_min(torch.finfo(rows.dtype).tiny)
    held = torch.zeros(rows.shape[-1], dtype=torch.bool)
    held[shell.faces[altitude < HELD_ALTITUDE].flatten()] = True
    return held


class _Assembly:
    """The sparse Hessian: one 3 x 3 block for each pair of vertices that an edge, a hinge or a face couples.

    The blocks of a vertex with itself follow, because translations change nothing. The volume couples all vertices, by
    a matrix of rank one that is treated apart. On an open surface the second derivative of the volume leaves out that
    the centroid moves along; its gradient does not.
    """

    def __init__(self, shell: ShellEnergy, n_vertices: int) -> None:
        self.shell, self.n = shell, n_vertices
        faces, edges, hinges = (x.numpy() for x in (shell.faces, shell.edges, shell.hinges))
        i, j, k, m = hinges.T
        blocks = [(i, j), (k, i), (k, j), (m, i), (m, j), (k, m)]
        sides = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
        first = np.concatenate([edges[:, 0], *(a for a, _ in blocks), sides[0]])
        second = np.concatenate([edges[:, 1], *(b for _, b in blocks), sides[1]])
        keys, places = np.unique(
            np.minimum(first, second) * n_vertices + np.maximum(first, second), return_inverse=True
        )
        self.first, self.second = (torch.from_numpy(part) for part in np.divmod(keys, n_vertices))
        # Blocks that come in descending order are kept beside the others, and transposed at the end.
        self.places = torch.from_numpy(places.reshape(-1) + len(keys) * (first > second))
        self.opposite = torch.from_numpy(faces[:, [2, 0, 1]].T.ravel())

    def direction(self, rows: Tensor, at: Linearised, held: Tensor) -> Tensor:
        """Newton's direction, or a convex one where the Hessian is not positive definite. *Shape:* ``(3, 1, V)``."""
        volume = torch.where(held, 0, at.to_volume[:, 0])
        right = torch.stack([torch.where(held, 0, gradient(self.shell, at)[:, 0]), volume], -1)
        for convex in (False, True):
            solved = self._solve(self._matrix(rows, at, held, convex), right)
            if solved is not None:
                break
        else:
            raise RuntimeError("the convex Hessian is not positive definite: the shape has numbers out of range")
        by_gradient, by_volume = solved.unbind(-1)
        # Sherman and Morrison.
        weight = at.curvature.volume
        part = weight * (volume * by_gradient).sum() / (1 + weight * (volume * by_volume).sum())
        return (part * by_volume - by_gradient)[:, None]

    def _matrix(self, rows: Tensor, at: Linearised, held: Tensor, convex: bool) -> sparse.csc_matrix:
        pairs = self._blocks(rows, at, convex)
        both = torch.cat([pairs, pairs.transpose(0, 1)], -1)
        start, end = torch.cat([self.first, self.second]), torch.cat([self.second, self.first])
        diagonal = pairs.new_zeros(3, 3, self.n).index_add(-1, start, -both)
        diagonal = 0.5 * (diagonal + diagonal.transpose(0, 1))
        size = diagonal.diagonal().sum(-1).mean().abs() / 3
        axes = torch.arange(3)
        diagonal[axes, axes] += size * (RIDGE + HOLD * held.double())
        own = torch.arange(self.n)
        values = torch.cat([both, diagonal], -1)
        row = (3 * torch.cat([start, own]) + axes[:, None, None]).expand_as(values)
        column = (3 * torch.cat([end, own]) + axes[:, None]).expand_as(values)
        entries = values.flatten().numpy(), (row.flatten().numpy(), column.flatten().numpy())
        return sparse.csc_matrix(entries, (3 * self.n, 3 * self.n))

    def _blocks(self, rows: Tensor, at: Linearised, convex: bool) -> Tensor:
        """The block of each pair, of the first with the second vertex. *Shape:* ``(3, 3, P)``."""
        slope, curvature = at.slope, at.curvature
        pull = slope.length.clamp_min(0) if convex else slope.length
        on_edges = -(pull * length_hessian(at.edges) + curvature.length * at.to_edges[:, None] * at.to_edges)
        to_e, to_a, to_b = at.to_hinges
        to_i = -(to_e + to_a + to_b)
        products = [(to_i, to_e), (to_a, to_i), (to_a, to_e), (to_b, to_i), (to_b, to_e), (to_a, to_b)]
        on_hinges = [curvature.angle * p[:, None] * q for p, q in products]
        # p.(q x r) has the block -[r] between p and q.
        x, y, z = pick(rows - pick(rows, self.shell.used).mean(-1, keepdim=True), self.opposite)
        zero = torch.zeros_like(x)
        on_sides = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero]).unflatten(0, (3, 3)) * (slope.volume / 6)
        if convex:
            on_sides = torch.zeros_like(on_sides)
        else:
            bent = slope.angle * dihedral_hessian(at.spokes)
            on_hinges[:5] = [a + b for a, b in zip(on_hinges, bent, strict=False)]
        parts = torch.cat([on_edges, *on_hinges, on_sides], -1)[:, :, 0]
        n_pairs = len(self.first)
        ascending, descending = parts.new_zeros(3, 3, 2 * n_pairs).index_add(-1, self.places, parts).split(n_pairs, -1)
        return ascending + descending.transpose(0, 1)

    @staticmethod
    def _solve(matrix: sparse.csc_matrix, right: Tensor) -> Tensor | None:
        """None where the matrix is not positive definite. *Shape:* ``(3, V, m) -> (3, V, m)``."""
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        # Without row exchanges the signs of the pivots are those of the eigenvalues.
        if (factor.U.diagonal() <= 0).any():
            return None
        flat = right.transpose(0, 1).flatten(0, 1).numpy()
        return torch.from_numpy(factor.solve(np.ascontiguousarray(flat))).unflatten(0, (-1, 3)).transpose(0, 1)
