"""Vertices from the edges or the sides that are asked for: a Poisson problem, factorised once for a connectivity."""

from functools import cache, partial

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor, nn

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, half_cotangents, vertex_areas
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian, solve_by
from torch_modal.geometry.triangle_frames import Sides, edge_means
from torch_modal.geometry.vectors import pick

# Cotangents of slivers: a side counts neither for nothing nor for everything. Positive weights also make the matrix
# definite whatever the triangles.
_WEIGHT_RANGE = (0.02, 20.0)

# A piece that hangs loose follows this many of the nearest vertices of the largest piece.
_N_ANCHORS = 16


class Poisson(nn.Module):
    r"""Vertices of :math:`\min_x \sum_e w_e |x_j - x_i - \bar e|^2`, each piece of the surface where it is told.

    The weights serve all shapes, so that one factorisation does
    (:class:`~torch_modal.geometry.sparse.SparseSolver`). It is made at the first use, and again whenever
    the weights are others than those that it was made of.

    Args:
        mesh: The connectivity, of all vertices.
        weights: One for each edge, above 0. *Shape:* ``(E,)``.
        vertex_weights: Whose mean is a piece's centre, none below 0; by default all the same. *Shape:* ``(V,)``.
    """

    edges: Tensor
    weights: Tensor
    piece: Tensor
    shares: Tensor
    free: Tensor

    def __init__(self, mesh: Connectivity, weights: Tensor, vertex_weights: Tensor | None = None) -> None:
        super().__init__()
        piece = torch.tensor(mesh.vertex_pieces)
        mass = torch.ones(len(piece)) if vertex_weights is None else vertex_weights.cpu()
        mass = mass.double() + torch.finfo(torch.float64).tiny  # for pieces without area
        total = torch.zeros_like(mass).index_add(0, piece, mass)
        self.register_buffer("edges", torch.tensor(mesh.edges), persistent=False)
        self.register_buffer("weights", weights.clone(), persistent=False)
        self.register_buffer("piece", piece, persistent=False)
        self.register_buffer("shares", (mass / total[piece]).to(weights), persistent=False)
        # The equations fix each piece up to a translation: one vertex of each is held, and the piece placed afterwards.
        held = np.unique(mesh.vertex_pieces, return_index=True)[1]
        self.register_buffer("free", torch.from_numpy(np.setdiff1d(np.arange(len(piece)), held)), persistent=False)
        self.n_pieces = len(held)
        self._made: tuple[Tensor, SparseSolver] | None = None

    @property
    def solver(self) -> SparseSolver:
        """The Laplacian's inverse, of what the weights are now: others may stand in for them, as in functional_call."""
        return self._solver_of(self.weights)

    def _solver_of(self, weights: Tensor) -> SparseSolver:
        if self._made is None or not _equal(weights, self._made[0]):
            laplacian = graph_laplacian(self.edges.cpu().numpy(), weights.double().cpu().numpy(), len(self.piece))
            self._made = weights, SparseSolver(laplacian, self.free.cpu().numpy())
        return self._made[1]

    def forward(self, wanted: Tensor, near: Tensor) -> Tensor:
        """The shape whose edges come closest to those wanted.

        Args:
            wanted: Edge vectors, components first. *Shape:* ``(3, ..., E)``.
            near: A shape whose pieces have their centres where those of the result are wanted. *Shape:*
                ``(3, ..., V)``.

        Returns:
            Vertices that no face uses are pieces of their own, and stay where ``near`` has them. *Shape:*
            ``(3, ..., V)``.
        """
        pulls = wanted * self.weights.to(wanted)
        both = torch.cat([-pulls, pulls], -1)
        return self.placed(torch.zeros_like(near).index_add(-1, self.edges.T.flatten().to(near.device), both), near)

    def placed(self, right: Tensor, near: Tensor) -> Tensor:
        """The same where the pulls on each vertex are known. *Shape:* ``(3, ..., V)`` each."""
        # Once, of these weights: the backward solve may come when others are back in their place.
        solver = cache(partial(self._solver_of, self.weights))
        x = solve_by(solver, right.movedim(0, -1)).movedim(-1, 0)
        return x + self.centres(near - x)

    def centres(self, x: Tensor) -> Tensor:
        """The centre of the piece of each vertex. *Shape:* ``(3, ..., V) -> (3, ..., V)``, or all the same."""
        piece, shares = self.piece.to(x.device), self.shares.to(x.device)
        # Thousands of float32 added one after the other would lose three digits.
        weighted = x.double() * shares.double()
        if self.n_pieces == 1:
            return weighted.sum(-1, keepdim=True).to(x)
        return pick(torch.zeros_like(weighted).index_add(-1, piece, weighted), piece).to(x)


