"""Random transforms for PyTorch Geometric. Needs ``torch_geometric`` (``pip install torch_modal[pyg]``)."""

from typing import Any

import torch

from torch_modal.data.augmentation import ShapeAugmentation
from torch_modal.data.shape_batch import ShapeBatch, check_shapes
from torch_modal.data.space import ShapeSpace
from torch_modal.extras import require_installed
from torch_modal.geometry.vectors import vertex_normals

require_installed(("torch_geometric",), "pyg", "torch_modal.data.pyg")
from torch_geometric.data import Batch, Data  # noqa: E402
from torch_geometric.transforms import BaseTransform  # noqa: E402


class RandomShape(BaseTransform):
    """A random transform of ``Data(pos, face)``, or of a ``Batch`` of them; compose it with others as usual.

    Partners of in-betweens are the key-frames of the space. ``normal`` is recomputed where a graph has it; all else,
    labels of nodes included, stays, since nodes keep their order. ``y`` changes only if the key-frames' own ``y`` are
    given, as by the transform's ``blend_labels``.

    Args:
        augmentation: The transform, with its space.
        space: Key-frames and modes; by default the augmentation's.
        y: Labels of the key-frames. *Shape:* ``(K, ...)``.

    Raises:
        ValueError: There is no space.
    """

    def __init__(
        self, augmentation: ShapeAugmentation, space: ShapeSpace | None = None, y: torch.Tensor | None = None
    ) -> None:
        found = augmentation.space if space is None else space
        if found is None:
            raise ValueError("RandomShape needs key-frames and modes: pass space=ShapeSpace(bases, faces)")
        self.augmentation, self.space, self.y = augmentation, found, y

    def forward(self, data: Data) -> Data:
        """Transform a graph or a ``Batch`` of graphs, in place (``BaseTransform`` passes a copy).

        Raises:
            ValueError: A graph has not as many nodes as the space has vertices.
        """
        n, n_vertices = data.num_graphs if isinstance(data, Batch) else 1, self.space.n_vertices
        pos: Any = data.pos
        even = not isinstance(data, Batch) or bool((data.ptr.diff() == n_vertices).all())
        if pos is None or pos.shape != (n * n_vertices, 3) or not even:
            got = None if pos is None else tuple(pos.shape)
            raise ValueError(
                f"data.pos of {n} graphs of this space has the shape ({n * n_vertices}, 3), {n_vertices} nodes each; "
                f"got {got}"
            )
        given = rows = None
        if self.y is not None and data.y is not None:
            given = self.y.to(pos.device)
            rows = data.y.reshape(n, *given.shape[1:])  # of a single graph, the row may be missing
        batch = ShapeBatch(pos.unflatten(0, (n, n_vertices)), shape_labels=rows)
        pool = ShapeBatch.of_keyframes(self.space, pos, shape_labels=given)
        check_shapes(batch.shapes, self.space)
        out = self.augmentation.drawn(batch, self.space, pool)
        data.pos = out.shapes.flatten(0, 1)
        if "normal" in data:
            data.normal = vertex_normals(out.shapes, self.space.faces).flatten(0, 1)
        if out.shape_labels is not None:
            data.y = out.shape_labels.reshape(data.y.shape)
        return data

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.augmentation})"


def as_data(sample: dict[str, Any]) -> Data:
    """A sample of :class:`torch_modal.ShapeDataset`, made with ``faces=True``, as a graph.

    Its keys become ``pos``, ``face``, ``normal``, ``y`` (labels of the shape) and ``vertex_labels``.
    """
    names = {"vertices": "pos", "normals": "normal", "shape_labels": "y", "vertex_labels": "vertex_labels"}
    parts = {new: sample[old] for old, new in names.items() if old in sample}
    if "y" in parts:
        parts["y"] = parts["y"][None]
    return Data(face=sample["faces"].T.contiguous(), **parts)
