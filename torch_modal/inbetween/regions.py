"""Local interpolation of what the modes do not reach (section 3.2 of the paper).

- The *local fitting error* of a vertex is its distance from where it is in the other key-frame, when the modes are
  fitted to that;
- *segments* are parts that move nearly rigidly in all modes (Huang et al. 2009);
- the *regions*, the segments of the largest mean error, are interpolated by examples (Froehlich and Botsch 2011): their
  lengths, angles and volume are half-way between the key-frames, and all else is fixed. They are minimised to
  convergence, with angles by the periodic function of the joint space: gradients follow from the minimiser.

The paper's examples are ``x1*`` and the second key-frame, and ``x2*`` and the first. But both shapes are a part of the
way there already: half-way on the rest of it, their regions have passed each other, and the mean is too short.
"""

import heapq
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.elastic.bend import NEEDLE, Bend
from torch_modal.elastic.energy import Energy, Rest, RestShapes
from torch_modal.elastic.formulas import hinge_fullness
from torch_modal.elastic.implicit import solve_implicit
from torch_modal.elastic.minimise import Status
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import Volume
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.inbetween.coarse import stretching_hessian
from torch_modal.inbetween.free_vertices import FreeVertices
from torch_modal.inbetween.paired import PairedSpace

N_SEGMENTS = 24

# Mean error of a segment, relative to the size of the shapes, below which the modes reach all of it.
NO_ERROR = 1e-6

# Added to the stretching stiffness of modes, relative to its mean, for the bending that it leaves out.
BENDING_RIDGE = 1e-3

# Rings of faces around the regions: one that is free, where the modes end; two for hinges, of two faces each.
RINGS_OF_REGIONS = 3

# Newton steps at most: five or six, as a rule.
N_STEPS = 100


def fitting_error(space: PairedSpace, references: Tensor) -> FloatArray:
    """Local fitting error of the coarse vertices: the root of the sum of the squares of both key-frames.

    Args:
        space: The modes of both.
        references: The key-frames in the frame. *Shape:* ``(2, V, 3)``.

    Returns:
        *Shape:* ``(V_coarse,)``.
    """
    coarse, squares = space.first.coarse, []
    first, second = coarse.restrict(references)
    for end, way in ((space.first, second - first), (space.second, first - second)):
        basis = end.coarse_basis.flatten(1)  # orthonormal under the weights
        reached = (basis @ (coarse.weights[:, None] * way).flatten()) @ basis
        squares.append((way - reached.view_as(way)).square().sum(1))
    return (squares[0] + squares[1]).sqrt().numpy()


