"""The mass matrix, and what M-orthogonality needs."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from torch_modal.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Mass:
    """The matrix M of a tetrahedral mesh; it acts alike on the three coordinates of each vertex.

    Attributes:
        matrix: Its entries for vertices, symmetric positive definite; diagonal if lumped. *Shape:* ``(N, N)``.
    """

    matrix: sp.csr_matrix

    @classmethod
    def of(cls, mass: "FloatArray | sp.spmatrix | Mass") -> "Mass":
        """From the mass of each vertex ``(N,)``, or a matrix ``(N, N)``."""
        if isinstance(mass, Mass):
            return mass
        return cls(sp.csr_matrix(mass if sp.issparse(mass) else sp.diags(mass)))

    def lumped(self) -> FloatArray:
        """Mass of each vertex: the sums of the rows. *Shape:* ``(N,)``."""
        return np.asarray(self.matrix.sum(axis=1)).reshape(-1)

    def of_vertices(self, vertices: IntArray) -> "Mass":
        """That of some of the vertices, which nothing connects with the others."""
        return Mass(sp.csr_matrix(self.matrix[vertices][:, vertices]))

    def for_coordinates(self) -> sp.csc_matrix:
        """The matrix with rows and columns for each coordinate. *Shape:* ``(3N, 3N)``."""
        return sp.kron(self.matrix, sp.identity(3), format="csc")

    def __matmul__(self, columns: FloatArray) -> FloatArray:
        """``M u`` for displacements with interleaved coordinates. *Shape:* ``(3N, k) -> (3N, k)``."""
        n, k = columns.shape[0] // 3, columns.shape[1]
        return (self.matrix @ np.ascontiguousarray(columns).reshape(n, 3 * k)).reshape(3 * n, k)

    def orthonormal(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``columns = q r`` with ``qᵀ M q = 1`` and an upper triangular ``r``, as QR is for ``M = 1``.

        Also where columns depend on each other: ``q`` is orthonormal nevertheless.

        Args:
            columns: No more than rows. *Shape:* ``(3N, k)``.
        """
        root = np.sqrt(np.repeat(self.lumped(), 3))[:, None]
        q, r = np.linalg.qr(root * columns)
        q /= root
        # In units of the lumped masses M is between 1/5 and 1, so this product is far from singular.
        upper = scipy.linalg.cholesky(q.T @ (self @ q))
        return scipy.linalg.solve_triangular(upper, q.T, trans="T").T, upper @ r
