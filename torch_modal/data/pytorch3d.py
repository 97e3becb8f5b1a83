"""PyTorch3D's ``Meshes`` in and out, without importing PyTorch3D.

Uses ``verts_padded``, ``faces_padded``, ``verts_packed``, ``num_verts_per_mesh``, ``num_faces_per_mesh``,
``offset_verts``, ``extend``, ``update_padded`` and indexing of a ``Meshes``. Textures stay.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal.data.augmentation import ShapeAugmentation
from torch_modal.data.packed import augment_packed
from torch_modal.data.sequential import AugmentationSequential
from torch_modal.data.space import ShapeSpace
from torch_modal.keyframes.check import Keyframes


def keyframes_of(meshes: Any) -> Keyframes:
    """The key-frames that a ``Meshes`` holds, one a mesh.

    Args:
        meshes: All with the same vertices and faces.

    Returns:
        Positions, *shape* ``(K, V, 3)``, with dtype, device and graph; faces, *shape* ``(F, 3)``.

    Raises:
        ValueError: The meshes differ in their numbers of vertices or in their faces.
    """
    for what, counts in (("vertices", meshes.num_verts_per_mesh()), ("faces", meshes.num_faces_per_mesh())):
        if len(set(counts.tolist())) != 1:
            raise ValueError(f"key-frames have the same faces; these meshes have {counts.tolist()} {what}")
    faces = meshes.faces_padded()
    other = (faces != faces[:1]).flatten(1).any(1)
    if other.any():
        raise ValueError(f"key-frames have the same faces; mesh {int(other.nonzero()[0])} has others than mesh 0")
    return Keyframes(meshes.verts_padded(), faces[0])


def as_meshes(shapes: Tensor, like: Any) -> Any:
    """Shapes as a ``Meshes``, with the faces and textures of another.

    Args:
        shapes: Of one connectivity, a result of :func:`torch_modal.subdivide` or of a layer. *Shape:* ``(N, V, 3)``.
        like: A ``Meshes``; its first mesh gives faces and textures.

    Raises:
        ValueError: The numbers of vertices differ.
    """
    n_vertices = int(like.num_verts_per_mesh()[0])
    if shapes.dim() != 3 or shapes.shape[1:] != (n_vertices, 3):
        raise ValueError(f"shapes like these meshes have the shape (N, {n_vertices}, 3); got {tuple(shapes.shape)}")
    return like[0].extend(len(shapes)).update_padded(shapes)


def augment_meshes(
    augmentation: ShapeAugmentation | AugmentationSequential,
    meshes: Any,
    spaces: ShapeSpace | Sequence[ShapeSpace],
) -> Any:
    """Transform a ``Meshes``; see :func:`torch_modal.augment_packed`.

    Args:
        augmentation: The transform, of shapes alone.
        meshes: Of any sizes.
        spaces: One for all, or one for each mesh.

    Returns:
        A new ``Meshes``, with the same faces and textures. Positions are right to the last bit but one, since PyTorch3D
        takes offsets.
    """
    packed = meshes.verts_packed()
    moved = augment_packed(augmentation, packed, meshes.num_verts_per_mesh(), spaces)
    return meshes.offset_verts(torch.sub(moved, packed))
