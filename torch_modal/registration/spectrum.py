"""Laplacian eigenfunctions and geodesic distances on a coarse copy of a surface."""

from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry import inspect
from torch_modal.geometry.decimation import decimate
from torch_modal.registration.surface import (
    MeshSurface,
    largest_piece,
    referenced,
    sewn,
    without_dust,
)

N_COARSE = 2000
"""Approximate number of vertices of the coarse copies."""
CUT = 0.04
"""Widest cut through a surface that is closed, in diagonals."""
N_FUNCTIONS = 60
"""Number of eigenfunctions, including the constant one."""


class SpectralShape:
    """The largest piece of a surface, decimated and scaled to unit area.

    Args:
        surface: The fine surface.
    """

    def __init__(self, surface: MeshSurface) -> None:
        coarse = decimated(surface, N_COARSE)
        self.scale = np.sqrt(coarse.area)
        """Unit of length of the coarse copy, in units of the fine surface."""
        self.coarse = MeshSurface(coarse.vertices / self.scale, coarse.faces)

    def __len__(self) -> int:
        """Number of coarse vertices."""
        return len(self.coarse.vertices)

    @property
    def positions(self) -> FloatArray:
        """Coarse vertices in the units of the fine surface. *Shape:* ``(n, 3)``."""
        return self.coarse.vertices * self.scale

    @cached_property
    def _spectrum(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        laplacian, mass = extras.require("robust_laplacian", "register", "registration").mesh_laplacian(
            self.coarse.vertices, self.coarse.faces
        )
        n = len(self)
        count = min(N_FUNCTIONS, n - 2)
        # A small shift: the constant function makes the matrix singular.
        values, functions = eigsh(laplacian.tocsc(), count, mass.tocsc(), sigma=-0.01, v0=np.ones(n) + np.arange(n) / n)
        return values, functions, mass.diagonal()

    @property
    def eigenvalues(self) -> FloatArray:
        """*Shape:* ``(k,)``."""
        return self._spectrum[0]

    @property
    def functions(self) -> FloatArray:
        """Orthonormal in the mass. *Shape:* ``(n, k)``."""
        return self._spectrum[1]

    @property
    def mass(self) -> FloatArray:
        """Lumped mass of the Laplacian. *Shape:* ``(n,)``."""
        return self._spectrum[2]

    def wave_kernel_signatures(self, n_energies: int = 40) -> FloatArray:
        """Wave kernel signatures (Aubry et al. 2011) in unit columns. *Shape:* ``(n, n_energies)``."""
        logs = np.log(np.maximum(self.eigenvalues[1:], 1e-9))
        energies = np.linspace(logs[0], logs[-1] / 1.02, n_energies)
        width = max(7 * (logs[-1] - logs[0]) / n_energies, 1e-9)
        weights = np.exp(-((energies[:, None] - logs) ** 2) / (2 * width**2))
        signatures = self.functions[:, 1:] ** 2 @ (weights / weights.sum(1, keepdims=True)).T
        return signatures / np.linalg.norm(signatures, axis=0)

    @cached_property
    def _heat_solver(self) -> Any:
        return extras.require("potpourri3d", "register", "registration").MeshHeatMethodDistanceSolver(
            self.coarse.vertices, self.coarse.faces
        )

    def geodesics_from(self, sources: IntArray) -> FloatArray:
        """Distances along the surface by the heat method. *Shape:* ``(m,) -> (n, m)``."""
        return np.stack([self._heat_solver.compute_distance(int(source)) for source in sources], axis=1)

    def neighbourhoods(self, radius: float) -> BoolArray:
        """Whether two vertices are within a distance along edges. *Shape:* ``(n, n)``."""
        i, j = self.coarse.edges.T
        lengths = np.linalg.norm(self.coarse.vertices[i] - self.coarse.vertices[j], axis=1)
        graph = sparse.csr_matrix((np.maximum(lengths, 1e-12), (i, j)), shape=(len(self),) * 2)
        near: BoolArray = csgraph.dijkstra(graph, directed=False, limit=radius) <= radius
        return near

    def nearest(self, points: FloatArray, normals: FloatArray) -> IntArray:
        """Nearest coarse vertices of points of the fine surface, on the same side of thin parts. *Shape:* ``(m,)``."""
        return self.placed.nearest_alike(points, normals)

    @cached_property
    def placed(self) -> MeshSurface:
        """The coarse copy in the units of the fine surface."""
        return MeshSurface(self.positions, self.coarse.faces)


def decimated(surface: MeshSurface, n_vertices: int) -> MeshSurface:
    """Decimate the main part of a surface.

    A surface with at most a fifth more vertices is not decimated.
    """
    surface = without_dust(surface)
    if len(surface.vertices) <= 1.2 * n_vertices:
        return main_part(surface)
    wanted = int(n_vertices / len(surface.vertices) * len(surface.faces))
    vertices, faces, _ = decimate(surface.vertices, surface.faces, wanted)
    faces = faces[~inspect.degenerate_faces(faces)]
    faces = faces[~inspect.repeated_faces(faces)]
    return main_part(referenced(vertices, faces)[0])


def main_part(surface: MeshSurface) -> MeshSurface:
    """The largest piece, with those separated from it by a cut."""
    return largest_piece(sewn(without_dust(surface), CUT))
