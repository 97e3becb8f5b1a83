"""Variation of a set of shapes, with weights of its own for each part of the surface."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torch_modal import trees
from torch_modal.elastic.backend import choose
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.energy import Energy, Rest
from torch_modal.elastic.shell import ALPHA, BETA, GAMMA
from torch_modal.elastic.steps import FreeEnergy
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import Volume, encloses
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import edge_graph, farthest_apart
from torch_modal.geometry.rigid import best_fit, best_rotation
from torch_modal.geometry.triangle_frames import frames_of
from torch_modal.geometry.vectors import pick
from torch_modal.statistics.coordinates import BendingCoordinates

# Left-out poses of nine sets come nearest to the truth with 30 to 100 patches, of 6 to 100.
N_PATCHES = 40

# Radius of a patch over the largest distance of a vertex from the nearest centre.
OVERLAP = 1.5

# Stiffness, relative to the variance of its shapes, that draws the weights of a patch to even ones.
EVENNESS = 0.01

# Largest sum of the weights below zero.
LARGEST_EXTRAPOLATION = 2.0

# Length over which local weights vary, relative to the largest distance on the surface: best of 0.1, 0.2 and 0.4.
LENGTH = 0.2

# Products with the Hessian in each of the Newton steps with which drawn shapes relax.
PRODUCTS = 4 * [30]

# Neighbours whose normals have a smaller cosine lie on each other.
FOLDED = -0.9

# Rounds in which a draw that folds is made less local, and by which factor; then it is not local, then a given shape.
ROUNDS, SMOOTHER = 4, 0.5


class Variation:
    """Shapes whose parts are mixed from given ones, float64 on the CPU, with weights of their own.

    All positions are relative to :attr:`origin`. *Shape:* ``(K, V, 3), (F, 3)``.
    """

    def __init__(self, shapes: Tensor, faces: Tensor, backend: str = "auto") -> None:
        #: Subtracted from all shapes: second moments far from the origin would be rounding. *Shape:* ``(3,)``.
        self.origin = shapes[0, faces.flatten()].mean(0)
        #: The given shapes where they are. *Shape:* ``(K, V, 3)``.
        self.placed = shapes = shapes - self.origin
        # The mean of rotations and strains, seen from the first shape and then from itself.
        mean = shapes[0]
        for _ in range(2):
            coordinates = BendingCoordinates(mean, faces)
            mean = coordinates.shapes(coordinates.of(shapes).mean(0, keepdim=True))[0]
        self.coordinates = BendingCoordinates(mean, faces)
        self.faces = faces
        #: Size of the mean, in the caller's units.
        self.size = self.coordinates.size
        #: The given shapes, turned on to the mean. *Shape:* ``(K, V, 3)``.
        self.shapes = self.coordinates.align(shapes)
        bending = self.coordinates.of(shapes)
        #: Mean of the coordinates of all shapes, and how each differs. *Shape:* ``(6, E)``, ``(K, 6, E)``.
        self.average = bending.mean(0)
        self.deviations = bending - self.average
        self.mixtures = LocalMixtures(self.coordinates, self.shapes)
        #: Fields whose sums local weights are; the first is one everywhere. *Shape:* ``(n, V)``.
        self.fields = self.mixtures.fields
        self.scale = CANONICAL_SIZE / self.size
        mesh = Mesh(self.coordinates.mesh)
        self.fine = choose(backend).fine_energy(mesh, [Stretch(ALPHA), Bend(BETA), Volume(GAMMA)])
        closed = all(encloses(x, mesh.connectivity) for x in self.shapes)
        #: Measures of the given shapes, at a size of 100.
        energy = self.fine.energy
        self.rest = energy.rest(energy.extend((self.scale * self.shapes).movedim(-1, 0).contiguous()))
        #: Most folds of a given shape.
        self.most_folds = max(self.folds(x) for x in self.shapes)
        #: Stiffnesses of the three terms of Eq. 5. *Shape of each:* ``(1, 1)``.
        self.stiffness = [mean.new_full((1, 1), value) for value in (ALPHA, BETA, GAMMA if closed else 0.0)]

    def __len__(self) -> int:
        return len(self.shapes)

    def bending(self, weights: Tensor) -> Tensor:
        """Coordinates of local weights. *Shape:* ``(K, V) -> (6, E)``."""
        return self.average + torch.einsum("ke,kje->je", self.coordinates.spread(weights), self.deviations)

    def assemble(self, weights: Tensor) -> Tensor:
        """Shape of local weights by rotations and strains. *Shape:* ``(K, V) -> (V, 3)``."""
        return self.coordinates.shapes(self.bending(weights)[None])[0]

    @torch.no_grad()
    def relax(self, x: Tensor, weights: Tensor, products: Sequence[int], springs: FreeEnergy | None = None) -> Tensor:
        """Newton steps of all vertices towards weighted means of the lengths and angles of the given shapes.

        The springs are an energy at a size of 100. *Shape:* ``(V, 3), (K, V)``.
        """
        energy = self.fine.energy
        rest = trees.map_leaves(mix_rests(energy, self.rest, weights), lambda measure: measure[None])
        reference = energy.reference_of(rest, self.stiffness)
        further = [] if springs is None else [springs]
        return self.fine.descend_towards(self.scale * x[None], reference, products, further)[0] / self.scale

    # ----------------------------------------------------------------------------------------------------- new members
    def draw(
        self,
        n: int,
        concentration: float,
        locality: float,
        beyond: tuple[float, float],
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Random weights, factors of the fields over which their logarithms vary, and how far beyond they go.

        *Shape:* ``(n, K), (n, K, n_fields - 1), (n,)``.

        Raises:
            ValueError: An argument is out of range.
        """
        if n < 0:
            raise ValueError(f"n is 0 or more, got {n}")
        check_density(concentration, locality, beyond)
        device = "cpu" if generator is None else generator.device
        densities = torch.full((n, len(self)), concentration, dtype=torch.float64, device=device)
        weights = torch._sample_dirichlet(densities, generator)
        shape = n, len(self), len(self.fields) - 1
        factors = torch.randn(shape, dtype=torch.float64, generator=generator, device=device)
        low, high = beyond
        far = torch.rand(n if high else 0, dtype=torch.float64, generator=generator, device=device)
        far = low + (high - low) * far if high else torch.zeros(n, dtype=torch.float64)
        return weights.cpu(), locality * factors.cpu(), far.cpu()

    def members(self, weights: Tensor, factors: Tensor, beyond: Tensor, on_shapes: bool = True) -> Tensor:
        r"""Members of the set. *Shape:* ``(n, K), (n, K, n_fields - 1), (n,) -> (n, V, 3)``.

        On the given shapes, at the rigid motion of least :math:`\sum_k w_k \int |x - x_k|^2` with the means of the
        local weights over the surface; otherwise in the pose of the mean.
        """
        shapes, means = self.shapes.new_empty(len(weights), *self.shapes.shape[1:]), torch.empty_like(weights)
        areas = self.coordinates.reconstruction.areas
        for i, each in enumerate(zip(weights, factors, beyond.tolist(), strict=True)):
            shapes[i], local = self.member(*each)
            means[i] = local @ areas / areas.sum()
        if not on_shapes:
            return self.coordinates.align(shapes)
        return best_fit(shapes, torch.einsum("nk,kvi->nvi", means, self.placed), areas).apply(shapes)

    def member(self, weights: Tensor, factors: Tensor, beyond: float) -> tuple[Tensor, Tensor]:
        """A member of the set and its local weights; less local and less far beyond, if it would fold.

        If it folds even then, it is the given shape of the largest weight. The local weights add up to one, and none is
        below zero within the given shapes. *Shape:* ``(K,), (K, n_fields - 1) -> (V, 3), (K, V)``, with weights and
        factors of :meth:`draw`.
        """
        logarithms = weights.clamp_min(torch.finfo(weights.dtype).tiny).log()[:, None]
        for i in range(ROUNDS + 1):
            locality = 0 if i == ROUNDS else SMOOTHER**i
            local = torch.softmax(logarithms + locality * factors @ self.fields[1:], 0)
            local = local + beyond * locality * (local - 1 / len(self))
            x = self.relax(self.assemble(local), local, PRODUCTS)
            if self.folds(x) <= self.most_folds:
                return x, local
        likeliest = one_hot(weights.argmax(), len(self)).to(local)
        return self.shapes[likeliest.argmax()], likeliest[:, None].expand_as(local)

    def folds(self, x: Tensor) -> int:
        """Number of pairs of neighbouring triangles that lie on each other. *Shape:* ``(V, 3)``."""
        normals = frames_of(x.detach()[None], self.faces).normal[:, 0]
        one, other = torch.tensor(self.coordinates.mesh.face_neighbours).unbind(1)
        return int(((pick(normals, one) * pick(normals, other)).sum(0) < FOLDED).sum())


