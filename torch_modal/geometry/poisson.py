"""Vertex positions from target edge vectors: Poisson problems, factorised once per connectivity."""

from functools import cache, partial

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor, nn

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.autograd import is_eager
from torch_modal.geometry.connectivity import Connectivity, half_cotangents, vertex_areas
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.sparse import MAKING, SparseSolver, graph_laplacian, solve_by, solve_exported
from torch_modal.geometry.triangle_frames import Sides, edge_means

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
        with MAKING:
            if self._made is not None:
                known, solver = self._made
                alike = (known.dtype, known.device) == (weights.dtype, weights.device)
                if known is weights or (alike and torch.equal(known, weights)):
                    return solver
            laplacian = graph_laplacian(self.edges.cpu().numpy(), weights.double().cpu().numpy(), len(self.piece))
            # A copy: `share_memory()`, as for spawned workers, frees what is under the view of a tensor.
            solver = SparseSolver(laplacian, self.free.cpu().numpy().copy())
            self._made = weights, solver
            return solver

    def forward(self, right: Tensor, near: Tensor) -> Tensor:
        """The shape that fits edge vectors (:meth:`right_hand_side`), with the centres of the pieces of ``near``.

        Unreferenced vertices have the positions of ``near``. *Shape:* ``(..., V, 3), (..., V, 3) -> (..., V, 3)``.
        """
        if torch.compiler.is_exporting():
            x = solve_exported(self.edges, self.weights, self.free, right)
        else:
            # Bound to the current weights: other weights may be in place during the backward solve.
            x = solve_by(cache(partial(self._solver_of, self.weights)), right)
        return x + self.centres(near - x)

    def forward_or_near(self, right: Tensor, near: Tensor) -> Tensor:
        """:meth:`forward`, and the shape nearby where that is not finite. *Shape:* ``(B, V, 3), (B, V, 3)``."""
        solved = self(right, near)
        finite = solved.detach().sum((1, 2)).isfinite()
        return solved if is_eager(finite) and finite.all() else torch.where(finite[:, None, None], solved, near)

    def right_hand_side(self, wanted: Tensor) -> Tensor:
        """Right-hand side of the system of target edge vectors. *Shape:* ``(3, ..., E) -> (..., V, 3)``."""
        weighted = wanted * self.weights.to(wanted)
        both, ends = torch.cat([-weighted, weighted], -1), self.edges.T.flatten().to(wanted.device)
        zero = wanted.new_zeros(*wanted.shape[:-1], len(self.piece))
        return zero.index_add(-1, ends, both).movedim(0, -1)

    def centres(self, x: Tensor) -> Tensor:
        """Centre of the piece of each vertex. *Shape:* ``(..., V, 3) -> (..., V, 3)``, or ``(..., 1, 3)``."""
        piece, shares = self.piece.to(x.device), self.shares.to(x.device)
        # Sequential float32 sums over thousands of vertices lose three digits.
        if self.n_pieces == 1:
            return (shares.double() @ x.double())[..., None, :].to(x)
        weighted = x.double() * shares.double()[:, None]
        return torch.zeros_like(weighted).index_add(-2, piece, weighted).index_select(-2, piece).to(x)


class Reconstruction(nn.Module):
    r"""The shape that fits target sides of the triangles, :math:`\min_x \sum w_{ij} |x_j - x_i - s_{ij}|^2`.

    The weights are cotangents of a reference, so all shapes share one factorisation. *Shape:* ``(V, 3), (F, 3)``.
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
        labels, areas = mesh.vertex_pieces, self.areas.numpy()
        pieces = [np.flatnonzero(labels == label) for label in np.unique(labels[mesh.used])]
        largest, *loose = sorted(pieces, key=lambda piece: -float(areas[piece].sum()))
        self.n_loose = len(loose)
        for i, piece in enumerate(loose):
            anchors = largest[_nearest(shape[largest], shape[piece])]
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

    def fit(self, wanted: Sides, near: Tensor) -> Tensor:
        """The linear part of :meth:`forward`: all pieces have the centres that they have in a shape nearby.

        *Shape:* ``(3, B, F), (B, V, 3) -> (B, V, 3)``.
        """
        edges = edge_means(wanted, self.weights.to(near), self.sides, self.signs.to(near), len(self.edges))
        return self.poisson(self.poisson.right_hand_side(edges), near)

    def forward(self, wanted: Sides, rest: Tensor) -> Tensor:
        """The shape of target sides with the centroid of ``rest``. Unreferenced vertices do not move.

        The initial shape, ``rest``, determines the positions of loose pieces. *Shape:* ``(3, B, V) -> (3, B, V)``.
        """
        out = placed = self.fit(wanted, rest.movedim(0, -1)).movedim(-1, 0)
        for piece, anchors in self.loose:
            before, after = (x[..., anchors].movedim(0, -1) for x in (rest, placed))
            motion = best_fit(before, after)
            centre = (rest[..., piece] * self.poisson.shares.to(rest)[piece]).sum(-1).T[:, None]
            moved = placed[..., piece] + (motion.apply(centre) - centre).movedim(-1, 0)
            out = out.index_copy(-1, piece, moved)
        return out


def _nearest(points: FloatArray, piece: FloatArray) -> IntArray:
    """Indices of a few points nearest to a piece."""
    count = min(_N_ANCHORS, len(points))
    distances, indices = KDTree(points).query(piece, k=min(count, 4))
    order = np.ravel(indices)[np.argsort(np.ravel(distances), kind="stable")]
    _, first = np.unique(order, return_index=True)
    return order[np.sort(first)][:count]
