"""An energy of some free vertices, minimised to convergence by Newton's method with sparse factors."""

import numpy as np
import torch
from scipy import sparse
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import as_normal_tensor, is_double_backward, outside_inference_mode, run_outside_transforms
from torch_modal.elastic.energy import ENERGY_ROUNDING, AssembledTerm, Energy, EnergyAt, Linearised, Reference
from torch_modal.elastic.minimise import Solution, Status
from torch_modal.elastic.steps import conjugate_gradients
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.sparse import Solve, factorize, solve_by

# Stiffness towards the start, relative to the mean edge: a vertex in a flat fan has none along its normal, and
# a loose piece none against rigid motions.
MOVE_RIDGE = 1e-6

# A step that is smaller than this leads to the minimum: the next would be its square.
SMALL_STEP = 1e-8 * CANONICAL_SIZE

# Armijo's constant, and the parts of a step that are tried.
DECREASE, LENGTHS = 1e-4, [0.5**k for k in range(20)]

# Iterations of conjugate gradients at most; their residuals of a step, and of a gradient. With factors of all but the
# volume, which is of low rank, two to five are enough.
MOST_ITERATIONS = 100
RESIDUAL_OF_STEP, RESIDUAL_OF_GRADIENT = 1e-3, 1e-13

Placement = tuple[Tensor, Reference]
"""The vertices at the start, *shape* ``(B, V, 3)``, and the reference of the energy."""


