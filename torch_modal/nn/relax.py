"""Eq. 5 with every vertex free: gradient, and a convex Hessian that is applied without being assembled."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.energy.linearised import Linearised, Reference, energy_of, gather, gradient, linearise
from torch_modal.energy.shell import ShellEnergy
from torch_modal.geometry.vectors import norm

# Added to the diagonal blocks, relative to their trace: a vertex in a flat fan has no stiffness along its normal.
RIDGE = 1e-6

# What is tried where a whole step goes uphill.
STEP_LENGTHS = (0.5, 0.25, 0.1, 0.03)


class ConvexHessian:
    """Gauss-Newton's Hessian and the second-order term of stretched edges: never negative.

    Args:
        shell: The energy.
        at: Where it is linearised.
    """

    def __init__(self, shell: ShellEnergy, at: Linearised) -> None:
        self.shell, self.at = shell, at
        tiny = torch.finfo(at.edges.dtype).tiny
        #: Stiffness across each edge; along it, there is the curvature. *Shape:* ``(B, E)``.
        self.across = at.slope.length.clamp_min(0) / norm(at.edges).clamp_min(tiny**0.5)
        self.along = at.curvature.length - self.across

    def __call__(self, rows: Tensor) -> Tensor:
        """The product with displacements. *Shape:* ``(3, B, V)``."""
        shell, at = self.shell, self.at
        edges, spokes = shell.edge_vectors(rows), shell.hinge_spokes(rows)
        on_edges = self.across * edges + (self.along * (at.to_edges * edges).sum(0)) * at.to_edges
        on_hinges = (at.curvature.angle * (at.to_hinges * spokes).sum((0, 1))) * at.to_hinges
        swelling = at.curvature.volume * (at.to_volume * rows).sum((0, -1))
        return gather(shell, on_edges, on_hinges, swelling, at.to_volume)

    def inverse_diagonal(self) -> Tensor:
        """Inverses of the 3 x 3 blocks of all vertices. *Shape:* ``(3, 3, B, V)``."""
        shell, at = self.shell, self.at
        to_e, to_a, to_b = at.to_hinges
        ends = torch.cat([-(to_e + to_a + to_b), to_e, to_a, to_b], -1)
        on_edges = self.along * at.to_edges[:, None] * at.to_edges
        axes = torch.arange(3, device=on_edges.device)
        on_edges = on_edges.index_put((axes, axes), self.across.expand(3, *self.across.shape), accumulate=True)
        on_ends = (at.curvature.angle.repeat(1, 4) * ends)[:, None] * ends
        index = torch.cat([shell.edges.T.flatten(), shell.hinges.T.flatten()])
        blocks = torch.zeros_like(at.to_volume).expand(3, *at.to_volume.shape)
        blocks = blocks.index_add(-1, index, torch.cat([on_edges, on_edges, on_ends], -1))
        return _inverse_of_symmetric(blocks)


def _inverse_of_symmetric(blocks: Tensor) -> Tensor:
    """Inverse by cofactors, with a ridge. *Shape:* ``(3, 3, ...)``."""
    trace = blocks[0, 0] + blocks[1, 1] + blocks[2, 2]
    # Vertices that no face uses have no stiffness at all, and no gradient either.
    trace = torch.where(trace > 0, trace, 1)
    scaled = blocks / trace
    a, d, f = (scaled[i, i] + RIDGE for i in range(3))
    b, c, e = scaled[0, 1], scaled[0, 2], scaled[1, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * aa + b * bb + c * cc
    cofactors = torch.stack([aa, bb, cc, bb, a * f - c * c, b * c - a * e, cc, b * c - a * e, a * d - b * b])
    return (cofactors / (determinant * trace)).unflatten(0, (3, 3))


def relax(shell: ShellEnergy, x: Tensor, references: Sequence[Reference], n_steps: int, n_products: int) -> Tensor:
    """Steps of a truncated Newton method on all vertices, never uphill.

    Each step solves with :class:`ConvexHessian` by conjugate gradients, preconditioned by its diagonal blocks and cut
    short: what a modal space leaves to be done is local, and a few iterations see far enough. Every sample takes the
    same number of both, so that the result is differentiable like any other expression.

    Args:
        shell: The energy.
        x: Where to start. *Shape:* ``(B, V, 3)``.
        references: Rest shapes, and the factor of each one's energy.
        n_steps: Newton steps.
        n_products: Iterations of conjugate gradients in each.

    Returns:
        *Shape:* ``(B, V, 3)``.
    """
    rows = x.movedim(-1, 0).contiguous()
    energy = energy_of(shell, shell.measure_rows(rows), references)
    for _ in range(n_steps):
        at = linearise(shell, rows, references)
        direction = _conjugate_gradients(ConvexHessian(shell, at), -gradient(shell, at), n_products)
        rows, energy = _descend(shell, rows, direction, energy, references)
    return rows.movedim(0, -1)


def _conjugate_gradients(hessian: ConvexHessian, right: Tensor, n_products: int) -> Tensor:
    """An approximate solution. *Shape:* ``(3, B, V)``."""

    def precondition(residual: Tensor) -> Tensor:
        return (inverse * residual).sum(1)

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum((0, -1))

    def quotient(a: Tensor, b: Tensor) -> Tensor:
        # A sample that is solved exactly has nothing left: 0 / 0.
        return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)[:, None]

    inverse = hessian.inverse_diagonal()
    solution = torch.zeros_like(right)
    residual = right
    preconditioned = precondition(residual)
    direction = preconditioned
    size = dot(residual, preconditioned)
    for k in range(n_products):
        product = hessian(direction)
        length = quotient(size, dot(direction, product))
        solution = solution + length * direction
        if k == n_products - 1:
            break
        residual = residual - length * product
        preconditioned = precondition(residual)
        previous, size = size, dot(residual, preconditioned)
        direction = preconditioned + quotient(size, previous) * direction
    return solution


def _descend(
    shell: ShellEnergy, rows: Tensor, direction: Tensor, energy: Tensor, references: Sequence[Reference]
) -> tuple[Tensor, Tensor]:
    """The longest of the steps that goes downhill, of each sample, and its energy."""
    best, lowest = rows, energy
    moved = torch.zeros_like(energy, dtype=torch.bool)
    for length in (1.0, *STEP_LENGTHS):
        candidate = rows + length * direction
        value = energy_of(shell, shell.measure_rows(candidate), references)
        better = ~moved & (value < energy)
        best = torch.where(better[:, None], candidate, best)
        lowest = torch.where(better, value, lowest)
        moved = moved | better
        if bool(moved.all()):
            break
    return best, lowest
