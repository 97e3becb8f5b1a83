"""Vertex positions from target edge vectors: Poisson problems, factorised once per connectivity."""

from functools import cache, partial

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor, nn

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, half_cotangents, vertex_areas
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian, solve_by, solve_exported
from torch_modal.geometry.triangle_frames import Sides, edge_means
from torch_modal.geometry.vectors import pick

# Bounds of cotangent weights, for slivers. Positive weights make the matrix positive definite.
_WEIGHT_RANGE = (0.02, 20.0)

# Number of vertices of the largest piece that a loose piece follows.
_N_ANCHORS = 16


class Poisson(nn.Module):
    r"""Solves :math:`\min_x \sum_e w_e |x_j - x_i - \bar e|^2` with prescribed centres of the connected pieces.

    All shapes share the weights and one factorisation (:class:`~torch_modal.geometry.sparse.SparseSolver`), which is
    made at the first use and again if the weights change.

    Args:
        mesh: The connectivity, of all vertices.
        weights: Positive edge weights. *Shape:* ``(E,)``.
        vertex_weights: Non-negative weights of the centres; uniform by default. *Shape:* ``(V,)``.
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
        # The equations determine each piece up to a translation: one vertex of each is fixed at first.
        fixed = np.unique(mesh.vertex_pieces, return_index=True)[1]
        self.register_buffer("free", torch.from_numpy(np.setdiff1d(np.arange(len(piece)), fixed)), persistent=False)
        self.n_pieces = len(fixed)
        self._made: tuple[Tensor, SparseSolver] | None = None

    def _solver_of(self, weights: Tensor) -> SparseSolver:
        """Inverse of the Laplacian for the current weights, which ``functional_call`` may replace."""
        known = None if self._made is None else self._made[0]
        alike = known is not None and (known.dtype, known.device) == (weights.dtype, weights.device)
        if self._made is None or not (known is weights or (alike and torch.equal(weights, self._made[0]))):
            laplacian = graph_laplacian(self.edges.cpu().numpy(), weights.double().cpu().numpy(), len(self.piece))
            # A copy: `share_memory()`, as for spawned workers, frees what is under the view of a tensor.
            self._made = weights, SparseSolver(laplacian, self.free.cpu().numpy().copy())
        return self._made[1]

    def forward(self, wanted: Tensor, near: Tensor) -> Tensor:
        """The shape that fits target edge vectors.

        Args:
            wanted: Target edge vectors, components first. *Shape:* ``(3, ..., E)``.
            near: A shape with the centres of the pieces of the result. *Shape:* ``(3, ..., V)``.

        Returns:
            Positions; unreferenced vertices have those of ``near``. *Shape:* ``(3, ..., V)``.
        """
        pulls = wanted * self.weights.to(wanted)
        both = torch.cat([-pulls, pulls], -1)
        right = torch.zeros_like(near).index_add(-1, self.edges.T.flatten().to(near.device), both).movedim(0, -1)
        if torch.compiler.is_exporting():
            x = solve_exported(self.edges, self.weights, self.free, right).movedim(-1, 0)
        else:
            # Bound to the current weights: other weights may be in place during the backward solve.
            x = solve_by(cache(partial(self._solver_of, self.weights)), right).movedim(-1, 0)
        return x + self.centres(near - x)

    def centres(self, x: Tensor) -> Tensor:
        """Centre of the piece of each vertex. *Shape:* ``(3, ..., V) -> (3, ..., V)``, or ``(3, ..., 1)``."""
        piece, shares = self.piece.to(x.device), self.shares.to(x.device)
        # Sequential float32 sums over thousands of vertices lose three digits.
        weighted = x.double() * shares.double()
        if self.n_pieces == 1:
            return weighted.sum(-1, keepdim=True).to(x)
        return pick(torch.zeros_like(weighted).index_add(-1, piece, weighted), piece).to(x)


class Reconstruction(nn.Module):
    r"""The shape that fits target sides of the triangles, :math:`\min_x \sum w_{ij} |x_j - x_i - s_{ij}|^2`.

    The weights are cotangents of a reference, so all shapes share one factorisation.

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
        bounded = np.clip(half_cotangents(shape, mesh), *_WEIGHT_RANGE)
        #: Weights of the sides. *Shape:* ``(3F,)``.
        self.register_buffer("weights", torch.from_numpy(bounded), persistent=False)
        #: Areas of the vertices. *Shape:* ``(V,)``.
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
        """Vertices of each piece except the largest, and vertices of the largest that it follows."""
        return [(getattr(self, f"piece_{i}"), getattr(self, f"anchors_{i}")) for i in range(self.n_loose)]

    def _loose(self, shape: FloatArray, mesh: Connectivity) -> list[tuple[IntArray, IntArray]]:
        labels, areas = mesh.vertex_pieces, self.areas.numpy()
        pieces = [np.flatnonzero(labels == label) for label in np.unique(labels[mesh.used])]
        pieces.sort(key=lambda piece: -float(areas[piece].sum()))
        return [(piece, pieces[0][_nearest(shape[pieces[0]], shape[piece])]) for piece in pieces[1:]]

    def forward(self, wanted: Sides, rest: Tensor) -> Tensor:
        """The shape with the centroid of ``rest``. Unreferenced vertices do not move.

        Args:
            wanted: Target sides of the triangles.
            rest: The initial shape, which determines the positions of loose pieces. *Shape:* ``(3, B, V)``.

        Returns:
            *Shape:* ``(3, B, V)``.
        """
        edges = edge_means(wanted, self.weights.to(rest), self.sides, self.signs.to(rest), len(self.edges))
        out = placed = self.poisson(edges, rest)
        for piece, anchors in self.loose:
            before, after = (x[..., anchors].movedim(0, -1) for x in (rest, placed))
            motion = best_fit(before, after, before.new_ones(len(anchors)))
            centre = (rest[..., piece] * self.poisson.shares.to(rest)[piece]).sum(-1).T[:, None]
            moved = placed[..., piece] + (motion.apply(centre) - centre).movedim(-1, 0)
            out = out.index_copy(-1, piece, moved)
        return out


def _nearest(points: FloatArray, piece: FloatArray) -> IntArray:
    """Indices of a few points nearest to a piece."""
    count = min(_N_ANCHORS, len(points))
    distances, found = KDTree(points).query(piece, k=min(count, 4))
    found, distances = np.asarray(found).reshape(-1), np.asarray(distances).reshape(-1)
    order = found[np.argsort(distances, kind="stable")]
    _, first = np.unique(order, return_index=True)
    return order[np.sort(first)][:count]
