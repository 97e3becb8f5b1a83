"""Public detection of self-intersections."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.contact.detect import Search
from torch_modal.errors import MeshError
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import Crossings, require_contact
from torch_modal.keyframes.arrays import as_faces, as_positions


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


def self_contacts(x: Any, faces: Any, ignore: Any = None) -> SelfContacts:
    """Find self-intersections of shapes.

    Two triangles without a common vertex intersect if their interiors do (broad phase of ``ipctk``, exact predicates of
    ``libigl``); touching and coplanar triangles do not. Depths come from winding numbers (``libigl``).
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
    corners = as_faces(faces)
    shapes = _shapes("x", positions, None)
    known = np.zeros((0, *shapes.shape[1:])) if ignore is None else _shapes("ignore", as_positions(ignore), shapes)
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners):
        raise MeshError(f"faces have shape {corners.shape}; (F, 3) is needed, one face or more")
    if corners.min() < 0 or corners.max() >= shapes.shape[1]:
        raise MeshError(
            f"faces use vertices from {corners.min()} to {corners.max()}, but the shapes have {shapes.shape[1]}, "
            "counted from 0"
        )
    mesh = Connectivity(corners, shapes.shape[1])
    n = len(shapes)
    pairs, new, far = [np.zeros((0, 2), np.int64)], [np.zeros(0, bool)], [np.zeros(0, bool)]
    depth, crossings = np.zeros(shapes.shape[:2]), None
    for i, shape in enumerate(shapes):
        if crossings is None or not len(known):
            crossings = Crossings(mesh, known, known[0] if len(known) else shape)
            search = Search(crossings)
        if not crossings.diagonal > 0:
            raise MeshError("all vertices of a shape lie at one place: it has no size")
        pairs.append(crossings.pairs(shape))
        new.append(crossings.is_new(pairs[-1]))
        far.append(crossings.is_far(pairs[-1]))
        depth[i] = search.depth(shape, pairs[-1][far[-1]])
    lead, device = positions.shape[:-2], positions.device
    of_shape = np.repeat(np.arange(n), [len(shape_pairs) for shape_pairs in pairs[1:]])
    every, are_new, are_far = (np.concatenate(parts) for parts in (pairs, new, far))

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(device)

    def count_by_shape(which: slice | BoolArray) -> Tensor:
        return tensor(np.bincount(of_shape[which], minlength=n)).reshape(lead)

    return SelfContacts(
        shape=tensor(of_shape),
        pairs=tensor(every),
        new=tensor(are_new),
        far=tensor(are_far),
        depth=tensor(depth).to(positions.dtype).reshape(positions.shape[:-1]),
        number=count_by_shape(slice(None)),
        n_new=count_by_shape(are_new),
        n_far=count_by_shape(are_far),
    )


def _shapes(name: str, x: Tensor, like: FloatArray | None) -> FloatArray:
    if x.dim() < 2 or x.shape[-1] != 3:
        raise MeshError(f"{name} has the shape {tuple(x.shape)}; (..., V, 3) is needed")
    array: FloatArray = x.detach().cpu().double().resolve_neg().numpy().reshape(-1, *x.shape[-2:])
    if like is not None and array.shape[1:] != like.shape[1:]:
        raise MeshError(f"{name} has {array.shape[1]} vertices, the shapes have {like.shape[1]}; they must be equal")
    if not np.isfinite(array).all():
        i, v = np.argwhere(~np.isfinite(array).all(-1))[0]
        raise MeshError(f"{name} has positions that are NaN or infinite; the first is vertex {v} of shape {i}")
    return array
