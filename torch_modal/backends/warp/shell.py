"""Eq. 5 on a mesh by kernels of NVIDIA Warp, where that is installed.

Each kernel does in one pass over the elements what torch does in dozens. The torch code stays: it is what these are
tested against, what runs where Warp is not, and what differentiates a gradient once more.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.backends.warp.launch import kernels, launch, zeros
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.term import Mesh


class ShellReference(NamedTuple):
    """Both rest shapes of each sample, as the kernels see them."""

    stretch: Tensor
    """Doubled weight and length. *Shape:* ``(B, E, 2)``."""
    bend: Tensor
    """Doubled weight, one of the rest angles by its phase, and the moments about it. *Shape:* ``(B, E, 7)``."""
    stiffness: Tensor
    """Of the volume, doubled. *Shape:* ``(B,)``."""
    volume: Tensor
    """*Shape:* ``(B,)``."""
    constant: Tensor
    """*Shape:* ``(B,)``."""


class ShellPoint(NamedTuple):
    """The energy at given shapes."""

    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """But for the volume. *Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """Of the convex Hessian, packed. *Shape:* ``(B, V, 6)``."""
    edges: Tensor
    """*Shape:* ``(B, E, 5)``."""
    hinges: Tensor
    """*Shape:* ``(B, E, 10)``."""
    normal: Tensor
    """Gradient of the volume. *Shape:* ``(B, V, 3)``."""
    moment: Tensor
    """First derivative of the energy in the volume. *Shape:* ``(B,)``."""


