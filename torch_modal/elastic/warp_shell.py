"""Eq. 5 on a mesh by Warp kernels: each does in one pass over the elements what torch does in dozens.

The torch code stays: it is what these are tested against, what runs where Warp is not, and what differentiates a
gradient once more.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.elastic.bend import softening
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernels.function import fused
from torch_modal.elastic.kernels.launch import Constants, kernels, launch, records
from torch_modal.elastic.shell import N_SHELL_TERMS
from torch_modal.elastic.stretch import MIN_RELATIVE_LENGTH
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import MIN_RELATIVE_VOLUME
from torch_modal.geometry.vectors import inverse


class ShellReference(NamedTuple):
    """K rest shapes of each sample as one, as the kernels see them. Weights are doubled, for derivatives."""

    elements: Tensor
    """Weight and length of each edge; of its hinge, the weight, and with it the sums of cosines and sines of the rest
    angles and of twice those. *Shape:* ``(B, E, 7)``."""
    stiffness: Tensor
    """Weight of the volume. *Shape:* ``(B,)``."""
    volume: Tensor
    """*Shape:* ``(B,)``."""
    constant: Tensor
    """The energy that remains, beside that of hinges. *Shape:* ``(B,)``."""


class ShellPoint(NamedTuple):
    """The energy at given shapes."""

    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """But for the volume. *Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """Blocks of the convex Hessian's diagonal, packed. *Shape:* ``(B, V, 6)``."""
    factors: Tensor
    """Factors of products with the convex Hessian. *Shape:* ``(B, E, 15)``."""
    normal: Tensor
    """Gradient of the volume. *Shape:* ``(B, V, 3)``."""
    moment: Tensor
    """First derivative of the energy in the volume. *Shape:* ``(B,)``."""


