"""Public detection of self-intersections."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import AnyArray, ArrayLike, BoolArray
from torch_modal.contact.detect import Search
from torch_modal.elastic.backend import choose
from torch_modal.errors import MeshError
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import require_contact
from torch_modal.keyframes.arrays import as_positions
from torch_modal.keyframes.check import check_arrays


class SelfContacts(NamedTuple):
    """Pairs of intersecting triangles of all shapes."""

    shape: Tensor
    """Flat index of the shape of each pair. *Shape:* ``(P,)``."""
    pairs: Tensor
    """Face indices, the smaller first. *Shape:* ``(P, 2)``."""
    new: Tensor
    """True if the pair intersects in none of the ignored shapes. *Shape:* ``(P,)``."""
    far: Tensor
    """True if two separate parts intersect: the pair is new, at least two rings of faces from the intersections of
    ignored shapes, and its geodesic distance exceeds 6 % of the diagonal. Other pairs belong to a known intersection or
    a fold. *Shape:* ``(P,)``."""
    depth: Tensor
    """Penetration depth of each vertex, in the unit of the shapes; 0 elsewhere, and where only edges cross.

    *Shape:* ``(..., V)``."""
    number: Tensor
    """Number of pairs of each shape. *Shape:* ``(...)``."""
    n_new: Tensor
    """Number of new pairs. *Shape:* ``(...)``."""
    n_far: Tensor
    """Number of far pairs. *Shape:* ``(...)``."""


def self_contacts(x: ArrayLike, faces: ArrayLike, ignore: "ArrayLike | None" = None) -> SelfContacts:
    """Find self-intersections of shapes.

    Two triangles without a common vertex intersect if their interiors do, by exact predicates; touching and coplanar
    triangles do not. Depths come from winding numbers (``libigl``).
    Not differentiable.

    Args:
        x: Shapes. *Shape:* ``(..., V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        ignore: Shapes, such as key-frames, whose intersections are ignored. *Shape:* ``(K, V, 3)``, or ``(V, 3)``.

    Returns:
        Tensors on the device of ``x``.

    Raises:
        MeshError: Shapes and faces do not match, or values are not finite.
        MissingPackageError: The extra ``contact`` is not installed.
    """
    require_contact()
    positions = as_positions(x)
    shapes, corners = check_arrays(positions.reshape(-1, *positions.shape[-2:]), faces)[1:]
    known = shapes[:0]
    if ignore is not None:
        ignored = as_positions(ignore)
        if ignored.shape[-2:] != positions.shape[-2:]:
            message = f"ignore has {ignored.shape[-2]} vertices, the shapes have {shapes.shape[1]}; they must be equal"
            raise MeshError(message)
        known = check_arrays(ignored.reshape(-1, *ignored.shape[-2:]), faces)[1]
    mesh, like = Connectivity(corners, shapes.shape[1]), known[0] if len(known) else shapes[0]
    search = Search(mesh, known, like, choose("auto").crossings(mesh, like))
    if not search.diagonal > 0:
        raise MeshError("all vertices of a shape lie at one place: it has no size")
    pairs = [search.pairs(shape) for shape in shapes]
    far = [search.is_far(shape_pairs) for shape_pairs in pairs]
    depth = [search.depth(x, crossing[is_far]) for x, crossing, is_far in zip(shapes, pairs, far, strict=True)]
    lead, device = positions.shape[:-2], positions.device
    of_shape = np.repeat(np.arange(len(shapes)), [len(shape_pairs) for shape_pairs in pairs])
    every, are_far = np.concatenate(pairs), np.concatenate(far)
    are_new = search.is_new(every)

    def tensor(array: AnyArray) -> Tensor:
        return torch.from_numpy(array).to(device)

    def count_by_shape(which: slice | BoolArray) -> Tensor:
        return tensor(np.bincount(of_shape[which], minlength=len(shapes))).reshape(lead)

    return SelfContacts(
        shape=tensor(of_shape),
        pairs=tensor(every),
        new=tensor(are_new),
        far=tensor(are_far),
        depth=tensor(np.stack(depth)).to(positions.dtype).reshape(positions.shape[:-1]),
        number=count_by_shape(slice(None)),
        n_new=count_by_shape(are_new),
        n_far=count_by_shape(are_far),
    )
