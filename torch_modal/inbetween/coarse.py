"""The coarse mesh that the energy of the modal solve is evaluated on, with as many faces as the modes need."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_modal.arrays import IntArray
from torch_modal.elastic.formulas import MIN_RELATIVE_LENGTH
from torch_modal.elastic.term import Mesh
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import is_flat
from torch_modal.geometry.vectors import inverse
from torch_modal.modes.coarsening import Coarsening, coarsen

ENOUGH_FACES = 1000
"""Number of faces from which on coarse meshes are not checked."""
MORE = 1.5
"""Factor of the number of faces for the next trial."""

MOST_SPREAD = 40.0
"""Largest over smallest ratio of coarse to fine stiffness that is accepted. Of bodies without thin limbs 300 faces have
5 to 37; where results were wrong, they had 60 to 5,000."""
MOST_EDGES = 100_000
"""Number of edges above which the stiffness is estimated from a sample of them."""
NO_STIFFNESS = 1e-6
"""Relative stiffness below which directions are not compared: those in which loose pieces move rigidly."""


class CoarseMesh(nn.Module):
    """The coarse mesh, and the restriction to it.

    Args:
        shapes: In the frame, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        whole: The mesh.
        n_faces: Of the coarse mesh, or more, where that does not resolve the modes or pieces.
        weights: Of the vertices. *Shape:* ``(V,)``.
        modes: Of the shapes, which the coarse mesh should resolve. *Shape of each:* ``(k, V, 3)``.
    """

    weights: Tensor
    clusters: Tensor
    shares: Tensor

    def __init__(self, shapes: Tensor, whole: Mesh, n_faces: int, weights: Tensor, modes: Sequence[Tensor]) -> None:
        super().__init__()
        coarsening = coarsen_until_resolved(shapes, whole, n_faces, modes)
        clusters = torch.from_numpy(coarsening.clusters).clamp_min(0)
        member = torch.from_numpy(coarsening.clusters >= 0).double()
        per_cluster = torch.zeros(coarsening.n_vertices, dtype=torch.float64)

        self.n_vertices = coarsening.n_vertices
        self.mesh = Mesh(Connectivity(coarsening.faces, self.n_vertices))
        self.register_buffer("weights", per_cluster.index_add(0, clusters, weights), persistent=False)
        self.register_buffer("clusters", clusters, persistent=False)
        #: Part of each fine vertex in its cluster. *Shape:* ``(V,)``.
        shares = member / per_cluster.index_add(0, clusters, member)[clusters]
        self.register_buffer("shares", shares, persistent=False)

    def restrict(self, x: Tensor) -> Tensor:
        """Cluster averages, linear in ``x``. *Shape:* ``(..., V, 3) -> (..., V_coarse, 3)``."""
        rows = x.mT * self.shares  # five times as fast along rows
        sums = rows.new_zeros(*rows.shape[:-1], self.n_vertices)
        return sums.index_add(-1, self.clusters, rows).mT.contiguous()


def coarsen_until_resolved(shapes: Tensor, whole: Mesh, n_faces: int, modes: Sequence[Tensor]) -> Coarsening:
    """A coarse mesh of so many faces, or of more, where those do not resolve the modes.

    A flat shape does not show where the other one bends: the collapses then follow the other, and there are
    ``ENOUGH_FACES`` or more.

    Arguments as for :class:`CoarseMesh`.
    """
    faces, used = whole.connectivity.faces, whole.connectivity.used
    enough = min(ENOUGH_FACES, len(faces))
    points = shapes.numpy()
    flat = [is_flat(x[used]) for x in points]
    curved = [i for i, one in enumerate(flat) if not one] or [0]
    n_faces = max(n_faces, enough) if any(flat) else n_faces
    known: dict[int, IntArray] = {}
    coarsening = coarsen(points, faces, n_faces, curved, known)
    if n_faces >= enough:
        return coarsening
    ends = [(x, y) for x, y in zip(shapes, modes, strict=False) if len(y)]
    fine = [stretching_hessian(whole, *end) for end in ends]
    while n_faces < enough:
        mesh = Mesh(Connectivity(coarsening.faces, coarsening.n_vertices))
        coarse = [[torch.from_numpy(coarsening.restrict(field.numpy())) for field in end] for end in ends]
        pairs = zip(fine, coarse, strict=True)
        if all(spread(hessian, stretching_hessian(mesh, x, moves)) <= MOST_SPREAD for hessian, (x, moves) in pairs):
            break
        n_faces = min(round(MORE * n_faces), ENOUGH_FACES)
        coarsening = coarsen(points, faces, n_faces, curved, known)
    return coarsening


def stretching_hessian(mesh: Mesh, x: Tensor, modes: Tensor) -> Tensor:
    """Hessian of the stretching energy in the amplitudes of modes, with the shape at rest, from some of many edges.

    Bending is left out: it is a small part of the stiffness of closed thin limbs, and three times the work.

    *Shape:* ``(V, 3), (k, V, 3) -> (k, k)``.
    """
    i, j = mesh.edges[:: 1 + len(mesh.edges) // MOST_EDGES].T.contiguous()
    edges = x[j] - x[i]
    lengths = edges.norm(dim=1)
    directions = edges * inverse(lengths**1.5, lengths <= MIN_RELATIVE_LENGTH * lengths.mean())[:, None]
    hessian = modes.new_zeros(len(modes), len(modes))
    for some in torch.arange(len(i)).split(4000):  # more would not fit into caches
        fields = modes.index_select(1, j[some]) - modes.index_select(1, i[some])
        rows = torch.einsum("kec,ec->ke", fields, directions[some])
        hessian += rows @ rows.mT
    return hessian


def spread(fine: Tensor, coarse: Tensor) -> float:
    """Largest over smallest ratio of two stiffnesses, over all combinations of modes.

    A uniform factor does no harm. But where the coarse mesh is soft, as where a limb has become flat, a minimisation
    goes far astray; where it is stiff, as where few long triangles follow a limb, it does not move at all.

    *Shape:* ``(k, k), (k, k)``.
    """
    size = fine.diagonal().clamp_min(torch.finfo(fine.dtype).tiny).rsqrt()
    fine, coarse = (size[:, None] * x * size for x in (fine, coarse))
    eye = NO_STIFFNESS * torch.eye(len(fine), dtype=fine.dtype)
    level = coarse.diagonal().mean().clamp_min(torch.finfo(fine.dtype).tiny)
    lower = torch.linalg.cholesky(fine + eye)
    half = torch.linalg.solve_triangular(lower, coarse / level + eye, upper=False)
    ratios = torch.linalg.eigvalsh(torch.linalg.solve_triangular(lower, half.mT, upper=False))
    return float(ratios[-1] / ratios[0].clamp_min(torch.finfo(fine.dtype).tiny))