class WarpShell(nn.Module):
    """The terms of Eq. 5 towards K rest shapes, in float64.

    Args:
        energy: Of stretch, bend and volume, in this order.
        mesh: Its mesh.
    """

    interior: Tensor
    used: Tensor

    def __init__(self, energy: Energy, mesh: Mesh) -> None:
        super().__init__()
        own = mesh.connectivity
        record = records(mesh)
        interior = record[:, 2] >= 0
        chain = torch.tensor(own.boundary_chain)
        cones = torch.cat([chain.flip(1), torch.full_like(chain[:, :1], -1)], 1)
        capped_faces = torch.cat([mesh.faces, cones])
        arrays = {"record": record, "hinge": interior.cumsum(0) - 1, "capped_faces": capped_faces}
        #: The mesh as the first argument of kernels.
        self.constants = Constants(
            "elements", "Elements", **{k: x.int() for k, x in arrays.items()}, n_vertices=own.n_vertices
        )
        #: The same energy in torch.
        self.energy = energy
        self.n_vertices, self.n_edges, self.n_hinges = own.n_vertices, len(record), len(mesh.hinges)
        self.n_faces, self.closed = len(capped_faces), len(chain) == 0
        #: The edges that have a hinge. *Shape:* ``(H,)``.
        self.register_buffer("interior", torch.nonzero(interior).flatten(), persistent=False)
        used = torch.zeros(own.n_vertices, 1, dtype=torch.bool).index_fill(0, energy.used.cpu(), True)
        self.n_used = len(energy.used)
        #: Vertices of faces. *Shape:* ``(V, 1)``, bool.
        self.register_buffer("used", used.to(energy.used.device), persistent=False)

    # ---------------------------------------------------------------------------------------------------- the reference
    def reference(self, rests: RestShapes, start: Tensor | None = None, relative: bool = False) -> ShellReference:
        """Merge rest shapes into one reference (Eq. 8); arguments as :meth:`RestShapes.reference`."""
        alpha, beta, gamma = rests.stiffness[:N_SHELL_TERMS]
        elements, volumes, sizes, constant = fused(_Merged(self), rests.shapes, rests.weights, alpha, beta)
        pulls = rests.weights * gamma / sizes**2
        # Weights below zero may outweigh the others: then there is no minimum, and no weight.
        whole = pulls.sum(1).clamp_min(0)
        volume = (pulls * volumes).sum(1) * inverse(whole, whole <= 0)
        constant = constant + torch.where(whole > 0, (pulls * (volumes - volume[:, None]) ** 2).sum(1), 0)
        if start is not None:
            rest = (rests.shapes, rests.weights) if relative else ()
            (elements,) = fused(_Softened(self), start, elements, *rest)
        return ShellReference(elements, 2 * whole, volume, constant)

    def packed(self, reference: Reference) -> ShellReference:
        """A reference of torch's as one of the kernels'."""
        (lengths, angles, volume), (per_length, stiffness, hard), _ = reference
        angle, versine, sine, double_versine, double_sine = angles.unbind(-2)
        # Means of cosine and sine over the rest angles, from those of the differences from one of them.
        once = _turned(angle, 1 - versine, sine)
        twice = _turned(2 * angle, 1 - double_versine, double_sine)
        hinges = 2 * stiffness[..., None] * torch.stack([torch.ones_like(angle), *once, *twice], -1)
        edges = torch.stack([2 * per_length, lengths.squeeze(-2)], -1)
        constant = torch.as_tensor(reference.constant).to(edges).expand(len(edges))
        return ShellReference(self._joined(edges, hinges), 2 * hard.squeeze(-1), volume.flatten(), constant)

    def unpacked(self, reference: ShellReference) -> Reference:
        """The inverse of :meth:`packed`."""
        lengths, hinges = reference.elements[..., 1], reference.elements.index_select(1, self.interior)[..., 2:]
        weight = hinges[..., 0]
        c, s, c2, s2 = (hinges[..., 1:] * inverse(weight, weight <= 0)[..., None]).unbind(-1)
        still = weight <= 0
        angle = torch.atan2(torch.where(still, 0, s), torch.where(still, 1, c))
        (once, sine), (twice, double_sine) = _turned(-angle, c, s), _turned(-2 * angle, c2, s2)
        angles = torch.stack([angle, 1 - once, sine, 1 - twice, double_sine], -2)
        measures = lengths[:, None], angles, reference.volume[:, None, None]
        weights = reference.elements[..., 0], weight, reference.stiffness[:, None]
        return Reference(measures, tuple(0.5 * each for each in weights), reference.constant)

    def _joined(self, edges: Tensor, hinges: Tensor) -> Tensor:
        """Numbers of edges and of their hinges side by side. *Shape:* ``(B, E, 2), (B, H, 5) -> (B, E, 7)``."""
        own = hinges.new_zeros(len(hinges), self.n_edges, 5).index_copy(1, self.interior, hinges)
        return torch.cat([edges, own], -1)

    # ------------------------------------------------------------------------------------------------------- the energy
    def centre(self, x: Tensor) -> Tensor | None:
        """The origin of volumes: the mean; None, for any vertex, where the surface is closed. *Shape:* ``(B, 3)``."""
        return None if self.closed else self.mean(x)

    def mean(self, x: Tensor) -> Tensor:
        """Mean of the vertices of faces. *Shape:* ``(B, V, 3) -> (B, 3)``."""
        return x.mean(1) if self.n_used == self.n_vertices else (x * self.used).sum(1) / self.n_used

    def spread(self, to_centre: Tensor | None, to_x: Tensor) -> None:
        """Distribute the gradient of the centre to the vertices. *Shape:* ``(B, 3), (B, V, 3)``."""
        if to_centre is not None:
            to_x.add_(to_centre[:, None] / self.n_used * self.used)

    def volume(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The volume about the centre, and its gradient. *Shape:* ``(B,), (B, V, 3)``."""
        totals, normal = x.new_zeros(len(x), 2), torch.zeros_like(x)
        given = [self.constants, x, self.centre(x), totals, normal]
        launch(kernels("shell").volume, (len(x), self.n_faces), given)
        return totals[:, 1], self._through_centre(normal)

    def _through_centre(self, normal: Tensor) -> Tensor:
        """Gradients with a fixed centre, plus those through the centre.

        On a closed surface the latter vanish. *Shape:* ``(B, V, 3)``.
        """
        if self.closed:
            return normal
        return normal - normal.sum(1, keepdim=True) / self.n_used * self.used

    def _linearised(self, x: Tensor, to: ShellReference, *results: Tensor | None) -> tuple[Tensor, Tensor]:
        """The energy but for its constant, and the volume's moment; derivatives go to the results."""
        n, n_references = x.shape[0], to.volume.shape[0]
        totals = x.new_zeros(n, 2)
        given = [self.constants, x, to.elements, n_references, self.centre(x), totals, *results]
        launch(kernels("shell").linearise, (n, max(self.n_edges, self.n_faces)), given)
        energy, volume = totals.unbind(1)
        if n != n_references:
            energy, volume = (value.unflatten(0, (-1, n_references)) for value in (energy, volume))
        off = volume - to.volume
        moment = to.stiffness * off
        return torch.addcmul(energy, moment, off, value=0.5), moment

    def at(self, x: Tensor, to: ShellReference) -> ShellPoint:
        """Value and derivatives but for the constant. *Shape:* ``(B, V, 3)``."""
        gradient, normal = torch.zeros_like(x), torch.zeros_like(x)
        diagonal, factors = x.new_zeros(*x.shape[:2], 6), x.new_empty(len(x), self.n_edges, 15)
        energy, moment = self._linearised(x, to, gradient, normal, diagonal, factors)
        return ShellPoint(energy, gradient, diagonal, factors, self._through_centre(normal), moment)

    def value_and_gradient(self, x: Tensor, to: ShellReference) -> tuple[Tensor, Tensor]:
        """The energy but for its constant, and its gradient. *Shape:* ``(B, V, 3) -> (B,), (B, V, 3)``."""
        gradient, normal = torch.zeros_like(x), torch.zeros_like(x)
        energy, moment = self._linearised(x, to, gradient, normal, None, None)
        return energy, gradient.addcmul_(moment[:, None, None], self._through_centre(normal))

    def value(self, x: Tensor, to: ShellReference) -> Tensor:
        """The energy but for its constant, of one shape or more for each reference. *Shape:* ``(D * B, V, 3)``."""
        return self._linearised(x, to, *[None] * 4)[0].flatten()

    def from_point(
        self,
        x: Tensor,
        at: ShellPoint,
        to: ShellReference,
        to_gradient: Tensor,
        to_x: Tensor,
        to_reference: ShellReference,
        others: Sequence[Tensor | None] = (None, None),
        to_normal: Tensor | None = None,
        to_energy: Tensor | None = None,
    ) -> None:
        """Adjoint of :meth:`at`: add the gradients of shapes and references.

        Args:
            x: The shapes. *Shape:* ``(B, V, 3)``.
            at: The energy there; its diagonal and factors are not read.
            to: The references.
            to_gradient: In the whole gradient, with the volume's part. *Shape:* ``(B, V, 3)``.
            to_x: Is added to. *Shape:* ``(B, V, 3)``.
            to_reference: Is added to.
            others: In the diagonal and in the factors.
            to_normal: In the volume's gradient beyond that. *Shape:* ``(B, V, 3)``.
            to_energy: In the energy. *Shape:* ``(B,)``.
        """
        to_moment = (to_gradient * at.normal).sum((1, 2))
        to_energy = torch.zeros_like(to_moment) if to_energy is None else to_energy
        to_volume = to.stiffness * to_moment + to_energy * at.moment
        own = at.moment[:, None, None] * to_gradient
        to_normal = own if to_normal is None else own.add_(to_normal)
        if not self.closed:  # the adjoint of _through_centre()
            to_normal = to_normal - self.mean(to_normal)[:, None]
        centre = self.centre(x)
        to_centre = None if centre is None else torch.zeros_like(centre)
        to_totals = torch.stack([to_energy, to_volume], 1)
        given = [self.constants, x, to.elements, centre, to_totals, to_gradient, to_normal.contiguous(), *others]
        dim = len(x), max(self.n_edges, self.n_faces)
        launch(kernels("shell_adjoint").linearise, dim, [*given, to_x, to_reference.elements, to_centre])
        self.spread(to_centre, to_x)
        off = at.moment * inverse(to.stiffness, to.stiffness <= 0)
        to_reference.stiffness.add_(to_moment * off + 0.5 * to_energy * off**2)
        to_reference.volume.sub_(to_volume)


def _turned(angle: Tensor, cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine after a rotation by an angle."""
    c, s = angle.cos(), angle.sin()
    return c * cosine - s * sine, s * cosine + c * sine


class _Merged:
    """Rest shapes, weights, and the stiffnesses of edges and hinges as a reference.

    The results are the elements of a :class:`ShellReference`; of each rest shape the volume, and the size that it is
    measured by, *shape* ``(B, K)``; and what remains of the energy of the edges, *shape* ``(B,)``.
    """

    n_results, n_differentiable = 4, 3

    def __init__(self, shell: WarpShell) -> None:
        self.shell = shell

    def run(self, kept: list[Any] | None, shapes: Tensor, weights: Tensor, *stiffness: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        shell, module, dim = self.shell, kernels("shell"), (len(shapes), self.shell.n_edges)
        flat, measured = shapes.flatten(0, 1), shapes.new_zeros(*shapes.shape[:2], 3)
        given = [shell.constants, flat, shell.centre(flat), measured]
        launch(module.sizes, (len(flat), max(shell.n_edges, shell.n_faces)), given)
        # All edges together, volume and area of each rest shape.
        lengths, volumes, areas = measured.unbind(-1)
        elements, constant = shapes.new_empty(*dim, 7), shapes.new_zeros(len(shapes))
        launch(module.merge, dim, [*self._rest(shapes, weights, lengths, *stiffness), elements, constant])
        if kept is not None:
            kept += [measured, elements.detach()]
        return elements, volumes.clone(), torch.maximum(volumes.abs(), MIN_RELATIVE_VOLUME * areas**1.5), constant

    def _rest(self, shapes: Tensor, weights: Tensor, lengths: Tensor, *stiffness: Tensor) -> list[Any]:
        shortest = MIN_RELATIVE_LENGTH / self.shell.n_edges * lengths
        given = [self.shell.constants, shapes, weights, shortest.contiguous(), *stiffness, shapes.shape[1]]
        return [*given, *(each.shape[-1] for each in stiffness)]

    def back(self, kept: list[Any], grads: Sequence[Tensor], *given: Tensor) -> tuple[Tensor | None, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        (shapes, weights, *stiffness), (to_elements, to_volumes, to_sizes, _) = given, grads
        if not kept:
            self.run(kept, *given)
        (measured, elements), shell = kept, self.shell
        lengths, volumes, areas = measured.unbind(-1)
        found = to_shapes, to_weights, *to_stiffness = [torch.zeros_like(each) for each in given]
        rest = [*self._rest(shapes, weights, lengths, *stiffness), elements, to_elements]
        merged = [*rest, to_shapes, to_weights, *to_stiffness]
        launch(kernels("shell_adjoint").merge, (len(shapes), shell.n_edges), merged)
        least = MIN_RELATIVE_VOLUME * areas**1.5
        to_volumes = to_volumes + torch.where(volumes.abs() > least, volumes.sign() * to_sizes, 0)
        to_areas = torch.where(volumes.abs() > least, 0, 1.5 * MIN_RELATIVE_VOLUME * areas.sqrt() * to_sizes)
        flat, to_flat = shapes.flatten(0, 1), to_shapes.view(-1, *shapes.shape[2:])
        centre = shell.centre(flat)
        to_centre = None if centre is None else torch.zeros_like(centre)
        sizes = [shell.constants, flat, centre, torch.stack([to_volumes, to_areas], -1), to_flat, to_centre]
        launch(kernels("shell_adjoint").sizes, (len(flat), shell.n_faces), sizes)
        shell.spread(to_centre, to_flat)
        return tuple(found)

    def by_torch(self, shapes: Tensor, weights: Tensor, alpha: Tensor, beta: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        rests = [self.shell.energy.rest_of(x) for x in shapes.unbind(1)]
        lengths, angles, volumes = (torch.stack(each, 1) for each in zip(*(x.measures for x in rests), strict=True))
        per_length, bends, hard = (torch.stack(each, 1) for each in zip(*(x.weights for x in rests), strict=True))
        pulls = weights[..., None] * per_length
        whole = pulls.sum(1).clamp_min(0)
        length = (pulls * lengths).sum(1) * inverse(whole, whole <= 0)
        edges = torch.stack([2 * alpha * whole, length], -1)
        constant = torch.where(whole > 0, alpha * (pulls * (lengths - length[:, None]) ** 2).sum(1), 0).sum(-1)
        trigonometric = torch.ones_like(angles), angles.cos(), angles.sin(), (2 * angles).cos(), (2 * angles).sin()
        hinges = ((weights[..., None] * bends)[..., None] * torch.stack(trigonometric, -1)).sum(1)
        hinges = torch.where(hinges[..., :1] > 0, 2 * beta[..., None] * hinges, 0)
        return self.shell._joined(edges, hinges), volumes.squeeze(-1), hard.squeeze(-1).rsqrt(), constant


class _Softened:
    """The elements of references, softened at the needles of shapes, or at those that rest shapes do not have.

    *Shape:* ``(B, V, 3), (B, E, 7)``, and ``(B, K, V, 3), (B, K)``.
    """

    n_results = n_differentiable = 1

    def __init__(self, shell: WarpShell) -> None:
        self.shell = shell

    def run(self, kept: list[Any] | None, start: Tensor, elements: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        found, dim = torch.empty_like(elements), (len(start), self.shell.n_edges)
        launch(kernels("modal").soften, dim, [*self._given(start, elements, *rest), found])
        return (found,)

    def back(self, kept: list[Any], grads: Sequence[Tensor], *given: Tensor) -> tuple[Tensor | None, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        found, dim = tuple(map(torch.zeros_like, given)), (len(given[0]), self.shell.n_edges)
        rest = found[2:] or (None, None)
        launch(kernels("shell_adjoint").soften, dim, [*self._given(*given), grads[0], *found[:2], *rest])
        return found

    def by_torch(self, start: Tensor, elements: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        edges, hinges = elements.split([2, 5], -1)
        rows = torch.cat([start[:, None], *rest[:1]], 1).movedim(-1, 0)
        factor = softening(self.shell.energy.parts[1].edge_vectors(rows), *rest[1:])
        factors = torch.ones_like(hinges[..., 0]).index_copy(1, self.shell.interior, factor)
        return (torch.cat([edges, factors[..., None] * hinges], -1),)

    def _given(self, start: Tensor, elements: Tensor, *rest: Tensor) -> list[Any]:
        shapes, weights = rest or (None, None)
        return [self.shell.constants, start, elements, shapes, weights, 0 if shapes is None else shapes.shape[1]]
