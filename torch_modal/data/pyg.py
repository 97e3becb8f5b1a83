"""Random transforms for PyTorch Geometric. Needs ``torch_geometric`` (``pip install torch_modal[pyg]``)."""

from typing import Any

import torch

from torch_modal.data.augmentation import ShapeAugmentation, ShapeBatch
from torch_modal.data.sequential import AugmentationSequential
from torch_modal.data.space import ShapeSpace
from torch_modal.extras import require_installed

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
        self,
        augmentation: ShapeAugmentation | AugmentationSequential,
        space: ShapeSpace | None = None,
        y: torch.Tensor | None = None,
    ) -> None:
        if isinstance(augmentation, ShapeAugmentation):
            augmentation = AugmentationSequential(
                augmentation, generator=augmentation.generator, space=augmentation.space
            )
        found = augmentation.space if space is None else space
        if found is None:
            raise ValueError("RandomShape needs key-frames and modes: pass space=ShapeSpace(bases, faces)")
        self.space = found
        self.y = y
        keys = ("shapes", "normals", "shape_labels")
        self.augmentation = AugmentationSequential(
            *augmentation.transforms, data_keys=keys, generator=augmentation.generator, space=found
        )

    def forward(self, data: Data) -> Data:
        """Transform a graph or a ``Batch`` of graphs, in place (``BaseTransform`` passes a copy).

        Raises:
            ValueError: A graph has not as many nodes as the space has vertices.
        """
        n_vertices = self.space.n_vertices
        n_graphs = data.num_graphs if isinstance(data, Batch) else 1
        pos: Any = data.pos
        if pos is None or pos.shape != (n_graphs * n_vertices, 3) or not self._even(data):
            got = None if pos is None else tuple(pos.shape)
            of = f"{n_graphs} graphs of " if isinstance(data, Batch) else ""
            raise ValueError(f"data.pos of {of}this space has the shape ({n_graphs * n_vertices}, 3); got {got}")
        label = data.y if self.y is not None else None
        pool = ShapeBatch.of_keyframes(self.space, pos, shape_labels=None if self.y is None else self.y.to(pos.device))
        # Labels have one row a graph; of a single one, it may be missing.
        rows = None if label is None else label.reshape(n_graphs, *pool.shape_labels.shape[1:])  # type: ignore[union-attr]
        shapes, normals, labels = self.augmentation(pos.unflatten(0, (n_graphs, n_vertices)), None, rows, pool=pool)
        data.pos = shapes.flatten(0, 1)
        if "normal" in data:
            data.normal = normals.flatten(0, 1)
        if label is not None:
            data.y = labels.reshape(label.shape)
        return data

    def _even(self, data: Data) -> bool:
        """Whether each graph of a batch has the space's number of nodes."""
        ptr = data.ptr if isinstance(data, Batch) else None
        return ptr is None or bool((ptr.diff() == self.space.n_vertices).all())

    def __repr__(self) -> str:
        inside = ", ".join(repr(each) for each in self.augmentation.transforms)
        return f"{type(self).__name__}({inside})"


def as_data(sample: dict[str, Any]) -> Data:
    """A sample of :class:`torch_modal.ShapeDataset`, made with ``faces=True``, as a graph.

    Its keys become ``pos``, ``face``, ``normal``, ``y`` (labels of the shape) and ``vertex_labels``.
    """
    names = {"vertices": "pos", "normals": "normal", "shape_labels": "y", "vertex_labels": "vertex_labels"}
    parts = {new: sample[old] for old, new in names.items() if old in sample}
    if "y" in parts:
        parts["y"] = parts["y"][None]
    return Data(face=sample["faces"].T.contiguous(), **parts)