class LocalMixtures:
    """Mixtures of shapes in patches, whose centres are far apart along the surface, so that fingers do not mix.

    *Shape:* ``(K, V, 3)``.
    """

    def __init__(self, coordinates: BendingCoordinates, shapes: Tensor) -> None:
        mean, reconstruction, k = coordinates.mean, coordinates.reconstruction, len(shapes)
        # Gaps between loose pieces and the largest count as edges.
        gaps = [torch.stack([piece[0], anchors[0]])[None] for piece, anchors in reconstruction.loose]
        graph = edge_graph(mean.numpy(), torch.cat([reconstruction.edges, *gaps]).numpy())
        used = np.unique(coordinates.faces.numpy())
        # A patch of one vertex would have no moments.
        centres, from_centres = farthest_apart(graph, used, min(N_PATCHES, len(used) // 2))
        distances, tiny = torch.from_numpy(from_centres), torch.finfo(mean.dtype).tiny
        reach = OVERLAP * max(float(distances[:, used].amin(0).max()), tiny)
        bumps = torch.exp(-2 * (distances / reach) ** 2)
        #: Fraction of each vertex that belongs to each patch. *Shape:* ``(P, V)``.
        self.shares = bumps / bumps.sum(0).clamp_min(tiny)
        #: Masses of the vertices in each patch, with sum one. *Shape:* ``(P, V)``.
        self.masses = bumps * reconstruction.areas
        self.masses = self.masses / self.masses.sum(1, keepdim=True).clamp_min(tiny)
        between = distances[:, centres]
        values, vectors = torch.linalg.eigh(torch.exp(-0.5 * (between / (LENGTH * between.max()).clamp_min(tiny)) ** 2))
        significant = values > 1e-3 * values[-1]
        roots = vectors[:, significant] * values[significant].sqrt()
        #: Fields whose sums with normal factors vary over a length; the first is one everywhere. *Shape:* ``(n, V)``.
        self.fields = torch.cat([torch.ones_like(bumps[:1]), roots.mT @ self.shares])
        self.columns = shapes.movedim(0, 1).flatten(1)  # (V, 3K)
        self.centres = (self.masses @ self.columns).unflatten(1, (k, 3))
        products = torch.stack([(self.columns * mass[:, None]).mT @ self.columns for mass in self.masses])
        products = products.unflatten(2, (k, 3)).unflatten(1, (k, 3)).transpose(2, 3)
        #: Second moments of all pairs of shapes in each patch. *Shape:* ``(P, K, K, 3, 3)``.
        self.moments = products - self.centres[:, :, None, :, None] * self.centres[:, None, :, None, :]

    def weights(self, x: Tensor) -> Tensor:
        r"""Weights of the shapes at each vertex, with sum one. *Shape:* ``(V, 3) -> (K, V)``.

        In each patch they minimise :math:`|x - \sum_k w_k R_k x_k|^2`, with the rotations that fit best.
        """
        masses, n = self.masses, self.moments.shape[1]
        products = torch.stack([(masses * row) @ self.columns for row in x.mT], 1).unflatten(2, (n, 3))
        cross = products.transpose(1, 2) - (masses @ x)[:, None, :, None] * self.centres[:, :, None, :]
        rotations = best_rotation(cross)  # (P, K, 3, 3)
        gram = torch.einsum("pkab,pklbc,plac->pkl", rotations, self.moments, rotations)
        right = (cross * rotations).sum((-1, -2)) - gram.mean(-1)
        right, centred = right - right.mean(-1, keepdim=True), gram - gram.mean(-1, keepdim=True)
        centred = centred - centred.mean(-2, keepdim=True)
        spread, whole = (matrix.diagonal(dim1=-2, dim2=-1).mean(-1) for matrix in (centred, gram))
        spread = torch.maximum(spread, torch.finfo(x.dtype).eps * whole)  # shapes may be equal
        system = centred + EVENNESS * spread[:, None, None] * torch.eye(n).to(x)
        solution = torch.linalg.solve(system, right)
        return bound_weights((solution - solution.mean(-1, keepdim=True)).mT @ self.shares + 1 / n)


def bound_weights(weights: Tensor) -> Tensor:
    """Move weights towards even ones where the negative ones add up to more than a bound. *Shape:* ``(K, V)``."""
    below = -weights.clamp_max(0).sum(0)
    ratio = (LARGEST_EXTRAPOLATION / below.clamp_min(LARGEST_EXTRAPOLATION)).clamp_max(1)
    return 1 / len(weights) + ratio * (weights - 1 / len(weights))


def check_density(concentration: float, locality: float, beyond: tuple[float, float]) -> None:
    """Raise a ValueError if what new members are drawn with is out of range."""
    if not 0 < concentration < torch.inf or not 0 <= locality < torch.inf:
        raise ValueError(f"concentration is above 0, locality 0 or more; got {concentration} and {locality}")
    if not 0 <= beyond[0] <= beyond[1] <= 1:
        raise ValueError(f"beyond is a range (low, high) within [0, 1]; got {beyond}")


def mix_rests(energy: Energy, rest: Rest, weights: Tensor) -> Rest:
    """One rest shape whose measures are weighted sums of the measures of K shapes.

    Where weights differ from vertex to vertex, or are far below zero, merging the shapes (Eq. 8) asks for harmonic
    means.

    Args:
        energy: The terms.
        rest: Measures and weights of K shapes.
        weights: They add up to one. *Shape:* ``(K, V)``.
    """
    measures, stiffness = [], []
    for summand, values, rest_weights in zip(energy.parts, rest.measures, rest.weights, strict=True):
        total = summand.term.total
        element_weights = weights.mean(1, keepdim=True) if total else weights[:, summand.corners].mean(1)
        first = values[..., :1, :]  # differences of angles from it go the short way round
        measures.append((element_weights * (first + summand.term.difference(values, first))).sum(-2))
        stiffness.append((element_weights * rest_weights.expand_as(values)).sum(-2).clamp_min(0))
    return Rest(tuple(measures), tuple(stiffness))
