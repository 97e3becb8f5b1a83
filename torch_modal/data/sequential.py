"""Several random transforms as one, with labels and normals."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.data.augmentation import Parameters, ShapeAugmentation, ShapeBatch, check_shapes
from torch_modal.data.space import ShapeSpace
from torch_modal.geometry.vectors import vertex_normals

DATA_KEYS = ("shapes", "normals", "vertex_labels", "shape_labels")


class AugmentationSequential(nn.Module):
    """Random transforms in sequence, which also transform labels; named after kornia's.

    A call takes one argument for each data key and returns as many, in the same order:

    - ``"shapes"``: vertex positions, ``(B, V, 3)`` or ``(V, 3)``;
    - ``"normals"``: replaced by the vertex normals of the new shapes; the argument may be None;
    - ``"vertex_labels"``: ``(B, V, ...)``, or ``(V, ...)`` for one shape;
    - ``"shape_labels"``: ``(B, ...)``, or of one shape without the B.

    Vertices keep their order, so that labels, landmarks and correspondences stay valid. Only transforms with a second
    shape change labels (``blend_labels``).

    Args:
        transforms: The transforms, in order.
        data_keys: Arguments and results of a call; ``"shapes"`` must be among them.
        same_on_batch: Overrides that of the transforms, unless None.
        keepdim: Whether one shape gives one shape rather than a batch of one.
        generator: Source of random numbers of all transforms; by default each has its own.
        space: Key-frames and modes, for all transforms; by default each has its own.

    Raises:
        ValueError: An unknown or doubled data key, or no shapes.
    """

    def __init__(
        self,
        *transforms: ShapeAugmentation,
        data_keys: Sequence[str] = ("shapes",),
        same_on_batch: bool | None = None,
        keepdim: bool = False,
        generator: torch.Generator | None = None,
        space: ShapeSpace | None = None,
    ) -> None:
        super().__init__()
        self.transforms = nn.ModuleList(transforms)
        self.data_keys = tuple(data_keys)
        if "shapes" not in self.data_keys or len(set(self.data_keys)) < len(self.data_keys):
            raise ValueError(f"data_keys name each thing once, 'shapes' among them; got {self.data_keys}")
        if set(self.data_keys) - set(DATA_KEYS):
            raise ValueError(f"data_keys are of {DATA_KEYS}; got {self.data_keys}")
        self.same_on_batch = same_on_batch
        self.keepdim = keepdim
        self.generator = generator
        self.space = space
        #: Parameters of the last call, of each transform.
        self.params: list[Parameters] = []

    def forward_parameters(
        self, n: int, space: ShapeSpace | None = None, generator: torch.Generator | None = None
    ) -> list[Parameters]:
        """Draw parameters for ``n`` shapes, of each transform."""
        space = self.space if space is None else space
        generator = self.generator if generator is None else generator
        return [one.forward_parameters(n, space, generator, self.same_on_batch) for one in self.each()]

    def transform(
        self,
        batch: ShapeBatch,
        params: Sequence[Parameters],
        space: ShapeSpace | None = None,
        pool: ShapeBatch | None = None,
    ) -> ShapeBatch:
        """Transform a batch with given parameters; arguments as for :meth:`ShapeAugmentation.transform`.

        Raises:
            ValueError: As there, or as many sets of parameters as transforms are not given.
        """
        space = self.space if space is None else space
        if len(params) != len(self.transforms):
            raise ValueError(f"{len(self.transforms)} transforms need as many sets of parameters; got {len(params)}")
        for one, own in zip(self.each(), params, strict=True):
            batch = one.transform(batch, own, space, pool)
        return batch

    def forward(
        self,
        *inputs: Tensor | None,
        params: Sequence[Parameters] | None = None,
        space: ShapeSpace | None = None,
        pool: ShapeBatch | None = None,
    ) -> Any:
        """Transform shapes, their normals and labels.

        Args:
            inputs: One for each data key.
            params: Parameters of an earlier call, to repeat it.
            space: Key-frames and modes; by default the module's.
            pool: The key-frames of the space (:meth:`ShapeBatch.of_keyframes`), with labels if ``inputs`` have any, if
                partners are drawn from these; by default they are drawn from the batch.

        Returns:
            A tensor, or a tuple of one for each data key.

        Raises:
            ValueError: The inputs do not fit the data keys, each other or the space.
        """
        space = self.space if space is None else space
        if len(inputs) != len(self.data_keys):
            raise ValueError(f"the data keys are {self.data_keys}; got {len(inputs)} arguments")
        named = dict(zip(self.data_keys, inputs, strict=True))
        shapes = named["shapes"]
        if shapes is None:
            raise ValueError("shapes are None")
        check_shapes(shapes, space)
        single = shapes.dim() == 2
        parts: dict[str, Any] = {
            name: value[None] if single and value is not None else value for name, value in named.items()
        }
        parts.pop("normals", None)
        check_labels(parts["shapes"].shape[:2], parts)
        batch = ShapeBatch(**parts)
        self.params = self.forward_parameters(len(batch.shapes), space) if params is None else list(params)
        out = self.transform(batch, self.params, space, pool)
        found = {name: getattr(out, name) for name in parts}
        if "normals" in named:
            found["normals"] = self._normals(out.shapes, space)
        if single and self.keepdim:
            found = {name: None if value is None else value[0] for name, value in found.items()}
        results = tuple(found[name] for name in self.data_keys)
        return results[0] if len(results) == 1 else results

    def each(self) -> list[Any]:
        """The transforms."""
        return list(self.transforms)

    def _normals(self, x: Tensor, space: ShapeSpace | None) -> Tensor:
        known = [each for each in (space, *(one.space for one in self.each())) if each is not None]
        if not known:
            raise ValueError("normals need faces: pass space=ShapeSpace(bases, faces) when it is made or called")
        return vertex_normals(x, known[0].faces)


def check_labels(shape: Sequence[int], labels: Mapping[str, Tensor | None]) -> None:
    """Raise unless labels belong to shapes.

    Args:
        shape: Number of shapes and of vertices.
        labels: ``vertex_labels`` and ``shape_labels``, if there are any.

    Raises:
        ValueError: The message names both shapes.
    """
    for name, wanted in (("vertex_labels", tuple(shape)), ("shape_labels", tuple(shape[:1]))):
        value = labels.get(name)
        if value is not None and value.shape[: len(wanted)] != wanted:
            raise ValueError(f"{name} begin with the shape {wanted} of the shapes; got {tuple(value.shape)}")
