"""A pair of key-frames on few vertices, and back: what methods without modes are made fast by.

Edges are collapsed by the rule of the package, one for both ends. Coarse vertices are vertices of the fine mesh, so
that slender parts keep their thickness. Back on the fine mesh go the deformation gradients of the coarse triangles,
as rotations and stretches, from both ends, and vertices follow by a Poisson system (deformation transfer, Sumner and
Popovic 2004).
"""

import numpy as np
import torch
from full_space import full_space
from helpers.shapes import rigid_blend
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.modes.coarsening import coarsen

FLAT = 1e-6
"""Of the mean area."""


class ReducedPair:
    """Two key-frames, fine and coarse.

    Args:
        x_a: Key-frame at 0. *Shape:* ``(V, 3)``.
        x_b: Key-frame at 1. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: How many faces the coarse mesh has.
    """

    def __init__(self, x_a: Tensor, x_b: Tensor, faces: Tensor, n_faces: int) -> None:
        self.fine = torch.stack([x_a, x_b]).double()
        self.fine_faces = faces
        coarsening = coarsen(self.fine.numpy(), faces.numpy(), n_faces)
        self.faces = torch.from_numpy(coarsening.faces)
        means = coarsening.restrict(self.fine[0].numpy())
        clusters = coarsening.clusters.copy()
        lost = np.flatnonzero(clusters < 0)
        clusters[lost] = cKDTree(means).query(self.fine[0].numpy()[lost])[1]
        away = np.linalg.norm(self.fine[0].numpy() - means[clusters], axis=1)
        order = np.lexsort((away, clusters))
        first = np.unique(clusters[order], return_index=True)[1]
        #: Fine vertex that each coarse one is. *Shape:* ``(V_coarse,)``.
        self.chosen = torch.from_numpy(order[first])
        self.clusters = torch.from_numpy(clusters)
        self.reconstruction = Reconstruction(self.fine.mean(0), faces)
        edges = Connectivity(faces.numpy(), len(x_a)).edges
        links = sparse.coo_matrix((np.ones(len(edges)), edges.T), (len(x_a), len(x_a)))
        links = links + links.T + sparse.eye(len(x_a))
        self._neighbour_mean = sparse.diags(1 / np.asarray(links.sum(1)).ravel()) @ links
        self._rounds = round((len(x_a) / len(self.chosen)) ** 0.5)

    @property
    def coarse(self) -> Tensor:
        """Both ends. *Shape:* ``(2, V_coarse, 3)``."""
        return self.fine[:, self.chosen]

    def expand(self, shape: Tensor, t: float) -> Tensor:
        """The fine shape of a coarse one at a time. *Shape:* ``(V_coarse, 3) -> (V, 3)``."""
        wanted = [self._turned(coarse, shape, end) for end, coarse in zip(self.fine, self.coarse, strict=True)]
        first, second = (torch.lerp(a, b, t).T[:, None].contiguous() for a, b in zip(*wanted, strict=True))
        found = self.reconstruction((first, second), torch.lerp(*self.fine, t)[None])[0]
        return found + (shape - found[self.chosen]).mean(0)

    def _turned(self, coarse: Tensor, shape: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Sides of the fine triangles of one end, deformed as the coarse ones are. *Shape:* ``(F, 3)`` each."""
        before, after = (_frames(x, self.faces) for x in (coarse, shape))
        areas = torch.linalg.det(before)[:, None, None]
        # A triangle without area says nothing of what happens around it.
        some = areas > FLAT * areas.mean()
        eye = torch.eye(3, dtype=before.dtype)
        areas = torch.where(some, areas, 0)
        rotation, stretch = _polar(after @ torch.linalg.inv(torch.where(some, before, eye)))
        at_vertices = []
        for matrices in (rotation, stretch):
            summed = torch.zeros(len(coarse), 3, 3, dtype=coarse.dtype)
            weight = torch.zeros(len(coarse), 1, 1, dtype=coarse.dtype)
            for corner in self.faces.T:
                summed.index_add_(0, corner, areas * matrices)
                weight.index_add_(0, corner, areas)
            fine = torch.where(weight > 0, summed / weight, eye)[self.clusters].flatten(1).numpy()
            for _ in range(self._rounds):
                fine = self._neighbour_mean @ fine
            at_vertices.append(torch.from_numpy(fine).unflatten(1, (3, 3)))
        turns, stretches = (x[self.fine_faces].mean(1) for x in at_vertices)
        gradient = _polar(turns)[0] @ stretches
        origin, first, second = (end[corner] for corner in self.fine_faces.T)
        first, second = ((gradient @ (side - origin)[..., None])[..., 0] for side in (first, second))
        return first, second


def froehlich_botsch(reduced: ReducedPair, t: float) -> Tensor:
    """Example-driven interpolation (Froehlich and Botsch 2011), on the coarse mesh and back.

    Lengths, dihedral angles and volume are interpolated between those of the key-frames, and the shape that comes
    closest to them is sought from linear interpolation. They do not say where it is: it is laid onto the latter.

    Returns:
        *Shape:* ``(V, 3)``.
    """
    x_a, x_b = reduced.coarse
    weights = torch.ones(len(x_a), dtype=x_a.dtype)
    straight = rigid_blend(x_a, x_b, torch.tensor([t], dtype=x_a.dtype), weights)[0]
    found = full_space(x_a, x_b, reduced.faces, t, start=straight, example_based=True).shape
    return reduced.expand(best_fit(found, straight, weights).apply(found), t)


def _frames(x: Tensor, faces: Tensor) -> Tensor:
    """Two sides and the unit normal of each triangle, as columns. *Shape:* ``(F, 3, 3)``."""
    origin, first, second = (x[corner] for corner in faces.T)
    normal = torch.linalg.cross(first - origin, second - origin)
    length = normal.norm(dim=1, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny)
    return torch.stack([first - origin, second - origin, normal / length], -1)


def _polar(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation and symmetric stretch. *Shape:* ``(..., 3, 3)``."""
    u, s, vh = torch.linalg.svd(matrices)
    flip = torch.ones_like(s)
    flip[..., 2] = torch.linalg.det(u @ vh)
    return u * flip[..., None, :] @ vh, vh.mT * (flip * s)[..., None, :] @ vh
