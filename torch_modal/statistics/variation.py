"""How the shapes of a set vary: each part of the surface with weights of its own, and what that makes of the whole."""

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torch_modal import trees
from torch_modal.backends.choice import choose
from torch_modal.backends.torch.fine_steps import FurtherEnergy
from torch_modal.energy.bend import Bend
from torch_modal.energy.shell import ALPHA, BETA, GAMMA
from torch_modal.energy.stretch import Stretch
from torch_modal.energy.term import Mesh
from torch_modal.energy.volume import Volume, encloses
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.triangle_frames import frames, sides
from torch_modal.geometry.vectors import pick
from torch_modal.statistics.coordinates import BendingCoordinates
from torch_modal.statistics.patches import LocalMixtures, Patches

# Over which local weights vary, relative to the largest distance on the surface: best of 0.1, 0.2 and 0.4.
LENGTH = 0.2

# Newton steps and products with which drawn shapes relax.
STEPS, PRODUCTS = 4, 30

# Neighbours whose normals have a smaller cosine lie on each other.
FOLDED = -0.9

# A draw that folds is made less local, so often and by this factor; then not at all local; then a given shape.
ROUNDS, SMOOTHER = 4, 0.5


class Variation:
    """Shapes whose parts are mixed from given ones with weights of their own.

    All positions are relative to :attr:`origin`.

    Args:
        shapes: *Shape:* ``(K, V, 3)``, float64 on the CPU.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """

    def __init__(self, shapes: Tensor, faces: Tensor) -> None:
        #: What is subtracted from all shapes: second moments far from the origin would be rounding. *Shape:* ``(3,)``.
        self.origin = shapes[0, faces.flatten()].mean(0)
        shapes = shapes - self.origin
        mean = _middle(shapes, faces)
        self.coordinates = BendingCoordinates(mean, faces)
        self.faces = faces
        #: Of the mean, in the caller's units.
        self.size = self.coordinates.size
        #: The given shapes, turned on to the mean. *Shape:* ``(K, V, 3)``.
        self.shapes = self.coordinates.aligned(shapes)
        bending = self.coordinates.of(shapes)
        #: Mean of the coordinates of all shapes, and how each differs. *Shape:* ``(6, E)``, ``(K, 6, E)``.
        self.average = bending.mean(0)
        self.deviations = bending - self.average
        patches = Patches(mean, self.coordinates.reconstruction)
        #: Fields whose sums local weights are; the first is one everywhere. *Shape:* ``(n, V)``.
        self.fields = patches.fields(LENGTH)
        self.scale = CANONICAL_SIZE / self.size
        self.mixtures = LocalMixtures(patches, self.shapes)
        mesh = Mesh(self.coordinates.mesh)
        self.fine = choose("auto").fine_energy(mesh, [Stretch(ALPHA), Bend(BETA), Volume(GAMMA)])
        closed = all(encloses(x, mesh.connectivity) for x in self.shapes)
        #: Measures of the given shapes, at a size of 100.
        self.rest = self.fine.energy.rest_of(self.scale * self.shapes)
        #: Of the three terms of Eq. 5. *Shape of each:* ``(1, 1)``.
        self.stiffness = [mean.new_full((1, 1), value) for value in (ALPHA, BETA, GAMMA if closed else 0.0)]

    def __len__(self) -> int:
        return len(self.shapes)

    def local(self, factors: Tensor, about: Tensor) -> Tensor:
        """Weights at the vertices; they add up to one. *Shape:* ``(K, n), (K,) -> (K, V)``."""
        return about[:, None] + (factors - factors.mean(0)) @ self.fields

    def bending(self, weights: Tensor) -> Tensor:
        """Coordinates of local weights. *Shape:* ``(K, V) -> (6, E)``."""
        return self.average + torch.einsum("ke,kje->je", self.coordinates.spread(weights), self.deviations)

    def assembled(self, weights: Tensor) -> Tensor:
        """The shape whose triangles turn and stretch so, in the pose of the mean. *Shape:* ``(K, V) -> (V, 3)``."""
        return self.coordinates.shapes(self.bending(weights)[None])[0]

    @torch.no_grad()
    def relaxed(
        self, x: Tensor, weights: Tensor, n_steps: int, n_products: int, pulls: FurtherEnergy | None = None
    ) -> Tensor:
        """Steps of all vertices towards lengths and angles that are weighted means of the given shapes'.

        Args:
            x: In the pose of the mean. *Shape:* ``(V, 3)``.
            weights: *Shape:* ``(K, V)``.
            n_steps: Newton steps.
            n_products: Iterations of conjugate gradients in each.
            pulls: An energy beside it, at a size of 100.
        """
        energy = self.fine.energy
        rest = trees.mapped(energy.mixed(self.rest, weights), lambda part: part[None])
        reference = energy.against(rest, self.stiffness)
        beside = [] if pulls is None else [pulls]
        return self.fine.towards(self.scale * x[None], reference, n_steps, n_products, beside)[0] / self.scale

    # ----------------------------------------------------------------------------------------------------- new members
    def draw(self, concentration: float, locality: float, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Random weights, and factors of the fields over which their logarithms vary. *Shape:* ``(K,), (K, n - 1)``."""
        device = torch.device("cpu") if generator is None else generator.device
        shape = torch.full((len(self),), concentration, dtype=torch.float64, device=device)
        # Gamma variates by their logarithms: those of small concentrations underflow.
        drawn = torch._standard_gamma(shape + 1, generator=generator).log()
        drawn = drawn + torch.rand(len(self), dtype=torch.float64, generator=generator, device=device).log() / shape
        size = len(self), len(self.fields) - 1
        factors = torch.randn(size, dtype=torch.float64, generator=generator, device=device).cpu()
        return torch.softmax(drawn, 0).cpu(), locality * factors

    def member(self, weights: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
        """A member of the set, in the pose of the mean, and its local weights; less local, if it would fold.

        If it folds even then, it is the given shape of the largest weight. None of the weights is below zero, and they
        add up to one.

        Args:
            weights: Of the shape. *Shape:* ``(K,)``.
            factors: Of :meth:`draw`. *Shape:* ``(K, n - 1)``.

        Returns:
            *Shape:* ``(V, 3)``, ``(K, V)``.
        """
        most = max(self.folds(x) for x in self.shapes)
        logarithms = weights.clamp_min(torch.finfo(weights.dtype).tiny).log()[:, None]
        for i in range(ROUNDS + 1):
            part = 0 if i == ROUNDS else SMOOTHER**i
            own = torch.softmax(logarithms + part * factors @ self.fields[1:], 0)
            x = self.relaxed(self.assembled(own), own, STEPS, PRODUCTS)
            if self.folds(x) <= most:
                return x, own
        first = int(weights.argmax())
        return self.shapes[first].clone(), one_hot(weights.argmax(), len(self)).to(own)[:, None].expand_as(own)

    def folds(self, x: Tensor) -> int:
        """How many pairs of neighbouring triangles lie on each other. *Shape:* ``(V, 3)``."""
        normals = frames(sides(x.detach().mT[:, None].contiguous(), self.faces)).normal[:, 0]
        one, other = torch.tensor(self.coordinates.mesh.face_neighbours).unbind(1)
        return int(((pick(normals, one) * pick(normals, other)).sum(0) < FOLDED).sum())


def _middle(shapes: Tensor, faces: Tensor) -> Tensor:
    """The mean of rotations and strains, seen from the first shape and then from itself. *Shape:* ``(V, 3)``."""
    mean = shapes[0]
    for _ in range(2):
        coordinates = BendingCoordinates(mean, faces)
        mean = coordinates.shapes(coordinates.of(shapes).mean(0, keepdim=True))[0]
    return mean
