"""The contact energy of many shapes, its derivatives, and Newton steps of all vertices with it."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.backends.torch.alignment import Pair
from torch_modal.backends.torch.fine_steps import FurtherDerivatives, FurtherEnergy
from torch_modal.contact.search import Contacts
from torch_modal.energy.contact import Contact
from torch_modal.geometry.vectors import pick
from torch_modal.inbetween.between import Between
from torch_modal.inbetween.samples import Samples


class ActiveContacts:
    """The contact term of the active contacts: pairs of a shape and an element.

    Args:
        active: Of all shapes.
        like: The shapes, whose dtype it has. *Shape:* ``(T, V, 3)``.
    """

    def __init__(self, active: Contacts, like: Tensor) -> None:
        n = like.shape[1]
        #: The shape of each, and which element it is. *Shape:* ``(N,)``.
        self.shapes, which = torch.nonzero(active.weights > 0, as_tuple=True)
        #: The vertices of each, in rows of all shapes. *Shape:* ``(4, N)``.
        self.corners = (active.elements[which] + (self.shapes * n)[:, None]).T.contiguous()
        self.weights, self.gaps = (own[self.shapes, which].to(like) for own in (active.weights, active.gaps))
        self.term, self.n_shapes = Contact(active.elements), len(active.weights)

    def _missing(self, flat: Tensor) -> tuple[Tensor, Tensor]:
        first, *others = (pick(flat, corner) for corner in self.corners)
        edge_vectors = torch.stack([other - first for other in others])
        return edge_vectors, self.term.difference(self.term.measures(edge_vectors), self.gaps)

    def value(self, x: Tensor) -> Tensor:
        """Of each shape. *Shape:* ``(T, V, 3) -> (T,)``."""
        return self._summed(self.weights * self._missing(_flat(x))[1] ** 2)

    def at(self, x: Tensor) -> FurtherDerivatives:
        """Of the vertices that are too near. *Shape:* ``(T, V, 3)``."""
        edge_vectors, missing = self._missing(_flat(x))
        near = torch.nonzero(missing).flatten()
        corners, gradients = self.corners[:, near].flatten(), self.term.gradients(edge_vectors[..., near])
        on_corners = torch.cat([-gradients.sum(0), *gradients], -1)
        stiffness = 2 * self.weights[near].repeat(4)
        gradient, diagonal = torch.zeros_like(x), x.new_zeros(*x.shape[:-1], 6)
        _flat(gradient).index_add_(1, corners, stiffness * missing[near].repeat(4) * on_corners)
        blocks = (stiffness * on_corners)[:, None] * on_corners
        _flat(diagonal).index_add_(1, corners, blocks.flatten(0, 1)[[0, 1, 2, 4, 5, 8]])

        def product(field: Tensor) -> Tensor:
            rate = (pick(_flat(field), corners) * on_corners).sum(0).unflatten(0, (4, -1)).sum(0)
            out = torch.zeros_like(x)
            _flat(out).index_add_(1, corners, stiffness * rate.repeat(4) * on_corners)
            return out

        return FurtherDerivatives(self._summed(self.weights * missing**2), gradient, diagonal, product)

    def _summed(self, each: Tensor) -> Tensor:
        """*Shape:* ``(N,) -> (T,)``."""
        return each.new_zeros(self.n_shapes).index_add(0, self.shapes, each)


class Pull(NamedTuple):
    """A term that pulls vertices to places."""

    to: Tensor
    """The places. *Shape:* ``(T, V, 3)``."""
    weights: Tensor
    """Of the squared distances. *Shape:* ``(V,)``."""

    def rows(self, some: slice, like: Tensor) -> "Pull":
        """Of some shapes, in the dtype of a tensor."""
        return Pull(self.to[some].to(like), self.weights.to(like))

    def value(self, x: Tensor) -> Tensor:
        """Of each shape. *Shape:* ``(T, V, 3) -> (T,)``."""
        return (self.weights * ((x - self.to) ** 2).sum(-1)).sum(-1)

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(T, V, 3)``."""
        twice = 2 * self.weights[:, None]
        diagonal = (twice * twice.new_tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])).expand(len(x), -1, -1)
        return FurtherDerivatives(self.value(x), twice * (x - self.to), diagonal, lambda field: twice * field)


@torch.no_grad()
def settled(
    member: Between, samples: Samples, pair: Pair, x: Tensor, active: Contacts, pull: Pull, n_products: int
) -> Tensor:
    """A Newton step of all vertices of each shape, with its active contacts, never uphill.

    Args:
        member: In-betweens of the pair of key-frames.
        samples: Of that pair, with the times of the shapes.
        pair: The key-frames in the frame.
        x: Where to start. *Shape:* ``(T, V, 3)``.
        active: Of all shapes.
        pull: What pulls them elsewhere.
        n_products: Iterations of conjugate gradients.
    """
    anchors = member.anchors(trees.picked(pair, samples.which), samples.t)

    def beside(own: slice, like: Tensor) -> list[FurtherEnergy]:
        return [ActiveContacts(active.rows(own), like), pull.rows(own, like)]

    return member.fine.relax(x, member.rests(samples, pair, anchors), [(1, n_products)], beside)


def _flat(x: Tensor) -> Tensor:
    """Components first, in place. *Shape:* ``(T, V, c) -> (c, T V)``."""
    return x.view(-1, x.shape[-1]).T
