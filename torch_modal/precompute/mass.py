"""Mass matrix and M-orthonormalisation."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from torch_modal.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Mass:
    """Mass matrix of a tetrahedral mesh, the same for the three coordinates.

    Attributes:
        matrix: Entries for vertices, symmetric positive definite; diagonal if lumped. *Shape:* ``(N, N)``.
    """

    matrix: sp.csr_matrix

    @classmethod
    def of(cls, mass: "FloatArray | sp.spmatrix | Mass") -> "Mass":
        """From vertex masses ``(N,)`` or a matrix ``(N, N)``."""
        if isinstance(mass, Mass):
            return mass
        return cls(sp.csr_matrix(mass if sp.issparse(mass) else sp.diags(mass)))

    def lumped(self) -> FloatArray:
        """Row sums: the mass of each vertex. *Shape:* ``(N,)``."""
        return np.asarray(self.matrix.sum(axis=1)).reshape(-1)

    def of_vertices(self, vertices: IntArray) -> "Mass":
        """Submatrix of some vertices."""
        return Mass(sp.csr_matrix(self.matrix[vertices][:, vertices]))

    def for_coordinates(self) -> sp.csc_matrix:
        """The matrix with rows and columns for each coordinate. *Shape:* ``(3N, 3N)``."""
        return sp.kron(self.matrix, sp.identity(3), format="csc")

    def __matmul__(self, columns: FloatArray) -> FloatArray:
        """``M u`` for displacements with interleaved coordinates. *Shape:* ``(3N, k) -> (3N, k)``."""
        n, k = columns.shape[0] // 3, columns.shape[1]
        return (self.matrix @ np.ascontiguousarray(columns).reshape(n, 3 * k)).reshape(3 * n, k)

    def orthonormal(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """QR factorisation in the M inner product: ``columns = q r`` with ``qᵀ M q = 1`` and upper triangular ``r``.

        Linearly dependent columns also give an orthonormal ``q``.

        Args:
            columns: At most as many as rows. *Shape:* ``(3N, k)``.
        """
        root = np.sqrt(np.repeat(self.lumped(), 3))[:, None]
        q, r = np.linalg.qr(root * columns)
        q /= root
        # Scaled by the lumped masses, the spectrum of M is within [1/5, 1]: the product is well conditioned.
        upper = scipy.linalg.cholesky(q.T @ (self @ q))
        return scipy.linalg.solve_triangular(upper, q.T, trans="T").T, upper @ r
