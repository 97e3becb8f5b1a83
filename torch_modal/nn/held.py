"""What is held apart in many shapes: its energy and derivatives, and steps of all vertices with it."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.energy.contact import Contact
from torch_modal.energy.energy import Reference
from torch_modal.energy.position import Position
from torch_modal.geometry.vectors import pick
from torch_modal.nn import trees
from torch_modal.nn.between import Between, fine_chunk
from torch_modal.nn.contact import Contacts
from torch_modal.nn.frame import Pair
from torch_modal.nn.fused_relax import FusedRelax
from torch_modal.nn.fused_shell import ShellReference
from torch_modal.nn.relax import STEP_LENGTHS, relax
from torch_modal.nn.samples import Samples


class AtHeld(NamedTuple):
    """The contact term at given shapes, of the vertices that are too near."""

    value: Tensor
    """Of each shape. *Shape:* ``(T,)``."""
    gradient: Tensor
    """*Shape:* ``(3, 4 N)``."""
    on_corners: Tensor
    """Of the distances in the vertices. *Shape:* ``(3, 4 N)``."""
    stiffness: Tensor
    """*Shape:* ``(N,)``."""
    corners: Tensor
    """Their places in the rows of all shapes. *Shape:* ``(4 N,)``."""

    @property
    def blocks(self) -> Tensor:
        """Of the Hessian's diagonal. *Shape:* ``(3, 3, 4 N)``."""
        return (self.stiffness.repeat(4) * self.on_corners)[:, None] * self.on_corners

    def product(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """The Hessian times displacements, at the corners, and its form. *Shape:* ``(3, T V) -> (3, 4 N), (N,)``."""
        rate = (pick(field, self.corners) * self.on_corners).sum(0).unflatten(0, (4, -1)).sum(0)
        return (self.stiffness * rate).repeat(4) * self.on_corners, self.stiffness * rate**2


class Held:
    """The contact term where each vertex is held: pairs of a shape and an element, without the rest.

    Args:
        held: Of all shapes.
        n: How many vertices a shape has, V.
    """

    def __init__(self, held: Contacts, n: int) -> None:
        #: The shape of each, and which element it is. *Shape:* ``(N,)``.
        self.shapes, which = torch.nonzero(held.weights > 0, as_tuple=True)
        #: The vertices of each, in rows of all shapes. *Shape:* ``(4, N)``.
        self.corners = (held.elements[which] + (self.shapes * n)[:, None]).T.contiguous()
        self.weights, self.gaps = held.weights[self.shapes, which], held.gaps[self.shapes, which]
        self.term, self.n_shapes = Contact(held.elements), len(held.weights)

    def _missing(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        first, *others = (pick(flat, corner) for corner in self.corners)
        spokes = torch.stack([other - first for other in others])
        return spokes, self.term.difference(self.term.measures(spokes), self.gaps)

    def value(self, flat: Tensor) -> Tensor:
        """Of each shape. *Shape:* ``(3, T V) -> (T,)``."""
        each = self.weights * self._missing(flat)[1] ** 2
        return each.new_zeros(self.n_shapes).index_add(0, self.shapes, each)

    def linearised(self, flat: Tensor) -> AtHeld:
        """*Shape:* ``(3, T V)``."""
        spokes, missing = self._missing(flat)
        near = torch.nonzero(missing).flatten()
        each = self.weights * missing**2
        value = each.new_zeros(self.n_shapes).index_add(0, self.shapes, each)
        gradients = self.term.gradients(spokes[..., near])
        on_corners = torch.cat([-gradients.sum(0), *gradients], -1)
        stiffness = 2 * self.weights[near]
        gradient = (stiffness * missing[near]).repeat(4) * on_corners
        return AtHeld(value, gradient, on_corners, stiffness, self.corners[:, near].flatten())


class Pull(NamedTuple):
    """A term that pulls vertices to places."""

    to: Tensor
    """The places. *Shape:* ``(T, V, 3)``."""
    weights: Tensor
    """Of the squared distances. *Shape:* ``(V,)``."""

    def rows(self, some: slice) -> "Pull":
        """Of some shapes."""
        return self._replace(to=self.to[some])

    def joined(self, reference: Reference) -> Reference:
        """A reference with that of :class:`~torch_modal.energy.position.Position`, which comes last."""
        places = self.to.mT.flatten(1)[:, None]
        weights = self.weights.repeat(3).expand_as(places)
        return Reference((*reference.measures, places), (*reference.weights, weights), reference.constant)

    def value(self, x: Tensor) -> Tensor:
        """Of each shape. *Shape:* ``(T, V, 3) -> (T,)``."""
        return (self.weights * ((x - self.to) ** 2).sum(-1)).sum(-1)

    def product(self, field: Tensor) -> Tensor:
        """The Hessian times displacements. *Shape:* ``(T, V, 3) -> (T, V, 3)``."""
        return 2 * self.weights[:, None] * field


@torch.no_grad()
def settled(
    member: Between, samples: Samples, pair: Pair, x: Tensor, held: Contacts, pull: Pull, n_products: int
) -> Tensor:
    """A Newton step of all vertices of each shape, with what is held in it, never uphill.

    Args:
        member: In-betweens of the pair of key-frames.
        samples: Of that pair, with the times of the shapes.
        pair: The key-frames in the frame.
        x: Where to start. *Shape:* ``(T, V, 3)``.
        held: Of all shapes.
        pull: What pulls them elsewhere.
        n_products: Iterations of conjugate gradients.
    """
    if member.fused is None:
        return _by_torch(member, samples, pair, x, held, pull, n_products)
    return _by_kernels(member, member.fused, samples, pair, x, held, pull, n_products)


def _by_torch(
    member: Between, samples: Samples, pair: Pair, x: Tensor, held: Contacts, pull: Pull, n_products: int
) -> Tensor:
    energy = held.fine(member.mesh, [*member.terms, Position(member.mesh.n_vertices)])
    fixed, origin = member.anchors(trees.picked(pair, samples.which), samples.t), x.new_zeros(len(x), 1, 3)
    fixed = origin if fixed is None else torch.cat([fixed, origin], 1)
    reference = member.fine_reference(samples, pair)
    size, parts = fine_chunk(x.shape[1], x.device), []
    for i in range(0, len(x), size):
        own = slice(i, i + size)
        rest, anchors = trees.rows((reference, fixed), own)
        rest = held.rows(own).joined(pull.rows(own).joined(rest))
        parts.append(relax(energy, x[own], rest, 1, n_products, anchors))
    return torch.cat(parts)


def _by_kernels(
    member: Between,
    fused: FusedRelax,
    samples: Samples,
    pair: Pair,
    x: Tensor,
    held: Contacts,
    pull: Pull,
    n_products: int,
) -> Tensor:
    first, second = trees.picked((pair.first, pair.second), samples.which)
    if pair.around is not None:
        first = second = member.space.on_course(pair, samples.which, samples.t)[0]
    given = [value.double() for value in (first, second, samples.t, *samples.stiffness)]
    moving, pull = x.double(), Pull(pull.to.double(), pull.weights.double())
    size, n = fine_chunk(x.shape[1], x.device), x.shape[1]
    parts = []
    for i in range(0, len(x), size):
        own = slice(i, i + size)
        to = fused.reference(*(value[own].contiguous() for value in given))
        held_here = Held(held.rows(own), n)
        parts.append(_step(fused, moving[own].contiguous(), to, held_here, pull.rows(own), n_products))
    return torch.cat(parts).to(x)


def _step(fused: FusedRelax, x: Tensor, to: ShellReference, held: Held, pull: Pull, n_products: int) -> Tensor:
    def value(x: Tensor) -> Tensor:
        return fused.value(x, to) + held.value(_flat(x)) + pull.value(x)

    at, own = fused.at(x, to), held.linearised(_flat(x))
    before = at.energy + own.value + pull.value(x)
    at.gradient.add_(pull.product(x - pull.to))
    at.diagonal[..., [0, 3, 5]] += 2 * pull.weights[:, None]
    _flat(at.gradient).index_add_(1, own.corners, own.gradient)
    _flat(at.diagonal).index_add_(1, own.corners, own.blocks.flatten(0, 1)[[0, 1, 2, 4, 5, 8]])

    def beyond(direction: Tensor, product: Tensor, form: Tensor) -> None:
        pushed, forms = own.product(_flat(direction))
        _flat(product).index_add_(1, own.corners, pushed)
        form.index_add_(0, own.corners[: len(forms)] // x.shape[1], forms)
        pulled = pull.product(direction)
        product.add_(pulled)
        form.add_((pulled * direction).sum((1, 2)))

    step = fused.solved(x, at, to, n_products, beyond=beyond)
    length = torch.zeros_like(before)
    for shorter in STEP_LENGTHS:
        downhill = (length == 0) & (value(x + shorter * step.solution) < before)
        length = torch.where(downhill, shorter, length)
        if bool((length > 0).all()):
            break
    return x + length[:, None, None] * step.solution


def _flat(x: Tensor) -> Tensor:
    """Components first, in place. *Shape:* ``(T, V, c) -> (c, T V)``."""
    return x.view(-1, x.shape[-1]).T
