"""Eq. 5 on a mesh by kernels of NVIDIA Warp, where that is installed.

Each kernel does in one pass over the elements what torch does in dozens. The torch code stays: it is what these are
tested against, what runs where Warp is not, and what differentiates a gradient once more.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.terms import Bend, Mesh, Stretch, Volume
from torch_modal.nn.launch import Backend, Shapes, has_kernels, kernels, launch, recorded


class ShellReference(NamedTuple):
    """Both rest shapes of each sample, as the kernels see them."""

    stretch: Tensor
    """Doubled weight and length. *Shape:* ``(B, E, 2)``."""
    bend: Tensor
    """Doubled weights and angles of both. *Shape:* ``(B, E, 4)``."""
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


class FusedShell(nn.Module):
    """The terms of Eq. 5 towards two rest shapes, in float64.

    Args:
        energy: Of stretch, bend and volume, in this order.
        mesh: Its mesh.
    """

    record: Tensor
    hinge: Tensor
    interior: Tensor
    walls: Tensor
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
        self.register_buffer("walls", torch.cat([mesh.faces, cones]).int(), persistent=False)
        self.register_buffer("used", energy.used, persistent=False)

    @staticmethod
    def serves(energy: Energy, backend: Backend) -> bool:
        """Whether it can stand in for an energy."""
        return [type(part.term) for part in energy.parts] == [Stretch, Bend, Volume] and has_kernels(backend)

    @property
    def energy(self) -> Energy:
        """What the kernels compute, in torch."""
        return self._energy[0]

    # ---------------------------------------------------------------------------------------------------- the reference
    def reference(self, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> ShellReference:
        """What shapes are compared with; recorded where gradients are.

        Args:
            first: Rest shapes of the weight ``1 - t``. *Shape:* ``(B, V, 3)``.
            second: Rest shapes of the weight ``t``. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
            stiffness: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
        """
        module, (b, n), n_edges = kernels("shell"), first.shape[:2], len(self.record)
        alpha, beta, gamma = (value.contiguous() for value in stiffness)
        found = self.sizes(first, second)
        shapes: Shapes = {6: (b, 2), 7: (b, 2), 8: (b,), 9: (b,), 10: (b,)}
        given: list[Any] = [t, gamma, *found, n_edges, *[None] * 5]
        pull, shortest, whole, volume, apart = recorded(module.weigh, (b,), shapes, *given, written=tuple(shapes))
        given = [first, second, self.record, self.hinge, pull, shortest, alpha, beta]
        given += [n, alpha.shape[-1], beta.shape[-1], None, None, None]
        shapes = {11: (b, n_edges, 2), 12: (b, n_edges, 4), 13: (b,)}
        stretch, bend, constant = self._run(module.rest, shapes, given, written=(11, 12))
        return ShellReference(stretch, bend, whole, volume, constant + apart)

    def reference_by_torch(self, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> ShellReference:
        """The same by torch."""
        one, other = (self.energy.rest(self.energy.extend(x.movedim(-1, 0).contiguous())) for x in (first, second))
        return self.packed(self.energy.between(one, other, t, stiffness))

    def packed(self, reference: Reference) -> ShellReference:
        """A reference of torch's, towards two rest shapes, as one of the kernels'."""
        stretch = torch.stack([2 * reference.weights[0][:, 0], reference.measures[0][:, 0]], -1)
        both = torch.stack([2 * reference.weights[1], reference.measures[1]], -1)  # (B, 2, H, 2)
        hinges = both.movedim(1, 2).flatten(2)
        bend = hinges.new_zeros(len(hinges), len(self.record), 4).index_copy(1, self.interior, hinges)
        volume = [values[2][:, 0, 0] for values in (reference.weights, reference.measures)]
        constant = torch.as_tensor(reference.constant).to(stretch).expand(len(stretch))
        return ShellReference(stretch, bend, 2 * volume[0], volume[1], constant)

    def unpacked(self, reference: ShellReference) -> Reference:
        """The inverse of :meth:`packed`."""
        bend = reference.bend.index_select(1, self.interior).unflatten(2, (2, 2)).movedim(2, 1)
        measures = reference.stretch[:, None, :, 1], bend[..., 1], reference.volume[:, None, None]
        weights = reference.stretch[:, None, :, 0], bend[..., 0], reference.stiffness[:, None, None]
        return Reference(measures, tuple(0.5 * weight for weight in weights), reference.constant)

    # ------------------------------------------------------------------------------------------------------- the energy
    def sizes(self, first: Tensor, second: Tensor) -> tuple[Tensor, ...]:
        """Lengths of all edges together, volume and area of both ends. *Shape of each:* ``(B, 2)``."""
        return self._sizes(first, second, self.record)

    def volumes(self, first: Tensor, second: Tensor) -> Tensor:
        """Volumes of both ends alone. *Shape:* ``(B, 2)``."""
        return self._sizes(first, second, self.record[:0])[1]

    def _sizes(self, first: Tensor, second: Tensor, record: Tensor) -> tuple[Tensor, ...]:
        given = [first, second, self.centre(first), self.centre(second), record, self.walls, self.n_vertices]
        shapes: Shapes = dict.fromkeys((7, 8, 9), (len(first), 2))
        return self._run(kernels("shell").sizes, shapes, [*given, None, None, None], len(record) + len(self.walls))

    def centre(self, x: Tensor) -> Tensor | None:
        """What volumes are relative to: the mean; None, any vertex, where it does not matter. *Shape:* ``(B, 3)``."""
        return None if self.closed else self.mean(x)

    def mean(self, x: Tensor) -> Tensor:
        """Of all vertices of faces. *Shape:* ``(B, V, 3) -> (B, 3)``."""
        return x.mean(1) if len(self.used) == self.n_vertices else x[:, self.used].mean(1)

    def volume(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The volume about the centre, and its gradient; not recorded. *Shape:* ``(B,), (B, V, 3)``."""
        total, normal = x.new_zeros(len(x)), torch.zeros_like(x)
        given = [x, self.centre(x), self.walls, self.n_vertices, total, normal]
        launch(kernels("shell").volume, (len(x), len(self.walls)), given)
        return total, self.shared(normal)

    def shared(self, normal: Tensor) -> Tensor:
        """What vertices receive that stand still with the centre, with what they receive as it moves with them.

        Of a closed surface that is nothing. *Shape:* ``(B, V, 3)``.
        """
        if self.closed:
            return normal
        share = normal.sum(1, keepdim=True) / len(self.used)
        return normal.index_add(1, self.used, -share.expand(-1, len(self.used), -1))

    def _run(
        self, kernel: Any, shapes: Shapes, given: list[Any], n: int | None = None, written: tuple[int, ...] = ()
    ) -> tuple[Tensor, ...]:
        n_samples = next(iter(shapes.values()))[0]
        return recorded(kernel, (n_samples, len(self.record) if n is None else n), shapes, *given, written=written)

    def at(self, x: Tensor, to: ShellReference) -> ShellPoint:
        """Value and derivatives but for the constant; recorded where gradients are. *Shape:* ``(B, V, 3)``."""
        b, e = len(x), len(self.record)
        shapes: Shapes = {7: (b,), 8: tuple(x.shape), 9: (*x.shape[:2], 6), 10: (b, e, 5), 11: (b, e, 10)}
        shapes |= {12: (b,), 13: tuple(x.shape)}
        given = [x, self.record, to.stretch, to.bend, self.centre(x), self.walls, self.n_vertices, *[None] * 7]
        found = self._run(kernels("shell").linearise, shapes, given, e + len(self.walls), written=(10, 11))
        energy, gradient, diagonal, edges, hinges, volume, normal = found
        off = volume - to.volume
        moment = to.stiffness * off
        energy = torch.addcmul(energy, moment, off, value=0.5)
        return ShellPoint(energy, gradient, diagonal, edges, hinges, self.shared(normal), moment)

    def gradient(self, x: Tensor, to: ShellReference) -> Tensor:
        """The gradient; recorded where gradients are. *Shape:* ``(B, V, 3)``."""
        at = self.at(x, to)
        return at.gradient + at.moment[:, None, None] * at.normal

    def value(self, x: Tensor, to: ShellReference) -> Tensor:
        """The energy but for its constant, of one shape or more for each reference. *Shape:* ``(D * B, V, 3)``."""
        energy, volume = x.new_zeros(2, len(x)).unbind()
        given = [x, self.record, to.stretch, to.bend, self.n_vertices, len(to.volume), self.centre(x), self.walls]
        launch(kernels("shell").value, (len(x), len(self.record) + len(self.walls)), [*given, energy, volume])
        if len(x) == len(to.volume):
            return energy + self._of_volume(volume, to)
        energy, volume = (value.unflatten(0, (-1, len(to.volume))) for value in (energy, volume))
        return (energy + self._of_volume(volume, to)).flatten()

    @staticmethod
    def _of_volume(volume: Tensor, to: ShellReference) -> Tensor:
        return 0.5 * to.stiffness * (volume - to.volume) ** 2
