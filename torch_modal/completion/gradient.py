"""Gradients of completed shapes in the observed points, by the implicit function theorem."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, gmres
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.energy import PointEnergy
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.steps import TermsTowards, inverse_of_symmetric

TOLERANCE, RESTART, RESTARTS = 1e-6, 200, 6
"""Relative residual of the adjoint, products until GMRES begins again, and how often at most."""


class LastSolve(NamedTuple):
    """The last minimisation of all frames, at a size of 100."""

    x: Tensor
    """The minimisers. *Shape:* ``(T, V, 3)``."""
    energy: Energy
    rests: Callable[[Tensor], list[RestShapes]]
    """The rest shapes of each frame, as functions of the shapes of all."""
    points: list[PointEnergy]
    """Of each frame."""
    smooth: bool
    """True where the gradients are exact."""

    def adjoint(self, grad: Tensor) -> Tensor:
        """Gradient in the points of all pairs, of a gradient in the shapes. *Shape:* ``(T, V, 3) -> (n, 3)``.

        Frames are rest shapes of each other, so that the matrix is not symmetric.
        """
        with torch.enable_grad():
            x, others = (self.x.detach().requires_grad_() for _ in range(2))
            # Markers are minimised until the start of the last minimisation, which softens needles, is its result.
            starts = others if self.smooth else others.detach()
            terms = [
                TermsTowards(self.energy, rests.reference(self.energy, other, relative=True), rests.anchors)
                for rests, other in zip(self.rests(others), starts[:, None], strict=True)
            ]
            values = [term.value(one).sum() for term, one in zip(terms, x[:, None], strict=True)]
            slope = torch.autograd.grad(torch.stack(values).sum(), x, create_graph=True)[0]
        springs = [points.at(one[None]) for points, one in zip(self.points, self.x, strict=True)]
        tangents = [points.tangent(one[None]) for points, one in zip(self.points, self.x, strict=True)]
        diagonal = torch.cat([term.at(one[None]).diagonal for term, one in zip(terms, self.x, strict=True)])
        diagonal = diagonal + torch.cat([one.diagonal for one in springs])
        inverse = inverse_of_symmetric(diagonal.detach().movedim(-1, 0))

        def transposed(flat: FloatArray) -> FloatArray:
            field = torch.from_numpy(flat).view_as(self.x)
            parts = torch.autograd.grad(slope, (x, others), field, retain_graph=True, allow_unused=True)
            pulls = [
                p.spread(p.forces(one[None], stiffness=k)[1])
                for p, one, k in zip(self.points, field, tangents, strict=True)
            ]
            return sum([part for part in parts if part is not None], torch.cat(pulls)).numpy().ravel()

        def precondition(flat: FloatArray) -> FloatArray:
            return torch.einsum("ijtv,tvj->tvi", inverse, torch.from_numpy(flat).view_as(self.x)).numpy().ravel()

        n = grad.numel()
        matrix, preconditioner = (LinearOperator((n, n), f, dtype=np.float64) for f in (transposed, precondition))
        options = {"rtol": TOLERANCE, "restart": RESTART, "maxiter": RESTARTS}
        flat, _ = gmres(matrix, grad.numpy().ravel(), M=preconditioner, **options)
        solution = torch.from_numpy(flat).view_as(self.x)
        forces = [
            p.forces(one[None], stiffness=k)[1] for p, one, k in zip(self.points, solution, tangents, strict=True)
        ]
        return 2 * torch.cat(forces)

    def pull_back(self, slopes: Tensor, n: int) -> Tensor:
        """:meth:`adjoint`, added up over the pairs of each of n observed points. *Shape:* ``(T, V, 3) -> (n, 3)``."""
        numbers = np.concatenate([points.numbers for points in self.points])
        return slopes.new_zeros(n, 3).index_add(0, torch.from_numpy(numbers), self.adjoint(slopes))
