"""Vertex positions from target edge vectors: Poisson problems, factorised once per connectivity."""

from functools import partial

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor, nn

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.autograd import Recent, is_eager
from torch_modal.geometry.connectivity import Connectivity, half_cotangents, label_pieces, vertex_areas
from torch_modal.geometry.rigid import RigidMotion, best_fit
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian, solve_by
from torch_modal.geometry.triangle_frames import Sides, edge_means

# Bounds of cotangent weights, for slivers. Positive weights make the matrix positive definite.
WEIGHT_RANGE = (0.02, 20.0)

# Number of vertices of the largest piece that a loose piece follows.
_N_ANCHORS = 16


class Poisson(nn.Module):
    r"""Solves :math:`\min_x \sum_e w_e |x_j - x_i - \bar e|^2` with prescribed centres of the connected pieces.

    All shapes share the weights and one factorisation (:class:`~torch_modal.geometry.sparse.SparseSolver`), which is
    made at the first use.

    Args:
        mesh: The connectivity, of all vertices.
        weights: Positive edge weights. *Shape:* ``(E,)``.
        vertex_weights: Non-negative weights of the centres; uniform by default. *Shape:* ``(V,)``.
    """

    edges: Tensor
    weights: Tensor
    piece: Tensor
    shares: Tensor

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
        self._made: tuple[Tensor, SparseSolver] | None = None
        self.n_pieces = int(piece.max()) + 1

    def _solver_of(self, weights: Tensor) -> SparseSolver:
        """Inverse of the Laplacian for the current weights, which ``functional_call`` may replace."""
        if self._made is None or self._made[0] is not weights:
            edges, values = self.edges.cpu().numpy(), weights.double().cpu().numpy()
            self._made = weights, _make_solver(edges, values, len(self.piece))
        return self._made[1]

    def forward(self, right: Tensor, near: Tensor) -> Tensor:
        """The shape that fits edge vectors (:meth:`right_hand_side`), with the centres of the pieces of ``near``.

        Unreferenced vertices have the positions of ``near``. *Shape:* ``(..., V, 3), (..., V, 3) -> (..., V, 3)``.
        """
        if torch.compiler.is_exporting():
            x = solve_exported(self.edges, self.weights, right)
        else:
            # Bound to the current weights: other weights may be in place during the backward solve.
            weights = self.weights
            x = solve_by(lambda right: self._solver_of(weights)(right), right)
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


def _make_solver(edges: IntArray, weights: FloatArray, n: int) -> SparseSolver:
    """The inverse of the Laplacian of n vertices."""
    # The equations determine each piece up to a translation: one vertex of each is fixed at first.
    fixed = np.unique(label_pieces(edges, n), return_index=True)[1]
    return SparseSolver(graph_laplacian(edges, weights, n), np.setdiff1d(np.arange(n), fixed))


_EXPORTED = Recent(8)


@torch.library.custom_op("torch_modal::solve_exported", mutates_args=())
def solve_exported(edges: Tensor, weights: Tensor, right: Tensor) -> Tensor:
    """Solve with the Laplacian of edges, as an operation of exported programs, which hold no solver.

    *Shape:* ``(E, 2), (E,), (..., V, m) -> (..., V, m)``.
    """
    arrays = [x.detach().cpu().numpy() for x in (edges, weights.double())]
    make = partial(_make_solver, arrays[0], arrays[1], right.shape[-2])
    solver: SparseSolver = _EXPORTED.get(tuple(x.tobytes() for x in arrays), make)
    return solver(right)


solve_exported.register_fake(lambda edges, weights, right: torch.empty_like(right))
solve_exported.register_autograd(
    lambda ctx, grad: (None, None, solve_exported(*ctx.saved_tensors, grad)),
    setup_context=lambda ctx, inputs, output: ctx.save_for_backward(*inputs[:2]),
)


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
        bounded = np.clip(half_cotangents(shape, mesh), *WEIGHT_RANGE)
        #: Weights of the sides. *Shape:* ``(3F,)``.
        self.register_buffer("weights", torch.from_numpy(bounded), persistent=False)
        #: Areas of the vertices. *Shape:* ``(V,)``.
        self.register_buffer("areas", torch.from_numpy(vertex_areas(shape, mesh.faces)), persistent=False)
        weights = torch.zeros(len(mesh.edges), dtype=torch.float64).index_add(0, self.sides, self.weights)
        self.poisson = Poisson(mesh, weights, self.areas)
        labels, areas = mesh.vertex_pieces, self.areas.numpy()
        pieces = [np.flatnonzero(labels == label) for label in np.unique(labels[mesh.used])]
        largest, *loose = sorted(pieces, key=lambda piece: -float(areas[piece].sum()))
        #: Vertices of each piece except the largest, and the vertices of the largest nearest to it, which it follows.
        self.loose = []
        for piece in loose:
            nearest = np.argsort(KDTree(shape[piece]).query(shape[largest])[0], kind="stable")[:_N_ANCHORS]
            self.loose.append((torch.from_numpy(piece), torch.from_numpy(largest[nearest])))

    @property
    def edges(self) -> Tensor:
        """Vertex indices of each edge. *Shape:* ``(E, 2)``."""
        return self.poisson.edges

    def fit(self, wanted: Sides, near: Tensor) -> Tensor:
        """The linear part of :meth:`forward`: all pieces have the centres that they have in a shape nearby.

        *Shape:* ``(3, B, F), (B, V, 3) -> (B, V, 3)``.
        """
        edges = edge_means(wanted, self.weights.to(near), self.sides, self.signs.to(near), len(self.edges))
        return self.poisson(self.poisson.right_hand_side(edges), near)

    def follow(self, before: Tensor, after: Tensor) -> list[RigidMotion]:
        """Motion of the vertices that each loose piece follows, between shapes. *Shape:* ``(B, V, 3), (B, V, 3)``."""
        return [best_fit(before[:, anchors], after[:, anchors]) for _, anchors in self.loose]

    def forward(self, wanted: Sides, rest: Tensor) -> Tensor:
        """The shape of target sides with the centroid of ``rest``. Unreferenced vertices do not move.

        The initial shape, ``rest``, determines the positions of loose pieces. *Shape:* ``(B, V, 3) -> (B, V, 3)``.
        """
        return self.place_loose(self.fit(wanted, rest), rest)

    def place_loose(self, placed: Tensor, rest: Tensor) -> Tensor:
        """A shape of :meth:`fit` in which loose pieces follow the largest one. *Shape:* ``(B, V, 3), (B, V, 3)``."""
        out = placed
        for (piece, _), motion in zip(self.loose, self.follow(rest, placed), strict=True):
            centre = self.poisson.shares.to(rest)[None, piece] @ rest[:, piece]
            out = out.index_copy(1, piece.to(out.device), placed[:, piece] + motion.apply(centre) - centre)
        return out
