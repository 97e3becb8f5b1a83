"""Gradients of completed shapes in the observed points, by the implicit function theorem."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.autograd import is_double_backward
from torch_modal.completion.energy import PointEnergy
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.steps import TermsTowards, conjugate_gradients, inverse_of_symmetric

TOLERANCE, PRODUCTS = 1e-8, 2000
"""Relative residual of the solution with the Hessian, and most products."""


class LastSolve(NamedTuple):
    """The last minimisation of a frame, at a size of 100."""

    x: Tensor
    """The minimiser. *Shape:* ``(1, V, 3)``."""
    energy: Energy
    rests: RestShapes
    points: PointEnergy

    def adjoint(self, grad: Tensor) -> Tensor:
        """Gradient in the point of each pair, of a gradient in the shape. *Shape:* ``(V, 3) -> (n, 3)``."""
        terms = TermsTowards(self.energy, self.rests.reference(self.energy, self.x, relative=True))
        with torch.enable_grad():
            x = self.x.detach().requires_grad_()
            slope = torch.autograd.grad(terms.value(x).sum(), x, create_graph=True)[0]
        springs = self.points.at(self.x)
        inverse = inverse_of_symmetric((terms.at(self.x).diagonal + springs.diagonal)[0].mT)
        solution = conjugate_gradients(
            lambda d: torch.autograd.grad(slope, x, d, retain_graph=True)[0] + springs.product(d),
            lambda residual: torch.einsum("ijv,bvj->bvi", inverse, residual),
            lambda a, b: (a * b).sum(),
            grad[None],
            PRODUCTS,
            TOLERANCE,
        )
        return 2 * self.points.forces(solution)[1]


class ShapesOfPoints(torch.autograd.Function):
    """Shapes as functions of all observed points; pairs and rest shapes are constants.

    Arguments are how each shape was found, None where it is a constant; the matrix that turns the caller's coordinates
    into the coordinates of the solves, *shape* ``(3, 3)``; the shapes, *shape* ``(T, V, 3)``; and the points, *shape*
    ``(n, 3)``.
    """

    @staticmethod
    def forward(
        ctx: Any, solves: Sequence[LastSolve | None], axes: FloatArray, shapes: Tensor, points: Tensor
    ) -> Tensor:
        """The shapes."""
        ctx.solves, ctx.axes, ctx.like = solves, axes, points.detach()
        return shapes.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient in the points."""
        if is_double_backward(grad):
            raise RuntimeError("completed shapes have first derivatives only; take the gradient without create_graph")
        total, axes = torch.zeros(ctx.like.shape, dtype=torch.float64), torch.from_numpy(ctx.axes)
        for solve, slope in zip(ctx.solves, grad.detach().cpu().double(), strict=True):
            if solve is not None and slope.any():
                total.index_add_(0, torch.from_numpy(solve.points.numbers), solve.adjoint(slope @ axes.mT) @ axes)
        return None, None, None, total.to(ctx.like)