class Reconstruction(nn.Module):
    r"""The shape whose sides come closest to those wanted, :math:`\min_x \sum w_{ij} |x_j - x_i - s_{ij}|^2`.

    The weights are cotangents of a reference, so that one factorisation serves all shapes of the connectivity.

    Args:
        reference: A shape that gives the weights. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """

    faces: Tensor
    sides: Tensor
    signs: Tensor
    weights: Tensor
    areas: Tensor

    def __init__(self, reference: Tensor, faces: Tensor) -> None:
        super().__init__()
        shape = reference.detach().cpu().double().numpy()
        mesh = Connectivity(faces.cpu().numpy(), len(shape))
        self.register_buffer("faces", faces.cpu().clone(), persistent=False)
        self.register_buffer("sides", torch.tensor(mesh.sides), persistent=False)
        self.register_buffer("signs", torch.tensor(mesh.signs), persistent=False)
        #: Of the sides. *Shape:* ``(3F,)``.
        self.register_buffer("weights", torch.from_numpy(_side_weights(shape, mesh)), persistent=False)
        #: Of the vertices. *Shape:* ``(V,)``.
        self.register_buffer("areas", torch.from_numpy(vertex_areas(shape, mesh.faces)), persistent=False)
        weights = torch.zeros(len(mesh.edges), dtype=torch.float64).index_add(0, self.sides, self.weights)
        self.poisson = Poisson(mesh, weights, self.areas)
        loose = self._loose(shape, mesh)
        self.n_loose = len(loose)
        for i, (piece, anchors) in enumerate(loose):
            self.register_buffer(f"piece_{i}", torch.from_numpy(piece), persistent=False)
            self.register_buffer(f"anchors_{i}", torch.from_numpy(anchors), persistent=False)

    @property
    def edges(self) -> Tensor:
        """Vertex indices of each edge. *Shape:* ``(E, 2)``."""
        return self.poisson.edges

    @property
    def loose(self) -> list[tuple[Tensor, Tensor]]:
        """The vertices of all pieces but the largest, and those of the largest that they follow."""
        return [(getattr(self, f"piece_{i}"), getattr(self, f"anchors_{i}")) for i in range(self.n_loose)]

    def _loose(self, shape: FloatArray, mesh: Connectivity) -> list[tuple[IntArray, IntArray]]:
        labels, areas = mesh.vertex_pieces, self.areas.numpy()
        pieces = [np.flatnonzero(labels == label) for label in np.unique(labels[mesh.used])]
        pieces.sort(key=lambda piece: -float(areas[piece].sum()))
        return [(piece, pieces[0][_nearest(shape[pieces[0]], shape[piece])]) for piece in pieces[1:]]

    def forward(self, wanted: Sides, rest: Tensor) -> Tensor:
        """The shape, its centroid where that of ``rest`` is. Vertices that no face uses stay.

        Args:
            wanted: Sides of the triangles.
            rest: The shape before, which loose pieces are placed by. *Shape:* ``(3, B, V)``.

        Returns:
            *Shape:* ``(3, B, V)``.
        """
        edges = edge_means(wanted, self.weights.to(rest), self.sides, self.signs.to(rest), len(self.edges))
        out = placed = self.poisson(edges, rest)
        for piece, anchors in self.loose:
            before, after = (x[..., anchors].movedim(0, -1) for x in (rest, placed))
            motion = best_fit(before, after, torch.ones_like(before[0, :, 0]))
            centre = (rest[..., piece] * self.poisson.shares.to(rest)[piece]).sum(-1).T[:, None]
            moved = placed[..., piece] + (motion.apply(centre) - centre).movedim(-1, 0)
            out = out.index_copy(-1, piece, moved)
        return out


def _equal(a: Tensor, b: Tensor) -> bool:
    return a is b or (a.dtype == b.dtype and a.device == b.device and torch.equal(a, b))


def _side_weights(shape: FloatArray, mesh: Connectivity) -> FloatArray:
    """Half the cotangent of the angle across each side, within bounds. *Shape:* ``(3F,)``."""
    return np.clip(half_cotangents(shape, mesh), *_WEIGHT_RANGE)


def _nearest(points: FloatArray, piece: FloatArray) -> IntArray:
    """Which points are nearest to a piece, a few of them."""
    count = min(_N_ANCHORS, len(points))
    distances, found = KDTree(points).query(piece, k=min(count, 4))
    found, distances = np.asarray(found).reshape(-1), np.asarray(distances).reshape(-1)
    order = found[np.argsort(distances, kind="stable")]
    _, first = np.unique(order, return_index=True)
    return order[np.sort(first)][:count]
