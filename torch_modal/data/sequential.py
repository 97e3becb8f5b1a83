"""Several random transforms as one, with labels and normals."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.data.augmentation import Parameters, ShapeAugmentation, ShapeBatch, check_shapes
from torch_modal.data.space import ShapeSpace
from torch_modal.geometry.normals import vertex_normals

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
        random_apply: Which transforms a call applies, drawn at each call. False: all, in order. True: all, in random
            order. A number: so many of them, in random order. ``(a,)`` or ``(a, b)``: a number from a to b (to all).
        random_apply_weights: How likely each is drawn; by default all the same.

    Indexing gives a transform, a slice a container of some of them with the same settings; ``len`` and iteration work
    as for a list.

    Raises:
        ValueError: An unknown or doubled data key, no shapes, or an invalid ``random_apply``.
    """

    def __init__(
        self,
        *transforms: ShapeAugmentation,
        data_keys: Sequence[str] = ("shapes",),
        same_on_batch: bool | None = None,
        keepdim: bool = False,
        generator: torch.Generator | None = None,
        space: ShapeSpace | None = None,
        random_apply: bool | int | tuple[int] | tuple[int, int] = False,
        random_apply_weights: Sequence[float] | None = None,
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
        self.random_apply = random_apply
        self.random_apply_weights = random_apply_weights
        self._range = _range_of(random_apply, len(transforms))
        self._weights = torch.ones(len(transforms), dtype=torch.float64)
        if random_apply_weights is not None:
            self._weights = torch.as_tensor(random_apply_weights, dtype=torch.float64)
            if self._weights.shape != (len(transforms),) or not (self._weights > 0).all():
                raise ValueError(
                    f"{len(transforms)} transforms need as many positive weights; got {random_apply_weights}"
                )
        self._params: list[Parameters] | None = None

    def __len__(self) -> int:
        return len(self.transforms)

    def __iter__(self) -> Iterator[ShapeAugmentation]:
        return iter(self._each())

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, int):
            return self.transforms[index]
        options = {
            name: getattr(self, name) for name in ("data_keys", "same_on_batch", "keepdim", "generator", "space")
        }
        # A number of transforms refers to all of them; a slice draws all of its own, or none at random.
        weights = None if self.random_apply_weights is None else list(self.random_apply_weights)[index]
        chosen = self._each()[index]
        return AugmentationSequential(
            *chosen, **options, random_apply=self.random_apply is not False, random_apply_weights=weights
        )

    @property
    def params(self) -> list[Parameters]:
        """Parameters of the last call, of each transform that it applied, in their order.

        With ``random_apply``, ``transform`` says in each row which one it is.
        """
        return self._params or []

    @property
    def transform_matrix(self) -> Tensor:
        """The matrix of the last call, if it applied rigid motions only. *Shape:* ``(B, 4, 4)``.

        Raises:
            ValueError: There was no call yet, or one of its transforms is no rigid motion.
        """
        if not self._params:
            raise ValueError("there is no call with a transform_matrix: make one first")
        matrix: Tensor | None = None
        for index in self.order(self._params):
            own = getattr(self.transforms[index], "transform_matrix", None)
            if own is None:
                raise ValueError(f"{type(self.transforms[index]).__name__} is no rigid motion, so it has no matrix")
            matrix = own if matrix is None else own @ matrix
        assert matrix is not None
        return matrix

    def inverse(self, shapes: Tensor, params: Sequence[Parameters] | None = None) -> Tensor:
        """Undo a call, last transform first; as :meth:`ShapeAugmentation.inverse`."""
        params = self._params if params is None else params
        if params is None:
            raise ValueError("there is no call to invert: make one first, or pass its params")
        for index, own in reversed(list(zip(self.order(params), params, strict=True))):
            shapes = self.transforms[index].inverse(shapes, own)  # type: ignore[operator]
        return shapes

    def order(self, params: Sequence[Parameters]) -> tuple[int, ...]:
        """Which transforms parameters belong to."""
        drawn = all("transform" in own and len(own["transform"]) for own in params)
        if drawn and (params or self._range is not None):
            return tuple(int(own["transform"][0]) for own in params)
        if len(params) != len(self.transforms):
            raise ValueError(f"{len(self.transforms)} transforms need as many sets of parameters; got {len(params)}")
        return tuple(range(len(params)))

    def forward_parameters(
        self, n: int, space: ShapeSpace | None = None, generator: torch.Generator | None = None
    ) -> list[Parameters]:
        """Draw parameters for ``n`` shapes, of all transforms or of those that ``random_apply`` chooses."""
        space = self.space if space is None else space
        generator = self.generator if generator is None else generator
        each = self._each()
        if self._range is None:
            return [one.forward_parameters(n, space, generator, self.same_on_batch) for one in each]
        drawn: list[Parameters] = []
        for index in self._draw(generator):
            own = each[index].forward_parameters(n, space, generator, self.same_on_batch)
            drawn.append({"transform": torch.full((n,), index), **own})
        return drawn

    def _draw(self, generator: torch.Generator | None) -> list[int]:
        """Which transforms a call applies, in random order."""
        assert self._range is not None
        device = torch.device("cpu") if generator is None else generator.device
        low, high = self._range
        count = int(torch.randint(low, high + 1, (1,), generator=generator, device=device))
        if not count:
            return []
        return torch.multinomial(self._weights.to(device), count, generator=generator).tolist()

    def transform(
        self,
        batch: ShapeBatch,
        params: Sequence[Parameters],
        space: ShapeSpace | None = None,
        pool: ShapeBatch | None = None,
    ) -> ShapeBatch:
        """Transform a batch with given parameters; arguments as for :meth:`ShapeAugmentation.transform`."""
        space = self.space if space is None else space
        each = self._each()
        for index, own in zip(self.order(params), params, strict=True):
            batch = each[index].transform(batch, own, space, pool)
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
        batch = _as_batch(named, single)
        self._params = self.forward_parameters(len(batch.shapes), space) if params is None else list(params)
        out = self.transform(batch, self._params, space, pool)
        found = {
            "shapes": out.shapes,
            "normals": self._normals(out.shapes, space) if "normals" in named else None,
            "vertex_labels": out.vertex_labels,
            "shape_labels": out.shape_labels,
        }
        if single and self.keepdim:
            found = {name: None if value is None else value[0] for name, value in found.items()}
        results = tuple(found[name] for name in self.data_keys)
        return results[0] if len(results) == 1 else results

    def _each(self) -> list[Any]:
        return list(self.transforms)

    def _normals(self, x: Tensor, space: ShapeSpace | None) -> Tensor:
        spaces = [space, *(each.space for each in self._each())]
        known = next((each for each in spaces if each is not None), None)
        if known is None:
            raise ValueError("normals need faces: pass space=ShapeSpace(bases, faces) when it is made or called")
        return vertex_normals(x, known.faces)


