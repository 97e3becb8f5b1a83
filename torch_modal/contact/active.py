r"""Active contacts of one shape or more: their search and their energy.

With the height :math:`g` of a vertex over the plane of a face, the energy of the active contacts is
:math:`\sum_m k A_m \min(g_m - \bar g, 0)^2`, with the area ``A`` around the vertex and the gap :math:`\bar g`. It is
zero, with its first derivative, where the gap is kept.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.autograd import is_transformed
from torch_modal.contact.detect import Search
from torch_modal.elastic.backend import TorchBackend
from torch_modal.elastic.steps import Point
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.vectors import cross, inverse, norm, pick

GAP = 0.15
"""Distance that is kept, at a diagonal of 100."""
STIFFNESS = 3000.0
"""``k``, at that diagonal; stretching has 500."""


def refuse_transforms(x: Tensor) -> None:
    """Raise for shapes within transforms of ``torch.func``, or with tangents: the search is not torch's."""
    if is_transformed(x):
        raise RuntimeError(
            "shapes with contact have no forward mode, and no transforms of torch.func: take torch.autograd.grad, or "
            "contact=False"
        )


class Contacts(NamedTuple):
    """Active contacts of T shapes: pairs of a vertex and a face."""

    shapes: Tensor
    """The shape of each. *Shape:* ``(N,)``."""
    elements: Tensor
    """The corners of the face, then the vertex. *Shape:* ``(N, 4)``."""

    def rows(self, some: Tensor) -> "Contacts":
        """Contacts of some shapes, counted anew. *Shape:* ``(S,)``."""
        at, place = torch.nonzero(self.shapes[:, None] == some, as_tuple=True)
        return Contacts(place, self.elements[at])

    def with_former(self, former: "Contacts") -> "Contacts":
        """Add the former contacts of vertices that have none now: without them, what was pushed out falls back."""
        n = 1 + max(int(each.elements.max()) if len(each.elements) else 0 for each in (self, former))
        present, before = (each.shapes * n + each.elements[:, 3] for each in (self, former))
        kept = ~torch.isin(before, present)
        shapes = torch.cat([self.shapes, former.shapes[kept]])
        return Contacts(shapes, torch.cat([self.elements, former.elements[kept]]))


class ContactSearch:
    """Search for active contacts of T shapes between the same known shapes.

    Vertices next to an intersection are watched in all later searches.

    Args:
        backend: Finds the pairs of triangles that cross.
        mesh: Their connectivity.
        known: Shapes whose own intersections stay as they are, in the frame. *Shape:* ``(K, V, 3)``.
        like: The shape whose lengths and areas count. *Shape:* ``(V, 3)``.
        n_shapes: T.
    """

    def __init__(self, backend: TorchBackend, mesh: Connectivity, known: Tensor, like: Tensor, n_shapes: int) -> None:
        reference = _numbers(like)
        self.search = Search(mesh, _numbers(known), reference, backend.crossings(mesh, reference))
        #: Areas of the vertices, constants of the gradient. *Shape:* ``(V,)``.
        self.areas = torch.from_numpy(vertex_areas(reference, mesh.faces)).to(known)
        self.watched = np.zeros((n_shapes, known.shape[1]), dtype=bool)

    def __call__(self, x: Tensor, some: Tensor) -> tuple[Contacts, Tensor]:
        """Contacts of some of the shapes, and their numbers of far pairs. *Shape:* ``(T, V, 3), (S,) -> (S,)``."""
        columns, n_far = [np.zeros((5, 0), dtype=np.int64)], []
        for i in some.tolist():
            vertices, faces, n = self.search(_numbers(x[i]), self.watched[i])
            columns.append(np.stack([np.full(len(faces), i), *self.search.mesh.faces[faces].T, vertices]))
            n_far.append(n)
        shapes, *elements = torch.from_numpy(np.concatenate(columns, 1)).to(x.device)
        return Contacts(shapes, torch.stack(elements, 1)), torch.tensor(n_far, dtype=torch.int64, device=x.device)

    def count(self, x: Tensor) -> Tensor:
        """Numbers of far pairs of triangles. *Shape:* ``(S, V, 3) -> (S,)``, int64."""
        return torch.tensor([len(self.search.far_pairs(y)) for y in _numbers(x)], dtype=torch.int64, device=x.device)

    def depth(self, x: Tensor) -> float:
        """Depth of the deepest contact of a shape, with the gap. *Shape:* ``(V, 3)``."""
        shape = _numbers(x)
        pairs = self.search.far_pairs(shape)
        return GAP + max(float(self.search.depth(shape, pairs).max()), self.search.reach(shape, pairs))

    def watch(self, contacts: Contacts, around: int) -> None:
        """Watch the surroundings of contacts, in their shapes and in so many neighbours in time on either side."""
        for i in contacts.shapes.unique().tolist():
            vertices = contacts.elements[contacts.shapes == i].unique().cpu().numpy()
            self.watched[max(0, i - around) : i + around + 1] |= self.search.grow(vertices, 2)


