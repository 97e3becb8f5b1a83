"""Shapes of all vertices that follow coarse ones, with the details of whole shapes."""

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.frames import CompletionProblem
from torch_modal.geometry.rigid import best_fit
from torch_modal.modes.carrying import vertex_rotations
from torch_modal.modes.coarsening import Coarsening
from torch_modal.motion.path import Path


class Details:
    r"""Embedded deformation (Sumner et al. 2007): vertices move rigidly with the coarse vertices around them.

    A vertex at :math:`x` goes to :math:`\sum_c w_c (y_c + R_c (x - x_c))`, with the mean places :math:`x_c` of clusters
    in a whole shape, or in the path through whole ones at the time, their places :math:`y_c` and rotations. On a mesh
    that is not coarsened this is the coarse shape.

    Args:
        problem: The whole shapes.
        coarse: Clusters of their vertices.
    """

    def __init__(self, problem: CompletionProblem, coarse: Coarsening) -> None:
        self.problem, self.coarse = problem, coarse
        whole, times = problem.whole, problem.times.tolist()
        self._path = Path(whole, problem.faces, times=times) if len(times) > 1 else None
        size = np.count_nonzero(coarse.clusters >= 0) / coarse.n_vertices
        # Rings of neighbours as wide as a cluster.
        self.weights = coarse.weights(problem.mesh, int(np.ceil(np.sqrt(size))) - 1)

    def add(self, time: float, *shapes: Tensor) -> list[Tensor]:
        """The shapes of all vertices at a time. *Shape of each:* ``(V_coarse, 3) -> (V, 3)``."""
        problem = self.problem
        x = problem.template
        if self._path is not None:
            x = self._path(problem.whole, float(np.clip(time, *problem.times[[0, -1]])))
        elif len(problem.times):
            x = problem.whole[0]
        centres, unused, found = self.coarse.restrict(x.numpy()), self.coarse.clusters < 0, []
        for shape in shapes:
            rotations = vertex_rotations(centres, shape.numpy(), self.coarse.faces)
            moves = shape.numpy() - np.einsum("cij,cj->ci", rotations, centres)
            turned = (self.weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
            placed: FloatArray = np.einsum("vij,vj->vi", turned, x.numpy()) + self.weights @ moves
            placed[unused] = best_fit(torch.from_numpy(centres), shape).apply(x)[unused].numpy()
            found.append(torch.from_numpy(placed))
        return found
