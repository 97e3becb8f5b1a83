"""Gradients of completed shapes in the observed points, by the implicit function theorem."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.autograd import is_double_backward
from torch_modal.completion.energy import PointEnergy
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.steps import TermsTowards, inverse_of_symmetric

TOLERANCE, PRODUCTS = 1e-8, 2000
"""Relative residual of the solution with the Hessian, and most products."""


class LastSolve(NamedTuple):
    """The last minimisation of a frame, at a size of 100."""

    x: Tensor
    """The minimiser. *Shape:* ``(1, V, 3)``."""
    energy: Energy
    rests: RestShapes
    points: PointEnergy
    observations: IntArray
    """The observation of each pair. *Shape:* ``(n,)``."""

    def adjoint(self, grad: FloatArray) -> FloatArray:
        """Gradient in the point of each pair, of a gradient in the shape. *Shape:* ``(V, 3) -> (n, 3)``."""
        terms = TermsTowards(self.energy, self.rests.reference(self.energy, self.x, relative=True))
        x = self.x.detach().requires_grad_()
        slope = torch.autograd.grad(terms.value(x).sum(), x, create_graph=True)[0]
        springs, shape = self.points.at(self.x), self.x.shape
        blocks = (terms.at(self.x).diagonal + springs.diagonal)[0].mT
        inverse = inverse_of_symmetric(blocks).permute(2, 0, 1)

        def product(field: FloatArray) -> FloatArray:
            d = torch.from_numpy(field).view(shape)
            total = torch.autograd.grad(slope, x, d, retain_graph=True)[0] + springs.product(d)
            return total.flatten().numpy()

        def precondition(field: FloatArray) -> FloatArray:
            return (inverse @ torch.from_numpy(field).view(-1, 3, 1)).flatten().numpy()

        n = grad.size
        hessian, start = (LinearOperator((n, n), matvec=f, dtype=np.float64) for f in (product, precondition))
        solution = cg(hessian, grad.reshape(-1), rtol=TOLERANCE, maxiter=PRODUCTS, M=start)[0]
        return 2 * self.points.forces(torch.from_numpy(solution).view(shape))[1].numpy()


def with_gradients(
    shapes: Tensor, points: Sequence[Tensor], solves: Sequence[LastSolve | None], axes: FloatArray
) -> Tensor:
    """Shapes as functions of the points of all observations; pairs and rest shapes are constants.

    Args:
        shapes: The minimisers, in the caller's coordinates. *Shape:* ``(T, V, 3)``.
        points: Of each observation. *Shape of each:* ``(n, 3)``.
        solves: How each shape was found; None where it is a constant.
        axes: Turns the caller's coordinates into the coordinates of the solves. *Shape:* ``(3, 3)``.
    """
    return _ShapesOfPoints.apply(solves, axes, shapes, *points)


class _ShapesOfPoints(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, solves: Sequence[LastSolve | None], axes: FloatArray, shapes: Tensor, *points: Tensor
    ) -> Tensor:
        ctx.solves, ctx.axes, ctx.like = solves, axes, [one.detach() for one in points]
        return shapes.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if is_double_backward(grad):
            raise RuntimeError("completed shapes have first derivatives only; take the gradient without create_graph")
        total = [np.zeros(one.shape) for one in ctx.like]
        for solve, own in zip(ctx.solves, grad.detach().cpu().double().numpy(), strict=True):
            if solve is None or not own.any():
                continue
            with torch.enable_grad():
                to_points = solve.adjoint(own @ ctx.axes.T) @ ctx.axes
            for number in np.unique(solve.observations):
                some = solve.observations == number
                np.add.at(total[number], solve.points.numbers[some], to_points[some])
        return None, None, None, *(torch.from_numpy(one).to(like) for one, like in zip(total, ctx.like, strict=True))
