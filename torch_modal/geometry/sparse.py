"""Sparse symmetric systems: factorised by SciPy, and for tensors differentiable, the same for every sample."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from torch_modal.geometry.functions import applied, lasting

# An inverse of so many unknowns takes 3.2 GB.
MOST_DENSE = 20_000


def factorize(matrix: sparse.spmatrix, ordering: str = "MMD_AT_PLUS_A") -> SuperLU:
    """Sparse LU of a symmetric positive definite matrix: no pivoting, which would spoil the ordering.

    Args:
        matrix: *Shape:* ``(n, n)``.
        ordering: SuperLU's name; ``"NATURAL"`` if the unknowns are in a good order already.
    """
    options = {"SymmetricMode": True}
    return splu(sparse.csc_matrix(matrix), permc_spec=ordering, diag_pivot_thresh=0.0, options=options)


class SparseSolver:
    """The inverse of a sparse symmetric positive definite matrix.

    SciPy's sparse LU in float64 on the CPU. On a GPU, where triangular solves of one sample wait for each other and
    products of matrices do not, the inverse itself, dense, up to :data:`MOST_DENSE` unknowns; beyond, tensors go to the
    CPU and back. Backward solves once more. Factors and inverses are made at the first use, and again after pickling.

    Args:
        matrix: *Shape:* ``(V, V)``.
        free: Unknowns to solve for; the others are zero. Default: all.
    """

    def __init__(self, matrix: sparse.spmatrix, free: NDArray[np.int64] | None = None) -> None:
        self.n = matrix.shape[0]
        self.free = np.arange(self.n) if free is None else free
        self._inner = matrix if free is None else matrix.tocsr()[free][:, free]
        self._factor: SuperLU | None = None
        self._inverses: dict[torch.device, Tensor] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Without the factorisation, which cannot be pickled, and inverses, which are large."""
        return {**self.__dict__, "_factor": None, "_inverses": {}}

    def __call__(self, right: Tensor) -> Tensor:
        """Solve for one or more columns. *Shape:* ``(..., V, m) -> (..., V, m)``."""
        return solve_by(lambda: self, right)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same for arrays. *Shape:* ``(V, m) -> (V, m)``."""
        if self._factor is None:
            self._factor = factorize(self._inner)
        out = np.zeros_like(right)
        out[self.free] = self._factor.solve(right[self.free])
        return out

    def factors(self) -> list[Tensor]:
        """``L D L^T`` of the matrix of the free unknowns.

        Returns:
            Which unknown is eliminated when; starts, rows and entries of the columns of ``L`` below its diagonal;
            ``D``. Whole numbers are int32.
        """
        factor = factorize(self._inner)
        below = sparse.tril(factor.L, -1, format="csc")
        order = np.empty_like(self.free)
        order[factor.perm_c] = self.free
        whole = [torch.from_numpy(part.astype(np.int32)) for part in (order, below.indptr, below.indices)]
        return [*whole, torch.from_numpy(below.data), torch.from_numpy(factor.U.diagonal())]

    def has_inverse(self, device: torch.device) -> bool:
        """Whether tensors there are multiplied by the inverse."""
        return device.type != "cpu" and len(self.free) <= MOST_DENSE

    def _inverse(self, device: torch.device) -> Tensor:
        dense = torch.from_numpy(self._inner.toarray()).to(device)
        return torch.cholesky_inverse(torch.linalg.cholesky(dense))

    def times_inverse(self, right: Tensor) -> Tensor:
        """The same by the dense inverse, in float64, on the device. *Shape:* ``(..., V, m) -> (..., V, m)``."""
        if right.device not in self._inverses:
            self._inverses[right.device] = lasting(self._inverse)(right.device)
        free = torch.from_numpy(self.free).to(right.device)
        columns = right.double().movedim(-2, 0)
        solved = self._inverses[right.device] @ columns.index_select(0, free).flatten(1)
        out = torch.zeros_like(columns).flatten(1).index_copy(0, free, solved)
        return out.reshape(columns.shape).movedim(0, -2).to(right).contiguous()


def solve_by(solver: Callable[[], SparseSolver], right: Tensor) -> Tensor:
    """Solve with what is made only then: inside ``torch.func`` transforms, no tensor can be read before.

    *Shape:* ``(..., V, m) -> (..., V, m)``.
    """
    if torch.compiler.is_compiling():  # it would go on into SciPy
        return torch.compiler.disable(_Solve.apply)(solver, right)
    return applied(_Solve, solver, right)


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(solver: Callable[[], SparseSolver], right: Tensor) -> Tensor:
        inverse = solver()
        if inverse.has_inverse(right.device):
            return inverse.times_inverse(right.detach())
        columns = right.detach().double().cpu().movedim(-2, 0)
        solved = inverse.solve(np.ascontiguousarray(columns.flatten(1).numpy()))
        return torch.from_numpy(solved).reshape(columns.shape).movedim(0, -2).to(right).contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.solver = inputs[0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor]:
        return None, _Solve.apply(ctx.solver, grads[0])

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], solver: Callable[[], SparseSolver], right: Tensor
    ) -> tuple[Tensor, int]:
        return _Solve.apply(solver, right.movedim(in_dims[1], 0)), 0


def graph_laplacian(edges: NDArray[np.int64], weights: NDArray[np.float64], n: int) -> sparse.csr_matrix:
    """``sum_e w_e (x_i - x_j)^2`` as a matrix. *Shape:* ``(E, 2), (E,) -> (n, n)``."""
    half = sparse.coo_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(n, n))
    adjacency = (half + half.T).tocsr()
    return (sparse.diags(np.asarray(adjacency.sum(1)).reshape(-1)) - adjacency).tocsr()
