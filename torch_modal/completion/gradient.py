"""Gradients of completed shapes in the observed points, by the implicit function theorem."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from torch_modal.arrays import FloatArray
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
        total = np.zeros(ctx.like.shape)
        for solve, slope in zip(ctx.solves, grad.detach().cpu().double().numpy(), strict=True):
            if solve is not None and slope.any():
                with torch.enable_grad():
                    np.add.at(total, solve.points.numbers, solve.adjoint(slope @ ctx.axes.T) @ ctx.axes)
        return None, None, None, torch.from_numpy(total).to(ctx.like)