def segments(space: PairedSpace, references: Tensor, n_segments: int = N_SEGMENTS) -> IntArray:
    """Parts of the coarse mesh that are nearly rigid in all deformations of one stretching energy.

    Pairs of neighbours are joined, from the cheapest on, until so many are left. The cost is the squared distance from
    rigid motions, summed over the modes of both key-frames.

    Args:
        space: The modes of both.
        references: The key-frames in the frame. *Shape:* ``(2, V, 3)``.
        n_segments: How many.

    Returns:
        The segment of each coarse vertex. *Shape:* ``(V_coarse,)``.
    """
    coarse = space.first.coarse
    area, mesh = coarse.weights.numpy(), coarse.mesh
    sums = []
    for end, x in zip((space.first, space.second), coarse.restrict(references), strict=True):
        stiffness = stretching_hessian(mesh, x, end.coarse_basis)
        level = BENDING_RIDGE * stiffness.diagonal().mean() * torch.eye(len(stiffness)).to(stiffness)
        lower = torch.linalg.cholesky(stiffness + level)
        modes = torch.linalg.solve_triangular(lower, end.coarse_basis.flatten(1), upper=False)
        sums.append(_moments(x.numpy(), modes.unflatten(1, (-1, 3)).numpy(), area))
    normal, right, whole = (np.stack(each, 1) for each in zip(*sums, strict=True))

    def deformation(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
        """Squared distance from the nearest rigid motions."""
        return float(c.sum() - np.einsum("eik,eik->", b, np.linalg.pinv(a, hermitian=True) @ b))

    parts = {i: (normal[i], right[i], whole[i]) for i in range(len(area))}
    cost, owner = dict.fromkeys(parts, 0.0), np.arange(len(area))
    near: dict[int, set[int]] = {i: set() for i in parts}
    queue: list[tuple[float, int, int]] = []

    def offer(i: int, j: int) -> None:
        a, b, c = (p + q for p, q in zip(parts[i], parts[j], strict=True))
        heapq.heappush(queue, (deformation(a, b, c) - cost[i] - cost[j], i, j))

    for i, j in mesh.connectivity.edges.tolist():
        near[i].add(j)
        near[j].add(i)
        offer(i, j)
    new = len(area)
    while len(parts) > n_segments and queue:
        _, i, j = heapq.heappop(queue)
        if i not in parts or j not in parts:
            continue
        a, b, c = (p + q for p, q in zip(parts.pop(i), parts.pop(j), strict=True))
        parts[new], cost[new], near[new] = (a, b, c), deformation(a, b, c), (near.pop(i) | near.pop(j)) - {i, j}
        owner[(owner == i) | (owner == j)] = new
        for other in near[new]:
            near[other] = (near[other] - {i, j}) | {new}
            offer(other, new)
        new += 1
    return np.unique(owner, return_inverse=True)[1]


def _moments(x: FloatArray, modes: FloatArray, area: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal equations of the rigid motions nearest to modes. *Shape:* ``(V, 6, 6), (V, 6, k), (V,)``."""
    turns = np.cross(np.eye(3), x[:, None]).swapaxes(1, 2)
    rigid = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2)
    normal = np.einsum("v,vci,vcj->vij", area, rigid, rigid)
    return normal, np.einsum("v,vci,kvc->vik", area, rigid, modes), np.einsum("v,kvc,kvc->v", area, modes, modes)


def worst_regions(space: PairedSpace, references: Tensor, n: int) -> Tensor:
    """Vertices of the ``n`` segments of the largest mean error, or of fewer where the modes reach the others.

    *Shape:* ``(2, V, 3) -> (V,)``, bool.
    """
    coarse, segment = space.first.coarse, segments(space, references)
    area = coarse.weights.numpy()
    sizes = np.maximum(np.bincount(segment, area), np.finfo(np.float64).tiny)
    mean = np.bincount(segment, area * fitting_error(space, references)) / sizes
    chosen = [i for i in np.argsort(-mean, kind="stable")[:n] if mean[i] > NO_ERROR * CANONICAL_SIZE]
    return torch.from_numpy(np.isin(segment, chosen))[coarse.clusters]


class LocalInterpolation(nn.Module):
    """Regions half-way between two key-frames by Eq. 5 against interpolated measures, with all else fixed.

    Args:
        mesh: The caller's mesh.
        fine: The terms on it; only the terms of Eq. 5 are used.
        region: True for vertices of the regions, which the next ring of faces joins. *Shape:* ``(V,)``, bool.
    """

    used: Tensor
    region: Tensor

    def __init__(self, mesh: Mesh, fine: Energy, region: Tensor) -> None:
        super().__init__()
        faces, rings = mesh.faces, [region]
        for _ in range(RINGS_OF_REGIONS):
            rings.append(rings[-1].index_fill(0, faces[rings[-1][faces].any(1)].flatten(), True))
        used, numbered = faces[rings[-1][faces].all(1)].unique(return_inverse=True)
        # Smooth at half a turn, where squared differences of angles have a kink that minimisers would end at.
        energy = Energy(Mesh.of(numbered.view(-1, 3), len(used)), [Stretch(), Bend(), Volume()])
        self.problem = FreeVertices(energy, torch.nonzero(rings[1][used]).flatten())
        self.register_buffer("used", used, persistent=False)
        #: True for the vertices that move. *Shape:* ``(V,)``, bool.
        self.register_buffer("region", rings[1], persistent=False)
        #: Indices of the elements of the regions among the elements of the mesh.
        self.elements: list[Tensor | None] = []
        for other, summand in zip(fine.parts, energy.parts, strict=False):
            self.elements.append(None if summand.term.total else _places(used[summand.corners], other.corners))

    def forward(self, ends: Sequence[Tensor], rests: RestShapes, usable: Tensor) -> tuple[list[Tensor], Tensor]:
        """Interpolate.

        Args:
            ends: Shapes that are fixed outside the regions. *Shape of each:* ``(B, V, 3)``.
            rests: The key-frames. *Shape:* ``(B, 2, V, 3)``.
            usable: False for samples that are left out. *Shape:* ``(B,)``.

        Returns:
            The shapes, and the worse :class:`~torch_modal.elastic.minimise.Status` of both, *shape* ``(B,)``.
        """
        energy, shapes = self.problem.energy, rests.shapes[:, :, self.used].double()
        rest = energy.rest(energy.extend(shapes.movedim(-1, 0).contiguous()))
        measures, stiffness = [], []
        for summand, q, some, value in zip(energy.parts, rest.measures, self.elements, rests.stiffness, strict=False):
            measures.append(q[:, 0] + 0.5 * summand.term.difference(q[:, 1], q[:, 0]))
            values = value if some is None or value.shape[-1] == 1 else value[:, some.to(value.device)]
            values = values.double()
            if isinstance(summand.term, Bend):  # needles turn over at little cost, and would end where they collapse
                values = values * hinge_fullness(summand.edge_vectors(shapes.movedim(-1, 0)), NEEDLE).prod(1)
            stiffness.append(values)
        reference = energy.reference_of(Rest(tuple(measures), tuple(w.mean(1) for w in rest.weights)), stiffness)
        results, status = [], torch.full_like(usable, Status.CONVERGED, dtype=torch.int64)
        for x in ends:
            place = x[:, self.used].double(), reference
            method = FreeVertices.minimise, FreeVertices.inverse
            solution = solve_implicit(self.problem, place, usable, N_STEPS, 0.0, *method)
            results.append(x.index_copy(1, self.used, self.problem.shapes(solution.amplitudes, place[0]).to(x)))
            status = torch.where(status == Status.CONVERGED, solution.status, status)
        return results, status


def _places(some: Tensor, corners: Tensor) -> Tensor:
    """Columns of some elements among all. *Shape:* ``(n, m), (n, M) -> (m,)``."""
    keys = ([(frozenset(c[:2]), frozenset(c[2:])) for c in each.T.tolist()] for each in (corners, some))
    numbers = {key: i for i, key in enumerate(next(keys))}
    # Where more than two faces share an edge, the rim has hinges of its own, which are fixed.
    return torch.tensor([numbers.get(key, 0) for key in next(keys)], dtype=torch.int64)
