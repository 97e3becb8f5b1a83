"""Shapes of all vertices that follow coarse ones, with the details of whole shapes."""

import numpy as np
import torch
from scipy import sparse
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
        used = np.flatnonzero(coarse.clusters >= 0)
        n, edges = len(problem.template), problem.mesh.edges
        near = sparse.identity(n) + sparse.csr_matrix((np.ones(len(edges)), edges.T), shape=(n, n))
        near = near + near.T
        weights = sparse.csr_matrix((np.ones(len(used)), (used, coarse.clusters[used])), shape=(n, coarse.n_vertices))
        # Rings of neighbours as wide as a cluster make the weights smooth.
        for _ in range(int(np.ceil(np.sqrt(len(used) / coarse.n_vertices))) - 1):
            weights = near @ weights
        self.weights = sparse.diags(1 / np.maximum(np.asarray(weights.sum(1)).ravel(), 1)) @ weights

    def add(self, time: float, shape: Tensor) -> Tensor:
        """The shape of all vertices at a time. *Shape:* ``(V_coarse, 3) -> (V, 3)``."""
        problem, y = self.problem, shape.numpy()
        x = problem.template
        if self._path is not None:
            x = self._path(problem.whole, float(np.clip(time, *problem.times[[0, -1]])))
        elif len(problem.times):
            x = problem.whole[0]
        centres = self.coarse.restrict(x.numpy())
        rotations = vertex_rotations(centres, y, self.coarse.faces)
        moves = y - np.einsum("cij,cj->ci", rotations, centres)
        turned = (self.weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        placed: FloatArray = np.einsum("vij,vj->vi", turned, x.numpy()) + self.weights @ moves
        unused = self.coarse.clusters < 0
        placed[unused] = best_fit(torch.from_numpy(centres), shape).apply(x)[unused].numpy()
        return torch.from_numpy(placed)