class FreeVertices(nn.Module):
    """The energy in the displacements of some vertices, with the others fixed, in float64.

    It has the methods of a :class:`~torch_modal.elastic.modal.ModalEnergy`, and :meth:`inverse` instead of a Hessian.

    Args:
        energy: The energy.
        free: Vertices that move. *Shape:* ``(n,)``.
    """

    free: Tensor

    def __init__(self, energy: Energy, free: Tensor) -> None:
        super().__init__()
        self.energy = energy
        self.register_buffer("free", free, persistent=False)

    @property
    def n_amplitudes(self) -> int:
        """Number of coordinates of the free vertices."""
        return 3 * len(self.free)

    def shapes(self, a: Tensor, start: Tensor) -> Tensor:
        """All vertices. *Shape:* ``(B, 3 n), (B, V, 3) -> (B, V, 3)``."""
        return start.index_add(1, self.free, a.unflatten(-1, (-1, 3)))

    def value_and_gradient(self, a: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
        """Energy and gradient, which can be differentiated in all that the placement holds.

        *Shape:* ``(B, 3 n) -> (B,), (B, 3 n)``.
        """
        at, ridge = self._linearise(a, placement), self._ridge(placement)
        gradient = self.energy.fold(at.gradient()).movedim(0, -1)[:, self.free].flatten(1)
        return at.value + 0.5 * (ridge * a * a).sum(-1), gradient + ridge * a

    def _linearise(self, a: Tensor, placement: Placement) -> EnergyAt:
        rows = self.shapes(a, placement[0]).movedim(-1, 0).contiguous()
        return EnergyAt(self.energy, self.energy.extend(rows), placement[1])

    @staticmethod
    def _ridge(placement: Placement) -> Tensor:
        return MOVE_RIDGE * placement[1].records[0][..., 0, :].mean(-1, keepdim=True).clamp_min(1)

    # ------------------------------------------------------------------------------------------------ Newton's method
    @outside_inference_mode
    def minimise(self, a: Tensor, placement: Placement, max_steps: int, tolerance: float) -> Solution:
        """Newton steps of each sample alone; arguments as for :func:`~torch_modal.elastic.minimise.minimise`.

        A sample has converged where a step is below :data:`SMALL_STEP`; the tolerance plays no part.
        """
        a, placement = trees.map_leaves((a, placement), as_normal_tensor)  # products with the Hessian are gradients
        each = [self._descend(a[i : i + 1], trees.rows(placement, slice(i, i + 1)), max_steps) for i in range(len(a))]
        if not each:
            return Solution(a, a.sum(-1), a.sum(-1), *(torch.zeros(0, dtype=torch.int64, device=a.device),) * 2)
        return trees.join(each)  # type: ignore[no-any-return]

    def _descend(self, a: Tensor, placement: Placement, max_steps: int) -> Solution:
        value, gradient = self.value_and_gradient(a, placement)
        first, n_steps = gradient.norm(dim=-1).clamp_min(torch.finfo(a.dtype).tiny), 0
        status = Status.OUT_OF_STEPS if first.isfinite() else Status.INVALID
        while status == Status.OUT_OF_STEPS and n_steps < max_steps:
            step = self._solver(a, placement, RESIDUAL_OF_STEP)(-gradient)
            if bool(step.abs().max() <= SMALL_STEP):  # energies do not resolve it
                a, status = a + step, Status.CONVERGED
                break
            slope, bound = (gradient * step).sum(), value + ENERGY_ROUNDING * torch.finfo(a.dtype).eps * value.abs()
            for length in LENGTHS:
                there, gradient_there = self.value_and_gradient(a + length * step, placement)
                if there <= bound + DECREASE * length * slope:
                    a, value, gradient, n_steps = a + length * step, there, gradient_there, n_steps + 1
                    break
            else:
                status = Status.STALLED
        counts = (torch.tensor([number], device=a.device) for number in (n_steps, status))
        return Solution(a, value, gradient.norm(dim=-1) / first, *counts)

    # -------------------------------------------------------------------------------------------- the Hessian's inverse
    def inverse(self, a: Tensor, placement: Placement, converged: Tensor) -> Solve:
        """Products with the inverse of the Hessian, differentiable in the vector, the amplitudes and the placement.

        Those of samples that did not converge are zero. *Shape:* ``(B, 3 n) -> (B, 3 n)``.
        """
        tensors, tree = trees.leaves(placement), trees.skeleton(placement)

        def make(a: Tensor, converged: Tensor, *tensors: Tensor) -> list[Solve]:
            flat = [x.flatten(0, x.dim() - n) for x, n in zip((a, converged, *tensors), ranks, strict=True)]
            n = max(map(len, flat))  # under vmap, some are shared by all samples
            a, converged, *others = (x.repeat(n // len(x), *[1] * (x.dim() - 1)) for x in flat)
            place = trees.fill(tree, others)
            rows = [slice(i, i + 1) for i in range(n)]
            return [
                self._solver(a[i], trees.rows(place, i), RESIDUAL_OF_GRADIENT)
                if bool(converged[i])
                else torch.zeros_like
                for i in rows
            ]

        ranks = [x.dim() for x in (a, converged, *tensors)]
        solvers: list[Solve] = run_outside_transforms(make, a, converged, *tensors)

        def solve_all(right: Tensor) -> Tensor:
            rows = right.flatten(0, -2).split(1)
            return torch.cat([solvers[i % len(solvers)](row) for i, row in enumerate(rows)]).view_as(right)

        def solve(right: Tensor) -> Tensor:
            solution = solve_by(solve_all, right)
            if is_double_backward(solution, a, *tensors):
                # Its derivative is the derivative of the Hessian's product, solved once more.
                product = torch.func.vjp(lambda a: self.value_and_gradient(a, placement)[1], a)[1](solution)[0]
                solution = solution + solve_by(solve_all, torch.where(converged[:, None], right - product, 0))
            return solution

        return solve

    @torch.no_grad()
    def _solver(self, a: Tensor, placement: Placement, tolerance: float) -> Solve:
        """Solves with the Hessian of one sample by conjugate gradients, preconditioned by factors of all but totals.

        Where that is indefinite, it ends early, in a direction that goes downhill.
        """
        at = self._linearise(a, placement)
        try:
            precondition = self._factors(at, placement, False)
        except (ValueError, RuntimeError):  # the latter where it is singular
            precondition = self._factors(at, placement, True)
        with torch.enable_grad():
            leaf = a.detach().requires_grad_()
            slope = self.value_and_gradient(leaf, placement)[1]
        return lambda right: conjugate_gradients(
            lambda field: torch.autograd.grad(slope, leaf, field, retain_graph=True)[0],
            precondition,
            lambda a, b: (a * b).sum(),
            right,
            MOST_ITERATIONS,
            tolerance,
        )

    def _factors(self, at: EnergyAt, placement: Placement, convex: bool) -> Solve:
        """The inverse of the Hessian of all but totals, or of its part that is never negative.

        Raises:
            ValueError: It is not positive definite.
        """
        free, axes = self.free.cpu().numpy(), np.arange(3)
        unknowns = (3 * free[:, None] + axes).reshape(-1)
        whole = sparse.csr_matrix((3 * self.energy.n_extended,) * 2)
        for summand, one in zip(self.energy.parts, at.terms, strict=True):
            if not summand.term.total:
                blocks = _hessians(summand, one, convex)[..., 0, :].cpu().numpy()
                coordinates = 3 * summand.corners.cpu().numpy()[:, None] + axes[:, None]  # (n, 3, M)
                rows = np.broadcast_to(coordinates[:, :, None, None], blocks.shape)
                columns = np.broadcast_to(coordinates, blocks.shape)
                entries = blocks.reshape(-1), (rows.reshape(-1), columns.reshape(-1))
                whole = whole + sparse.csr_matrix(entries, whole.shape)
        # Not CHOLMOD, which prints where a matrix is indefinite.
        factors = factorize(whole[unknowns][:, unknowns] + float(self._ridge(placement)) * sparse.eye(len(unknowns)))
        if not factors.U.diagonal().min() > 0:
            raise ValueError("the Hessian is not positive definite")
        return lambda right: torch.from_numpy(factors.solve(right.cpu().numpy().T).T).to(right)


def _hessians(summand: AssembledTerm, one: Linearised, convex: bool) -> Tensor:
    """Hessians of the energies of elements in their vertices. *Shape:* ``(n, 3, n, 3, B, M)``."""
    curvature = one.curvature if convex or one.beyond is None else one.curvature + one.beyond
    slope = one.slope
    if convex:  # what stretched elements of two vertices have across; others may have any sign
        slope = slope.clamp_min(0) if len(one.gradients) == 1 else torch.zeros_like(slope)
    outer = (curvature * one.gradients)[:, :, None, None] * one.gradients
    blocks = outer + slope * summand.term.hessians(one.edge_vectors)
    for _ in range(2):
        blocks = torch.stack(summand.on_corners(blocks)).movedim((0, 1), (2, 3))
    return blocks
