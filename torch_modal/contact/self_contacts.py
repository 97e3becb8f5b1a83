"""Public detection of self-intersections."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
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
    """Whether the pair intersects in none of the ignored shapes. *Shape:* ``(P,)``."""
    far: Tensor
    """Whether two separate parts intersect: the pair is new, at least two rings of faces from the intersections of
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

    def of(self, i: int) -> Tensor:
        """Pairs of one shape. *Shape:* ``(n, 2)``."""
        return self.pairs[self.shape == i]


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
    given = as_positions(x)
    corners = as_faces(faces)
    shapes = _shapes("x", given, None)
    known = np.zeros((0, *shapes.shape[1:])) if ignore is None else _shapes("ignore", as_positions(ignore), shapes)
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners):
        raise MeshError(f"faces have shape {corners.shape}; (F, 3) is needed, one face or more")
    if corners.min() < 0 or corners.max() >= shapes.shape[1]:
        raise MeshError(
            f"faces use vertices from {corners.min()} to {corners.max()}, but the shapes have {shapes.shape[1]}, "
            "counted from 0"
        )
    mesh = Connectivity(corners, shapes.shape[1])
    found, depths = [], []
    crossings = None
    for shape in shapes:
        if crossings is None or not len(known):
            crossings = Crossings(mesh, known, known[0] if len(known) else shape)
            search = Search(crossings)
        if not crossings.diagonal > 0:
            raise MeshError("all vertices of a shape lie at one place: it has no size")
        pairs = crossings.pairs(shape)
        far = crossings.is_far(pairs)
        found.append((pairs, crossings.is_new(pairs), far))
        depths.append(search.depth(shape, pairs[far]))
    lead, device = given.shape[:-2], given.device

    def tensor(parts: list[Any], like: tuple[int, ...]) -> Tensor:
        whole = np.concatenate([np.zeros(like, parts[0].dtype if parts else np.int64), *parts])
        return torch.from_numpy(whole).to(device)

    def counted(parts: list[Any]) -> Tensor:
        return torch.tensor([int(part.sum()) for part in parts], dtype=torch.int64, device=device).reshape(lead)

    every, new, far_ones = zip(*found, strict=True) if found else ([], [], [])
    depth = torch.from_numpy(np.stack(depths) if depths else np.zeros(shapes.shape[:2]))
    return SelfContacts(
        tensor([np.full(len(pairs), i) for i, pairs in enumerate(every)], (0,)).long(),
        tensor(list(every), (0, 2)).long(),
        tensor(list(new), (0,)).bool(),
        tensor(list(far_ones), (0,)).bool(),
        depth.to(device, given.dtype).reshape(given.shape[:-1]),
        counted([np.ones(len(pairs)) for pairs in every]),
        counted(list(new)),
        counted(list(far_ones)),
    )


def _shapes(name: str, given: Tensor, like: FloatArray | None) -> FloatArray:
    if given.dim() < 2 or given.shape[-1] != 3:
        raise MeshError(f"{name} has the shape {tuple(given.shape)}; (..., V, 3) is needed")
    array: FloatArray = given.detach().cpu().double().resolve_neg().numpy().reshape(-1, *given.shape[-2:])
    if like is not None and array.shape[1:] != like.shape[1:]:
        raise MeshError(f"{name} has {array.shape[1]} vertices, the shapes have {like.shape[1]}; they must be equal")
    if not np.isfinite(array).all():
        i, v = np.argwhere(~np.isfinite(array).all(-1))[0]
        raise MeshError(f"{name} has positions that are NaN or infinite; the first is vertex {v} of shape {i}")
    return array
