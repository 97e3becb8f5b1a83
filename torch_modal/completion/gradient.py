"""Gradients of completed shapes in the observed points, by the implicit function theorem."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse.linalg import LinearOperator, gmres
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.energy import PointEnergy
from torch_modal.completion.markers import MarkerShape
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.steps import TermsTowards, inverse_of_symmetric

TOLERANCE, RESTART, RESTARTS = 1e-6, 200, 6
"""Relative residual of the adjoint, products until GMRES begins again, and how often at most."""


class LastSolve(NamedTuple):
    """The last minimisation of all frames, at a size of 100."""

    x: Tensor
    """The minimisers. *Shape:* ``(T, V, 3)``."""
    own: Tensor
    """Rest shapes of each frame for itself. *Shape:* ``(T, V, 3)``."""
    energy: Energy
    rests: Callable[[Tensor, Tensor], list[RestShapes]]
    """All rest shapes of each frame, as functions of the shapes of all and the own ones."""
    points: list[PointEnergy]
    """Of each frame."""
    markers: list[MarkerShape | None]
    """The own rest shapes that are functions of points."""
    smooth: bool
    """True where the gradients are exact."""

    def pull_back(self, grad: Tensor, n: int) -> Tensor:
        """Gradient in all n observed points, from the gradient in the shapes. *Shape:* ``(T, V, 3) -> (n, 3)``.

        Frames are rest shapes of each other, so that the matrix is not symmetric.
        """
        with torch.enable_grad():
            x, others, own = (each.detach().clone().requires_grad_() for each in (self.x, self.x, self.own))
            # Markers are minimised until the start of the last minimisation, which softens needles, is its result.
            starts = others if self.smooth else others.detach()
            terms = [
                TermsTowards(self.energy, rests.reference(self.energy, other, relative=True), rests.anchors)
                for rests, other in zip(self.rests(others, own), starts[:, None], strict=True)
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

        size = grad.numel()
        matrix, preconditioner = (LinearOperator((size, size), f, dtype=np.float64) for f in (transposed, precondition))
        options = {"rtol": TOLERANCE, "restart": RESTART, "maxiter": RESTARTS}
        flat, _ = gmres(matrix, grad.numpy().ravel(), M=preconditioner, **options)
        solution = torch.from_numpy(flat).view_as(self.x)
        forces = [
            p.forces(one[None], stiffness=k)[1] for p, one, k in zip(self.points, solution, tangents, strict=True)
        ]
        total, numbers = grad.new_zeros(n, 3), np.concatenate([points.numbers for points in self.points])
        total.index_add_(0, torch.from_numpy(numbers), 2 * torch.cat(forces))
        if any(self.markers):
            (to_own,) = torch.autograd.grad(slope, own, -solution, retain_graph=True)
            for one, to in zip(self.markers, to_own, strict=True):
                if one is not None:
                    (to_points,) = torch.autograd.grad(one.x, one.points, to, retain_graph=True)
                    total.index_add_(0, torch.from_numpy(one.numbers), to_points)
        return total
