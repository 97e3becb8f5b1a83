"""The border of contact: what passes through itself in given shapes."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.errors import MeshError
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.contacts import Search
from torch_modal.geometry.crossings import Crossings, require_contact
from torch_modal.keyframes.arrays import as_faces, as_positions


class SelfContacts(NamedTuple):
    """Pairs of triangles that pass through each other, of all shapes one after the other."""

    shape: Tensor
    """Which shape each pair is of, counted through the leading dimensions. *Shape:* ``(P,)``."""
    pairs: Tensor
    """Numbers of the two faces, the smaller first. *Shape:* ``(P, 2)``."""
    new: Tensor
    """Whether the two cross in none of the shapes that were to be ignored. *Shape:* ``(P,)``."""
    far: Tensor
    """Whether two parts went through each other: new, two rings of faces or more from what crosses in a shape that was
    to be ignored, and more than 6 % of the diagonal apart along the surface. The rest is a crossing that grew, or a
    fold. *Shape:* ``(P,)``."""
    depth: Tensor
    """How deep each vertex lies in a part that it went through, in the unit of the shapes; 0 elsewhere, and where only
    edges cross. *Shape:* ``(..., V)``."""
    number: Tensor
    """Pairs of each shape. *Shape:* ``(...)``."""
    n_new: Tensor
    """Of these the new ones. *Shape:* ``(...)``."""
    n_far: Tensor
    """And of these the far ones. *Shape:* ``(...)``."""

    def of(self, i: int) -> Tensor:
        """The pairs of one shape. *Shape:* ``(n, 2)``."""
        return self.pairs[self.shape == i]


def self_contacts(x: Any, faces: Any, ignore: Any = None) -> SelfContacts:
    """Find where shapes pass through themselves.

    Two triangles without a common vertex cross where their interiors do (broad phase of ``ipctk``, exact predicates of
    ``libigl``). Those that only touch, or lie in one plane, do not. Depths come from winding numbers (``libigl``).
    Nothing is differentiable here.

    Args:
        x: Shapes. *Shape:* ``(..., V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        ignore: Shapes, such as key-frames, whose own crossings are known. *Shape:* ``(K, V, 3)``, or ``(V, 3)``.

    Returns:
        On the device of ``x``.

    Raises:
        MeshError: Arrays that are no shapes of these faces, or not finite.
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