def _numbers(x: Tensor) -> FloatArray:
    return x.detach().double().cpu().numpy()  # type: ignore[no-any-return]


class ContactEnergy:
    """Energy of the active contacts of a batch, from areas of the vertices. *Shape:* ``(V,), (B, V, 3)``."""

    def __init__(self, contacts: Contacts, areas: Tensor, like: Tensor, gap: float = GAP) -> None:
        self.gap, (self.shapes, elements) = gap, contacts
        #: The vertices of each contact, in rows of all shapes. *Shape:* ``(4, N)``.
        self.corners = (elements + (self.shapes * like.shape[1])[:, None]).T.contiguous()
        self.weights = STIFFNESS * areas.to(like)[elements[:, 3]]

    def shortfall(self, x: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Missing distances, at most zero, and gradients of the heights in the corners, of all contacts or of some.

        *Shape:* ``(B, V, 3), (n,) -> (n,), (4, 3, n)``.
        """
        corners = self.corners if near is None else self.corners[:, near]
        first, *others = (pick(_rows(x), corner) for corner in corners)
        side, other, to_vertex = (corner - first for corner in others)
        doubled = cross(side, other)
        length = norm(doubled)
        per_length = inverse(length, length <= 0)
        normal = doubled * per_length
        height = (normal * to_vertex).sum(0)
        within = (to_vertex - height * normal) * per_length
        gradients = torch.stack([cross(other, within), cross(within, side), normal])
        return (height - self.gap).clamp_max(0), torch.cat([-gradients.sum(0)[None], gradients])

    def value(self, x: Tensor, shortfall: Tensor | None = None) -> Tensor:
        """Energy of each shape, from missing distances where they are known. *Shape:* ``(B, V, 3), (N,) -> (B,)``."""
        shortfall = self.shortfall(x)[0] if shortfall is None else shortfall
        return x.new_zeros(len(x)).index_add(0, self.shapes, self.weights * shortfall**2)

    def at(self, x: Tensor) -> Point:
        """Derivatives, of which the contacts that keep the gap have none. *Shape:* ``(B, V, 3)``."""
        shortfall = self.shortfall(x)[0]
        near = torch.nonzero(shortfall).flatten()
        corners, gradients = self.corners[:, near].flatten(), self.shortfall(x, near)[1]
        on_corners = gradients.transpose(0, 1).flatten(1)
        stiffness = 2 * self.weights[near].repeat(4)
        gradient, diagonal = torch.zeros_like(x), x.new_zeros(*x.shape[:-1], 6)
        _rows(gradient).index_add_(1, corners, stiffness * shortfall[near].repeat(4) * on_corners)
        blocks = (stiffness * on_corners)[:, None] * on_corners
        _rows(diagonal).index_add_(1, corners, blocks.flatten(0, 1)[[0, 1, 2, 4, 5, 8]])

        def product(field: Tensor) -> Tensor:
            rate = (pick(_rows(field), corners) * on_corners).sum(0).unflatten(0, (4, -1)).sum(0)
            out = torch.zeros_like(x)
            _rows(out).index_add_(1, corners, stiffness * rate.repeat(4) * on_corners)
            return out

        return Point(self.value(x, shortfall), gradient, diagonal, product)


class Pull(NamedTuple):
    """Springs that pull vertices to places, with weights of the squared distances. *Shape:* ``(B, V, 3), (V,)``."""

    to: Tensor
    weights: Tensor

    def value(self, x: Tensor) -> Tensor:
        """Energy of each shape. *Shape:* ``(B, V, 3) -> (B,)``."""
        return (self.weights * ((x - self.to) ** 2).sum(-1)).sum(-1)

    def at(self, x: Tensor) -> Point:
        """*Shape:* ``(B, V, 3)``."""
        twice = 2 * self.weights[:, None]
        diagonal = (twice * twice.new_tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])).expand(len(x), -1, -1)
        return Point(self.value(x), twice * (x - self.to), diagonal, lambda field: twice * field)


def _rows(x: Tensor) -> Tensor:
    """Components first, in place. *Shape:* ``(B, V, c) -> (c, B V)``."""
    return x.view(-1, x.shape[-1]).T