def _range_of(given: Any, n: int) -> tuple[int, int] | None:
    """Least and greatest number of transforms that are applied; None for all in order.

    Raises:
        ValueError: It is invalid.
    """
    if given is False:
        return None
    ends = (n, n) if given is True else (given, given) if isinstance(given, int) else given
    if isinstance(ends, tuple) and len(ends) == 1:
        ends = (ends[0], n)
    fits = isinstance(ends, tuple) and len(ends) == 2 and all(isinstance(end, int) for end in ends)
    if not fits or not 0 <= ends[0] <= ends[1] <= n:
        raise ValueError(f"random_apply is a bool, a number, (a,) or (a, b), from 0 to the {n} transforms; got {given}")
    return ends


def _as_batch(named: dict[str, Tensor | None], single: bool) -> ShapeBatch:
    parts = {name: value[None] if single and value is not None else value for name, value in named.items()}
    parts.pop("normals", None)
    shapes = parts["shapes"]
    assert shapes is not None
    for name, wanted in (("vertex_labels", shapes.shape[:2]), ("shape_labels", shapes.shape[:1])):
        value = parts.get(name)
        if value is not None and value.shape[: len(wanted)] != wanted:
            raise ValueError(f"{name} begin with the shape {tuple(wanted)} of the shapes; got {tuple(value.shape)}")
    return ShapeBatch(shapes, vertex_labels=parts.get("vertex_labels"), shape_labels=parts.get("shape_labels"))