class WarpShell(nn.Module):
    """The terms of Eq. 5 towards two rest shapes, in float64.

    Args:
        energy: Of stretch, bend and volume, in this order.
        mesh: Its mesh.
    """

    record: Tensor
    hinge: Tensor
    interior: Tensor
    capped_faces: Tensor
    used: Tensor

    def __init__(self, energy: Energy, mesh: Mesh) -> None:
        super().__init__()
        own = mesh.connectivity
        interior = torch.tensor(own.counts == 2)
        record = torch.cat([mesh.edges, torch.full_like(mesh.edges, -1)], 1)
        record[interior] = mesh.hinges
        self._energy = (energy,)
        self.n_vertices = own.n_vertices
        self.closed = len(own.boundary_chain) == 0
        self.register_buffer("record", record.int(), persistent=False)
        self.register_buffer("hinge", (interior.cumsum(0) - 1).int(), persistent=False)
        #: The edges that have a hinge. *Shape:* ``(H,)``.
        self.register_buffer("interior", torch.nonzero(interior).flatten(), persistent=False)
        chain = torch.tensor(own.boundary_chain)
        cones = torch.cat([chain.flip(1), torch.full_like(chain[:, :1], -1)], 1)
        self.register_buffer("capped_faces", torch.cat([mesh.faces, cones]).int(), persistent=False)
        used = torch.zeros(own.n_vertices, 1, dtype=torch.bool).index_fill(0, energy.used.cpu(), True)
        self.n_used = len(energy.used)
        #: Vertices of faces. *Shape:* ``(V, 1)``, bool.
        self.register_buffer("used", used.to(energy.used.device), persistent=False)

    @property
    def energy(self) -> Energy:
        """The same energy in torch."""
        return self._energy[0]

    # ---------------------------------------------------------------------------------------------------- the reference
    def reference(self, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> ShellReference:
        """The reference of shapes.

        Args:
            first: Rest shapes of the weight ``1 - t``. *Shape:* ``(B, V, 3)``.
            second: Rest shapes of the weight ``t``. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
            stiffness: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
        """
        alpha, beta, gamma = (value.contiguous() for value in stiffness)
        pull, shortest, whole, volume, constant = self._weighed(t, gamma, self.sizes(first, second))
        b, n_edges = len(t), len(self.record)
        stretch, bend = first.new_empty(b, n_edges, 2), first.new_empty(b, n_edges, 7)
        given = self._rest(first, second, pull, shortest, alpha, beta)
        launch(kernels("references").rest, (b, n_edges), [*given, stretch, bend, constant])
        return ShellReference(stretch, bend, whole, volume, constant)

    def _rest(self, first: Tensor, second: Tensor, pull: Tensor, shortest: Tensor, *stiffness: Tensor) -> list[Any]:
        """What ``references.rest`` takes, without its results."""
        given = [first, second, self.record, self.hinge, pull, shortest, *stiffness, first.shape[1]]
        return [*given, *(value.shape[-1] for value in stiffness)]

    def _weighed(self, t: Tensor, gamma: Tensor, sizes: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Pulls and shortest lengths of both ends, *shape* ``(B, 2)``; of volumes stiffness, value, constant."""
        # The last are no views, of which forward mode has no tangents.
        found = (*t.new_empty(2, len(t), 2).unbind(), *(t.new_empty(len(t)) for _ in range(3)))
        launch(kernels("references").weigh, (len(t),), [t, gamma, *sizes, len(self.record), *found])
        return found

    def from_reference(
        self, received: ShellReference, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor
    ) -> tuple[Tensor, ...]:
        """Adjoint of :meth:`reference`: gradients of its arguments, from those of its result without the constant."""
        module, b, n_edges = kernels("adjoints"), len(t), len(self.record)
        alpha, beta, gamma = (value.contiguous() for value in stiffness)
        sizes = self.sizes(first, second)
        weighed = self._weighed(t, gamma, sizes)
        to_volumes, to_areas, to_pull = t.new_zeros(3, b, 2)
        to_t, to_gamma, to_constant = t.new_zeros(3, b)
        adjoints = [to_t, to_gamma, None, to_volumes, to_areas, None, to_pull, None]
        adjoints += [received.stiffness.clone(), received.volume.clone(), to_constant]
        launch(module.weigh, (b,), [t, gamma, *sizes, n_edges, *weighed], adjoints)
        to_first, to_second = torch.zeros(2, *first.shape, dtype=first.dtype, device=first.device)
        to_alpha, to_beta = torch.zeros_like(alpha), torch.zeros_like(beta)
        given = [*self._rest(first, second, *weighed[:2], alpha, beta), received.stretch, received.bend, weighed[-1]]
        adjoints = [to_first, to_second, None, None, to_pull, None, to_alpha, to_beta, *[None] * 3]
        adjoints += [received.stretch.clone(), received.bend.clone(), None]
        launch(module.rest, (b, n_edges), given, adjoints)
        centres = (None, None) if self.closed else first.new_zeros(2, b, 3).unbind()
        given = [*self._sized(first, second, self.record), *sizes]
        adjoints = [to_first, to_second, *centres, None, None, None, None, to_volumes, to_areas]
        launch(module.sizes, (b, n_edges + len(self.capped_faces)), given, adjoints)
        for found, centre in zip((to_first, to_second), centres, strict=True):
            self._spread(centre, found)
        to_t += to_pull[:, 1] - to_pull[:, 0]
        return to_first, to_second, to_t, to_alpha, to_beta, to_gamma[:, None]

    def reference_by_torch(self, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> ShellReference:
        """The same by torch."""
        one, other = (self.energy.rest_of(x) for x in (first, second))
        return self.packed(self.energy.among((one, other), torch.stack([1 - t, t], -1), stiffness))

    def packed(self, reference: Reference) -> ShellReference:
        """A reference of torch's as one of the kernels'."""
        (lengths, angles, volume), (per_length, stiffness, hard), _ = reference
        stretch = torch.stack([2 * per_length, lengths.squeeze(-2)], -1)
        angle, *others = angles.unbind(-2)
        hinges = torch.stack([2 * stiffness, angle.cos(), angle.sin(), *others], -1)
        bend = hinges.new_zeros(len(hinges), len(self.record), 7).index_copy(1, self.interior, hinges)
        constant = torch.as_tensor(reference.constant).to(stretch).expand(len(stretch))
        return ShellReference(stretch, bend, 2 * hard.squeeze(-1), volume.flatten(), constant)

    def unpacked(self, reference: ShellReference) -> Reference:
        """The inverse of :meth:`packed`."""
        bend = reference.bend.index_select(1, self.interior)
        angles = torch.cat([torch.atan2(bend[..., 2:3], bend[..., 1:2]), bend[..., 3:]], -1)
        measures = reference.stretch[:, None, :, 1], angles.mT, reference.volume[:, None, None]
        weights = reference.stretch[..., 0], bend[..., 0], reference.stiffness[:, None]
        return Reference(measures, tuple(0.5 * weight for weight in weights), reference.constant)

    # ------------------------------------------------------------------------------------------------------- the energy
    def sizes(self, first: Tensor, second: Tensor) -> tuple[Tensor, ...]:
        """Lengths of all edges together, volume and area of both ends. *Shape of each:* ``(B, 2)``."""
        return self._sizes(first, second, self.record)

    def _sizes(self, first: Tensor, second: Tensor, record: Tensor) -> tuple[Tensor, ...]:
        found = first.new_zeros(3, len(first), 2).unbind()
        dim = len(first), len(record) + len(self.capped_faces)
        launch(kernels("references").sizes, dim, [*self._sized(first, second, record), *found])
        return found

    def _sized(self, first: Tensor, second: Tensor, record: Tensor) -> list[Any]:
        """What ``references.sizes`` takes, without its results."""
        centres = self.centre(first), self.centre(second)
        return [first, second, *centres, record, self.capped_faces, self.n_vertices]

    def centre(self, x: Tensor) -> Tensor | None:
        """The origin of volumes: the mean; None, for any vertex, where the surface is closed. *Shape:* ``(B, 3)``."""
        return None if self.closed else self.mean(x)

    def mean(self, x: Tensor) -> Tensor:
        """Of all vertices of faces. *Shape:* ``(B, V, 3) -> (B, 3)``."""
        return x.mean(1) if self.n_used == self.n_vertices else (x * self.used).sum(1) / self.n_used

    def _spread(self, to_centre: Tensor | None, to_x: Tensor) -> None:
        """Distribute the gradient of the centre to the vertices. *Shape:* ``(B, 3), (B, V, 3)``."""
        if to_centre is not None:
            to_x.add_(to_centre[:, None] / self.n_used * self.used)

    def volume(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The volume about the centre, and its gradient. *Shape:* ``(B,), (B, V, 3)``."""
        total, normal = x.new_zeros(len(x)), torch.zeros_like(x)
        given = [x, self.centre(x), self.capped_faces, self.n_vertices, total, normal]
        launch(kernels("shell").volume, (len(x), len(self.capped_faces)), given)
        return total, self.shared(normal)

    def shared(self, normal: Tensor) -> Tensor:
        """Gradients with a fixed centre, plus those through the centre.

        On a closed surface the latter vanish. *Shape:* ``(B, V, 3)``.
        """
        if self.closed:
            return normal
        return normal - normal.sum(1, keepdim=True) / self.n_used * self.used

    def at(self, x: Tensor, to: ShellReference) -> ShellPoint:
        """Value and derivatives but for the constant. *Shape:* ``(B, V, 3)``."""
        (b, n), n_edges = x.shape[:2], len(self.record)
        # What starts as zeros lies together.
        energy, volume, gradient, normal, diagonal = zeros(x, (b,), (b,), (b, n, 3), (b, n, 3), (b, n, 6))
        edges, hinges = x.new_empty(b, n_edges, 5), x.new_empty(b, n_edges, 10)
        given = [x, self.record, to.stretch, to.bend, self.centre(x), self.capped_faces, n]
        given += [energy, gradient, diagonal, edges, hinges, volume, normal]
        launch(kernels("shell").linearise, (b, n_edges + len(self.capped_faces)), given)
        off = volume - to.volume
        moment = to.stiffness * off
        energy = torch.addcmul(energy, moment, off, value=0.5)
        return ShellPoint(energy, gradient, diagonal, edges, hinges, self.shared(normal), moment)

    def from_point(
        self,
        x: Tensor,
        at: ShellPoint,
        to: ShellReference,
        to_gradient: Tensor,
        to_x: Tensor,
        to_reference: ShellReference,
        others: Sequence[Tensor | None] = (None, None, None),
        to_normal: Tensor | None = None,
    ) -> None:
        """Adjoint of :meth:`at`: add the gradients of shapes and references.

        Args:
            x: The shapes. *Shape:* ``(B, V, 3)``.
            at: What is found there; its diagonal, edges and hinges are not looked at.
            to: The references.
            to_gradient: In the whole gradient, with the volume's part. *Shape:* ``(B, V, 3)``.
            to_x: Is added to. *Shape:* ``(B, V, 3)``.
            to_reference: Is added to.
            others: In the diagonal, the edges and the hinges.
            to_normal: In the volume's gradient beyond that. *Shape:* ``(B, V, 3)``.
        """
        to_moment = (to_gradient * at.normal).sum((1, 2))
        to_volume = to.stiffness * to_moment
        own = at.moment[:, None, None] * to_gradient
        to_normal = own if to_normal is None else own.add_(to_normal)
        if not self.closed:  # the adjoint of shared()
            to_normal = to_normal - self.mean(to_normal)[:, None]
        centre = self.centre(x)
        to_centre = None if centre is None else torch.zeros_like(centre)
        given = [x, self.record, to.stretch, to.bend, centre, self.capped_faces, self.n_vertices, None]
        # Where nothing is received, nothing is computed.
        taken = [None if other is None else own for own, other in zip(at[2:5], others, strict=True)]
        given += [at.gradient, *taken, at.energy, torch.empty_like(at.normal)]  # functions of kernels add once more
        adjoints = [to_x, None, to_reference.stretch, to_reference.bend, to_centre, None, None, None]
        adjoints += [to_gradient, *others, to_volume, to_normal]
        dim = len(x), len(self.record) + len(self.capped_faces)
        launch(kernels("adjoints").linearise, dim, given, adjoints)
        self._spread(to_centre, to_x)
        off = torch.where(to.stiffness > 0, at.moment / torch.where(to.stiffness > 0, to.stiffness, 1), 0)
        to_reference.stiffness.add_(to_moment * off)
        to_reference.volume.sub_(to_volume)

    def value_and_gradient(self, x: Tensor, to: ShellReference) -> tuple[Tensor, Tensor]:
        """The energy but for its constant, and its gradient. *Shape:* ``(B, V, 3) -> (B,), (B, V, 3)``."""
        b, n = x.shape[:2]
        energy, volume, gradient, normal = zeros(x, (b,), (b,), (b, n, 3), (b, n, 3))
        given = [x, self.record, to.stretch, to.bend, self.centre(x), self.capped_faces, n]
        given += [energy, gradient, None, None, None, volume, normal]
        launch(kernels("shell").linearise, (b, len(self.record) + len(self.capped_faces)), given)
        off = volume - to.volume
        moment = to.stiffness * off
        gradient.addcmul_(moment[:, None, None], self.shared(normal))
        return torch.addcmul(energy, moment, off, value=0.5), gradient

    def value(self, x: Tensor, to: ShellReference) -> Tensor:
        """The energy but for its constant, of one shape or more for each reference. *Shape:* ``(D * B, V, 3)``."""
        energy, volume = x.new_zeros(2, len(x)).unbind()
        given = [
            x,
            self.record,
            to.stretch,
            to.bend,
            self.n_vertices,
            len(to.volume),
            self.centre(x),
            self.capped_faces,
        ]
        launch(kernels("shell").value, (len(x), len(self.record) + len(self.capped_faces)), [*given, energy, volume])
        if len(x) != len(to.volume):
            energy, volume = (value.unflatten(0, (-1, len(to.volume))) for value in (energy, volume))
        off = volume - to.volume
        return torch.addcmul(energy, to.stiffness * off, off, value=0.5).flatten()
