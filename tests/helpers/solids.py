"""Tetrahedral boxes made without the mesher: the same in every run, with known truth."""

import itertools

import numpy as np
import scipy.sparse as sp

from torch_modal.modes.eigen import ElasticBody, ElasticModes, lowest_modes
from torch_modal.modes.embedding import find_neighbours, fit_weights
from torch_modal.modes.stiffness import hat_gradients, mass_matrix
from torch_modal.modes.tetrahedra import Tetrahedra, solid_volumes


def box(cells: tuple[int, int, int], size: tuple[float, float, float], jitter: float = 0.0) -> Tetrahedra:
    """A box of cubes cut into six tetrahedra each, vertices moved by the fraction ``jitter`` of a cell."""
    counts = np.array(cells) + 1
    grid = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.stack(np.meshgrid(*(np.arange(c) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.array([counts[1] * counts[2], counts[2], 1])
    tets = []
    for order in itertools.permutations(range(3)):  # the six monotone paths from one corner to the opposite one
        steps = np.zeros((4, 3), dtype=np.int64)
        for i, axis in enumerate(order):
            steps[i + 1 :, axis] += 1
        path = (corner[:, None] + steps) @ number
        odd = np.linalg.det(np.diff(steps, axis=0)) < 0
        tets.append(path[:, [1, 0, 2, 3]] if odd else path)
    moved = grid + jitter * np.random.default_rng(0).uniform(-1, 1, grid.shape)
    return Tetrahedra(moved * (np.array(size) / np.array(cells)), np.concatenate(tets))


def together(*solids: Tetrahedra) -> Tetrahedra:
    """Several meshes as one, not connected."""
    starts = np.cumsum([0] + [len(solid.vertices) for solid in solids])
    return Tetrahedra(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.tets + start for solid, start in zip(solids, starts, strict=False)]),
    )


def embed_surface(points: np.ndarray, solid: Tetrahedra, normals: np.ndarray | float = 0.0) -> sp.csr_matrix:
    """Weights of the surface in the pose in which its neighbours are found. *Shape:* ``(V, N)``."""
    return fit_weights(points, solid.vertices, *find_neighbours(points, solid, normals + np.zeros(points.shape)))


def element_hessian(solid: Tetrahedra) -> sp.csc_matrix:
    """Hessian of ``sum_t vol_t |sym grad u|²``, linear elements without smoothing. *Shape:* ``(3N, 3N)``."""
    g = hat_gradients(solid)
    blocks = np.einsum("tbi,taj->tabij", g, g) + np.einsum("tak,tbk->tab", g, g)[..., None, None] * np.eye(3)
    blocks *= solid_volumes(solid)[:, None, None, None, None]
    unknowns = 3 * solid.tets[:, :, None] + np.arange(3)
    rows = np.broadcast_to(unknowns[:, :, None, :, None], blocks.shape)
    columns = np.broadcast_to(unknowns[:, None, :, None, :], blocks.shape)
    n = 3 * len(solid.vertices)
    k = sp.coo_matrix((blocks.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(n, n)).tocsc()
    return sp.csc_matrix((k + k.T) / 2)


def as_mesh(solid: Tetrahedra) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of its surface alone."""
    used, faces = np.unique(surface(solid), return_inverse=True)
    return solid.vertices[used], faces.reshape(-1, 3)


def eigenmodes(k: sp.csc_matrix, mass: sp.spmatrix, positions: np.ndarray, n_modes: int) -> ElasticModes:
    """Lowest modes of these matrices."""
    return lowest_modes(ElasticBody(positions, k, mass, lambda motions: motions), n_modes)


def lumped_mass(solid: Tetrahedra) -> np.ndarray:
    """Row sums of the mass matrix. *Shape:* ``(N,)``."""
    return np.asarray(mass_matrix(solid).sum(axis=1)).reshape(-1)


def surface(solid: Tetrahedra) -> np.ndarray:
    """Faces of one tetrahedron only, wound counterclockwise seen from outside. *Shape:* ``(F, 3)``."""
    faces = np.concatenate([solid.tets[:, c] for c in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])])
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[counts == 1]]
