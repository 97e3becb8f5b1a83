"""Packed batches of shapes of different sizes, in the layout of PyTorch3D.

For PyTorch Geometric see :mod:`torch_modal.data.pyg`.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal.data.augmentation import ShapeAugmentation
from torch_modal.data.sequential import AugmentationSequential
from torch_modal.data.space import ShapeSpace


def augment_packed(
    augmentation: ShapeAugmentation | AugmentationSequential,
    verts_packed: Tensor,
    num_verts_per_mesh: Tensor | Sequence[int],
    spaces: ShapeSpace | Sequence[ShapeSpace],
) -> Tensor:
    """Transform shapes that are packed one after the other, as PyTorch3D's ``Meshes`` gives them.

    Shapes of the same space are transformed as one batch, and are each other's partners. Faces stay as they are.

    Args:
        augmentation: The transform, of shapes alone.
        verts_packed: Vertices of all shapes. *Shape:* ``(N, 3)``.
        num_verts_per_mesh: How many each has. *Shape:* ``(B,)``.
        spaces: One for all, or one for each shape.

    Returns:
        *Shape:* ``(N, 3)``; ``meshes.update_padded`` or ``Meshes(out.split(counts), faces)`` puts them back.

    Raises:
        ValueError: The numbers of vertices or spaces do not fit.
    """
    counts = torch.as_tensor(num_verts_per_mesh).tolist()
    each = [spaces] * len(counts) if isinstance(spaces, ShapeSpace) else list(spaces)
    if verts_packed.dim() != 2 or verts_packed.shape[1] != 3 or sum(counts) != len(verts_packed):
        raise ValueError(
            f"verts_packed have the shape {tuple(verts_packed.shape)}; {sum(counts)} vertices in {len(counts)} meshes "
            f"need ({sum(counts)}, 3)"
        )
    if len(each) != len(counts):
        raise ValueError(f"{len(counts)} meshes need as many spaces, or one for all; got {len(each)}")
    parts = list(verts_packed.split(counts))
    groups: dict[int, list[int]] = {}
    for place, space in enumerate(each):
        groups.setdefault(id(space), []).append(place)
    for places in groups.values():
        space = each[places[0]]
        if any(len(parts[place]) != space.n_vertices for place in places):
            raise ValueError(
                f"meshes of {[len(parts[place]) for place in places]} vertices do not belong to a space of "
                f"{space.n_vertices}"
            )
        out = augmentation(torch.stack([parts[place] for place in places]), space=space)
        for place, shape in zip(places, out, strict=True):
            parts[place] = shape
    return torch.cat(parts)


def collate_packed(samples: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Samples of :class:`torch_modal.ShapeDataset`, of any sizes, as one packed batch: for a loader's ``collate_fn``.

    Args:
        samples: Made with ``faces=True``.

    Returns:
        ``verts_packed`` (N, 3), ``faces_packed`` (M, 3) with indices into them, ``num_verts_per_mesh`` and
        ``num_faces_per_mesh`` (B,), ``mesh_to_verts_packed_first_idx`` (B,); data of vertices is packed
        too, and all else is stacked.
    """
    counts = torch.tensor([len(sample["vertices"]) for sample in samples])
    first = counts.cumsum(0) - counts
    batch: dict[str, Any] = {
        "verts_packed": torch.cat([sample["vertices"] for sample in samples]),
        "faces_packed": torch.cat(
            [sample["faces"] + offset for sample, offset in zip(samples, first.tolist(), strict=True)]
        ),
        "num_verts_per_mesh": counts,
        "num_faces_per_mesh": torch.tensor([len(sample["faces"]) for sample in samples]),
        "mesh_to_verts_packed_first_idx": first,
    }
    for name in samples[0].keys() - {"vertices", "faces"}:
        values = [torch.as_tensor(sample[name]) for sample in samples]
        batch[name] = torch.cat(values) if name in ("normals", "vertex_labels") else torch.stack(values)
    return batch
