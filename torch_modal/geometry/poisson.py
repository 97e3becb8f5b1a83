"""Vertices from the sides that triangles ask for: a Poisson problem, factorised once for a connectivity."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from torch_modal.geometry import connectivity
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian
from torch_modal.geometry.triangle_frames import Sides

# Cotangents of slivers: a side counts neither for nothing nor for everything. Positive weights also make the matrix
# definite whatever the triangles.
_WEIGHT_RANGE = (0.02, 20.0)

# A piece that hangs loose follows this many of the nearest vertices of the largest piece.
_N_ANCHORS = 16


class Reconstruction:
    r"""The shape whose sides come closest to those wanted, :math:`\min_x \sum w_{ij} |x_j - x_i - s_{ij}|^2`.

    The weights are cotangents of a reference, so that one factorisation serves all shapes of the connectivity. It is
    SciPy's sparse LU in float64 on the CPU: tensors on a GPU go there and back, which is said in the documents. The
    operator is symmetric, and backward solves with it once more.

    Args:
        reference: A shape that gives the weights. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """

    def __init__(self, reference: Tensor, faces: Tensor) -> None:
        shape, triangles = reference.detach().cpu().double().numpy(), faces.cpu().numpy()
        self.faces = faces.cpu()
        self.n_vertices = len(shape)
        weights = _side_weights(shape, triangles)
        self.weights = torch.from_numpy(weights)
        self.areas = torch.from_numpy(connectivity.vertex_areas(shape, triangles))
        across = np.concatenate([triangles[:, [(corner + 1) % 3, (corner + 2) % 3]] for corner in range(3)])
        laplacian = graph_laplacian(across, weights.T.reshape(-1), len(shape))
        used = np.unique(triangles)
        self.unused = torch.from_numpy(np.setdiff1d(np.arange(len(shape)), used))
        labels = connected_components(laplacian, directed=False)[1]
        pieces = [np.flatnonzero(labels == label) for label in np.unique(labels[used])]
        pieces.sort(key=lambda piece: -float(self.areas.numpy()[piece].sum()))
        self.pieces = [torch.from_numpy(piece) for piece in pieces]
        self.anchors = [torch.from_numpy(_nearest(shape[pieces[0]], shape[piece], pieces[0])) for piece in pieces[1:]]
        # The equations fix each piece up to a translation: one vertex of each is held, and the piece placed afterwards.
        free = np.setdiff1d(used, [piece[0] for piece in pieces])
        self.solver = SparseSolver(laplacian, free)

    def __call__(self, wanted: Sides, rest: Tensor) -> Tensor:
        """The shape, its centroid where that of ``rest`` is. Vertices that no face uses stay.

        Args:
            wanted: Sides of the triangles.
            rest: The shape before, which loose pieces are placed by. *Shape:* ``(V, 3, B)``.

        Returns:
            *Shape:* ``(V, 3, B)``.
        """
        faces, (opposite_0, opposite_1, opposite_2) = self.faces.to(rest.device), self.weights.to(rest).unbind(1)
        first, second = wanted
        third = opposite_0[:, None, None] * (second - first)
        at_1, at_2 = opposite_2[:, None, None] * first - third, opposite_1[:, None, None] * second + third
        right = torch.zeros_like(rest).index_add(0, faces.T.flatten(), torch.cat([-at_1 - at_2, at_1, at_2]))
        solved = self.solver(right.flatten(1)).unflatten(1, (3, -1))
        return self._placed(solved, rest)

    def _placed(self, x: Tensor, rest: Tensor) -> Tensor:
        out = rest
        for number, piece in enumerate(self.pieces):
            piece = piece.to(rest.device)
            weights = self.areas.to(rest)[piece]
            weights = weights + torch.finfo(weights.dtype).tiny
            weights = (weights / weights.sum())[:, None, None]
            place = (weights * rest[piece]).sum(0, keepdim=True)
            if number:
                anchors = self.anchors[number - 1].to(rest.device)
                before, after = (y[anchors].permute(2, 0, 1) for y in (rest, out))
                motion = best_fit(before, after, torch.ones_like(before[0, :, 0]))
                place = motion.apply(place.permute(2, 0, 1)).permute(1, 2, 0)
            moved = x[piece] - (weights * x[piece]).sum(0, keepdim=True) + place
            out = out.index_copy(0, piece, moved)
        return out


def _side_weights(shape: NDArray[np.float64], faces: connectivity.IntArray) -> NDArray[np.float64]:
    """Half the cotangent at each corner: the weight of the side across it. *Shape:* ``(F, 3)``."""
    corners = shape[faces]
    u, v = np.roll(corners, -1, axis=1) - corners, np.roll(corners, -2, axis=1) - corners
    twice_area = np.linalg.norm(np.cross(u, v), axis=-1)
    tiny = np.finfo(np.float64).tiny
    return np.clip(0.5 * (u * v).sum(-1) / np.maximum(twice_area, tiny), *_WEIGHT_RANGE)


def _nearest(
    points: NDArray[np.float64], piece: NDArray[np.float64], indices: connectivity.IntArray
) -> connectivity.IntArray:
    """The vertices of the largest piece that are nearest to another piece."""
    count = min(_N_ANCHORS, len(points))
    distances, found = KDTree(points).query(piece, k=min(count, 4))
    found, distances = np.asarray(found).reshape(-1), np.asarray(distances).reshape(-1)
    order = found[np.argsort(distances, kind="stable")]
    _, first = np.unique(order, return_index=True)
    return indices[order[np.sort(first)][:count]]
