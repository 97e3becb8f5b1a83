"""Overlapping patches of a surface, in which shapes are mixed with weights of their own."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_rotation

N_PATCHES = 40
"""How many: of 6 to 100, left-out poses of nine sets come nearest to the truth with 30 to 100."""

# Radius of a patch over the largest distance of a vertex from the nearest centre.
OVERLAP = 1.5

# The weights of a patch are pulled to even ones by this part of how much its shapes differ.
RIDGE = 0.01

# What weights below zero may add up to.
MOST_BELOW_ZERO = 2.0


class Patches:
    """Patches around vertices that are far from each other along the surface, so that fingers do not mix.

    Args:
        mean: A shape. *Shape:* ``(V, 3)``.
        reconstruction: Of its connectivity; its loose pieces are as far from the others as they are in space.
    """

    def __init__(self, mean: Tensor, reconstruction: Reconstruction) -> None:
        graph = _graph(mean, reconstruction)
        rows, centres = _farthest(graph, np.unique(reconstruction.faces.numpy()))
        reach = OVERLAP * rows.min(0)[np.isfinite(rows.min(0))].max()
        distances = torch.from_numpy(np.where(np.isfinite(rows), rows, np.inf))
        bumps = torch.exp(-2 * (distances / max(reach, np.finfo(float).tiny)) ** 2)
        #: Part of each vertex that belongs to each patch. *Shape:* ``(P, V)``.
        self.shares = bumps / bumps.sum(0).clamp_min(torch.finfo(bumps.dtype).tiny)
        #: Of the vertices in each patch; they add up to one. *Shape:* ``(P, V)``.
        self.masses = bumps * reconstruction.areas
        self.masses = self.masses / self.masses.sum(1, keepdim=True).clamp_min(torch.finfo(bumps.dtype).tiny)
        #: Along the surface, between centres. *Shape:* ``(P, P)``.
        self.distances = distances[:, centres]

    def __len__(self) -> int:
        return len(self.shares)

    def fields(self, length: float) -> Tensor:
        """Fields on the vertices whose sums with normal factors are as smooth as a length says.

        Args:
            length: Over which they vary, relative to the largest distance of two centres.

        Returns:
            *Shape:* ``(n, V)``; the first is one everywhere.
        """
        among = self.distances[self.distances.isfinite()]
        scale = length * among.amax().clamp_min(torch.finfo(among.dtype).tiny)
        values, vectors = torch.linalg.eigh(torch.exp(-0.5 * (self.distances / scale) ** 2))
        kept = values > 1e-3 * values[-1]
        root = vectors[:, kept] * values[kept].sqrt()
        return torch.cat([torch.ones_like(self.shares[:1]), root.mT @ self.shares])


class LocalMixtures:
    """The weights with which shapes, each turned as fits best, make up a patch of another shape.

    Args:
        patches: The patches.
        shapes: *Shape:* ``(K, V, 3)``.
    """

    def __init__(self, patches: Patches, shapes: Tensor) -> None:
        self.patches, k = patches, len(shapes)
        self.columns = shapes.movedim(0, 1).flatten(1)  # (V, 3K)
        self.centres = (patches.masses @ self.columns).unflatten(1, (k, 3))
        products = torch.stack([(self.columns * mass[:, None]).mT @ self.columns for mass in patches.masses])
        products = products.unflatten(2, (k, 3)).unflatten(1, (k, 3)).transpose(2, 3)
        #: Second moments of all pairs of shapes in each patch. *Shape:* ``(P, K, K, 3, 3)``.
        self.moments = products - self.centres[:, :, None, :, None] * self.centres[:, None, :, None, :]

    def weights(self, x: Tensor) -> Tensor:
        r"""Of the shapes at each vertex; they add up to one.

        In each patch they minimise :math:`|x - \sum_k w_k R_k x_k|^2`, with the rotations that fit best.

        Args:
            x: *Shape:* ``(V, 3)``.

        Returns:
            *Shape:* ``(K, V)``.
        """
        masses, n = self.patches.masses, self.moments.shape[1]
        products = torch.stack([(masses * row) @ self.columns for row in x.mT], 1).unflatten(2, (n, 3))
        cross = products.transpose(1, 2) - (masses @ x)[:, None, :, None] * self.centres[:, :, None, :]
        turns = best_rotation(cross)  # (P, K, 3, 3)
        gram = torch.einsum("pkab,pklbc,plac->pkl", turns, self.moments, turns)
        right = (cross * turns).sum((-1, -2)) - gram.mean(-1)
        right, centred = right - right.mean(-1, keepdim=True), gram - gram.mean(-1, keepdim=True)
        centred = centred - centred.mean(-2, keepdim=True)
        spread, whole = (matrix.diagonal(dim1=-2, dim2=-1).mean(-1) for matrix in (centred, gram))
        spread = torch.maximum(spread, torch.finfo(x.dtype).eps * whole)  # shapes may be equal
        system = centred + RIDGE * spread[:, None, None] * torch.eye(n).to(x)
        found = torch.linalg.solve(system, right)
        return bounded((found - found.mean(-1, keepdim=True)).mT @ self.patches.shares + 1 / n)


def bounded(weights: Tensor) -> Tensor:
    """Weights nearer to even ones, where those below zero add up to more than a bound. *Shape:* ``(K, V)``."""
    below = -weights.clamp_max(0).sum(0)
    part = (MOST_BELOW_ZERO / below.clamp_min(MOST_BELOW_ZERO)).clamp_max(1)
    return 1 / len(weights) + part * (weights - 1 / len(weights))


def _graph(mean: Tensor, reconstruction: Reconstruction) -> sparse.csr_matrix:
    """Lengths of edges, and of gaps between loose pieces and the largest."""
    first, second = reconstruction.edges.unbind(1)
    parts: list[tuple[Tensor, Tensor, Tensor]] = [(first, second, (mean[first] - mean[second]).norm(dim=-1))]
    for piece, anchors in reconstruction.loose:
        gaps = torch.cdist(mean[piece], mean[anchors])
        i, j = divmod(int(gaps.argmin()), len(anchors))
        parts.append((piece[i : i + 1], anchors[j : j + 1], gaps[i, j : j + 1]))
    starts, ends, lengths = (torch.cat(column).numpy() for column in zip(*parts, strict=True))
    # Zeros would be no edges.
    lengths = np.maximum(lengths, 1e-9 * lengths.mean())
    upper = sparse.coo_matrix((lengths, (starts, ends)), shape=(len(mean), len(mean)))
    return (upper + upper.T).tocsr()


def _farthest(graph: sparse.csr_matrix, used: IntArray) -> tuple[FloatArray, Sequence[int]]:
    """Distances from vertices, each the farthest from those before. *Shape:* ``(P, V)``."""

    def distances(vertex: int) -> FloatArray:
        return np.asarray(dijkstra(graph, indices=vertex))

    def seen(row: FloatArray) -> FloatArray:
        found = np.zeros_like(row)
        found[used] = np.where(np.isfinite(row[used]), row[used], 0)
        return found

    centres = [int(seen(distances(int(used[0]))).argmax())]
    rows = [distances(centres[0])]
    nearest = seen(rows[0])
    while len(rows) < N_PATCHES and nearest.max() > 0:
        centres.append(int(nearest.argmax()))
        rows.append(distances(centres[-1]))
        nearest = np.minimum(nearest, rows[-1])
    return np.stack(rows), centres
