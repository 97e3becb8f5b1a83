"""The base class of random transforms of shapes, with the conventions of kornia's augmentations, and chains of them."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.autograd import disable_compile, full_precision, require_numbers
from torch_modal.data.shape_batch import ShapeBatch, check_labels
from torch_modal.data.space import ShapeSpace
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.keyframes.arrays import check_tensor

DATA_KEYS = ("shapes", "normals", "vertex_labels", "shape_labels")

Parameters = dict[str, Tensor]


class ShapeAugmentation(nn.Module):
    """A random transform of shapes of one connectivity and their labels, batched, differentiable in the shapes.

    A call takes one argument for each data key and returns as many, in the same order:

    - ``"shapes"``: vertex positions, ``(B, V, 3)`` or ``(V, 3)``;
    - ``"normals"``: replaced by the vertex normals of the new shapes; the argument may be None;
    - ``"vertex_labels"``: ``(B, V, ...)``, or ``(V, ...)`` for one shape;
    - ``"shape_labels"``: ``(B, ...)``, or of one shape without the B.

    Vertices keep their order, so that labels, landmarks and correspondences stay valid. Only transforms with a second
    shape change labels (``blend_labels``).

    Parameters are drawn for each sample on the device of the generator, independent of the shapes' device and dtype.
    :attr:`params` has the parameters of the last call, and ``batch_prob``, which shapes were transformed; a call with
    ``params`` repeats it.

    Args:
        p: Probability that a shape is transformed.
        same_on_batch: Whether all shapes of a batch get the same parameters.
        keepdim: Whether one shape ``(V, 3)`` gives ``(V, 3)`` rather than a batch of one.
        data_keys: Arguments and results of a call; ``"shapes"`` must be among them.
        generator: Source of random numbers; by default PyTorch's own generator.
        space: Default key-frames and modes of the calls.

    Raises:
        ValueError: ``p`` is no probability, a data key is unknown or doubled, or there are no shapes.
    """

    uses_keyframes = True
    """True if the transform needs key-frames and modes."""

    def __init__(
        self,
        p: float = 0.5,
        same_on_batch: bool = False,
        keepdim: bool = False,
        *,
        data_keys: Sequence[str] = ("shapes",),
        generator: torch.Generator | None = None,
        space: ShapeSpace | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= p <= 1:
            raise ValueError(f"p must be a probability, from 0 to 1; got {p}")
        self.data_keys = tuple(data_keys)
        keys = set(self.data_keys)
        if "shapes" not in keys or len(keys) < len(self.data_keys) or keys - set(DATA_KEYS):
            raise ValueError(f"data_keys must be unique, among {DATA_KEYS}, and include 'shapes'; got {self.data_keys}")
        self.p = p
        self.same_on_batch = same_on_batch
        self.keepdim = keepdim
        self.generator = generator
        self.space = space
        self.params: Any = {}

    # ------------------------------------------------------------------------------------------------ for subclasses
    def generate_parameters(self, n: int, space: ShapeSpace, generator: torch.Generator | None) -> Parameters:
        """Draw parameters for ``n`` shapes. *Shape of each:* ``(n, ...)``.

        A parameter ``partner`` in [0, 1) draws a second shape for each.
        """
        raise NotImplementedError

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: ShapeSpace, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Transform all shapes of a batch.

        Args:
            batch: The shapes, with their nearest key-frames if there is a space.
            params: Their parameters, on their device.
            space: The :class:`ShapeSpace`; None if there is none and the transform needs none.
            partners: The second shapes, if there is a parameter ``partner``.
        """
        raise NotImplementedError

    # -------------------------------------------------------------------------------------------------------- calls
    def forward_parameters(
        self, n: int, space: ShapeSpace | None = None, generator: torch.Generator | None = None
    ) -> Any:
        """Draw parameters for ``n`` shapes, and which of them are transformed.

        Args:
            n: Number of shapes.
            space: Key-frames and modes; by default the module's.
            generator: By default the module's.

        Returns:
            A dict; for :class:`AugmentationSequential`, a list with one for each transform.

        Raises:
            ValueError: There is no space, and the transform needs one.
        """
        space, generator = self._space(space), self.generator if generator is None else generator
        drawn = 1 if self.same_on_batch and n else n
        with torch.inference_mode(False):  # a later call, with gradients, may repeat them
            chosen = draw_uniform(drawn, generator) < self.p
            params = {"batch_prob": chosen, **self.generate_parameters(drawn, space, generator)}
        return {name: value.expand(n, *value.shape[1:]) for name, value in params.items()}

    @full_precision
    def transform(
        self, batch: ShapeBatch, params: Any, space: ShapeSpace | None = None, pool: ShapeBatch | None = None
    ) -> ShapeBatch:
        """Transform the shapes that the parameters select, and their labels.

        Args:
            batch: The shapes.
            params: From :meth:`forward_parameters`, or :attr:`params`.
            space: Key-frames and modes; by default the module's.
            pool: The key-frames of the space with their labels (:meth:`ShapeBatch.of_keyframes`), if partners are drawn
                from these; by default they are drawn from the batch.

        Raises:
            ValueError: There is no space, or the rows of ``params`` or ``pool`` do not fit.
        """
        space = self._space(space)
        if self.uses_keyframes or torch.compiler.is_exporting():
            require_numbers(type(self).__name__, batch.shapes)
        n, dtype = len(batch.shapes), batch.shapes.dtype
        wrong = {name: tuple(value.shape) for name, value in params.items() if len(value) != n}
        if wrong:
            raise ValueError(f"{n} shapes need parameters with {n} rows; got {wrong}")
        chosen = torch.nonzero(params["batch_prob"].cpu()).flatten()
        if not len(chosen):
            return batch
        if self.uses_keyframes:
            batch = batch.locate(space, torch.promote_types(dtype, space.least_dtype))
        mine, partners = batch.rows(chosen), None
        if "partner" in params:
            partners = batch.partners(chosen, params["partner"].cpu()[chosen], space, pool)
            if partners is None:
                return batch._replace(shapes=batch.shapes.to(dtype))
        mine_params = {name: value[chosen.to(value.device)].to(mine.shapes.device) for name, value in params.items()}
        mine_params |= {name: value.to(mine.shapes) for name, value in mine_params.items() if value.is_floating_point()}
        batch = batch.with_rows(chosen, self.apply_transform(mine, mine_params, space, partners))
        return batch._replace(shapes=batch.shapes.to(dtype))

    @disable_compile
    def forward(
        self,
        *inputs: Tensor | None,
        params: Any = None,
        space: ShapeSpace | None = None,
        pool: ShapeBatch | None = None,
    ) -> Any:
        """Transform shapes, their normals and labels.

        Args:
            inputs: One for each data key; or one graph of PyTorch Geometric, a ``Data`` with ``pos`` (V, 3).
            params: Parameters of an earlier call, to repeat it.
            space: Key-frames and modes; by default the module's.
            pool: As for :meth:`transform`, with labels if ``inputs`` have any.

        Returns:
            A tensor, or a tuple of one for each data key. One shape gives a batch of one, unless ``keepdim`` is set. A
            graph gives a copy with other positions.

        Raises:
            ValueError: The inputs do not fit the data keys, each other or the space; or as for :meth:`transform`.
        """
        space = self._space(space)
        if len(inputs) == 1 and hasattr(inputs[0], "pos"):
            return self._of_graph(inputs[0], params, space, pool)
        if len(inputs) != len(self.data_keys):
            raise ValueError(f"the data keys are {self.data_keys}; got {len(inputs)} arguments")
        named: dict[str, Any] = dict(zip(self.data_keys, inputs, strict=True))
        single = isinstance(named["shapes"], Tensor) and named["shapes"].dim() == 2
        size = "V" if space is None else space.n_vertices, 3
        check_tensor("shapes", named["shapes"], *(() if single else ("B",)), *size)
        if single:
            named = {name: None if value is None else value[None] for name, value in named.items()}
        check_labels(named["shapes"].shape[:2], named)
        batch = ShapeBatch(**{name: value for name, value in named.items() if name != "normals"})
        self.params = self.forward_parameters(len(batch.shapes), space) if params is None else params
        out = self.transform(batch, self.params, space, pool)
        if "normals" in named:
            if space is None:
                raise ValueError("normals need faces: pass space=ShapeSpace(keyframes, faces), here or before")
            normals = vertex_normals(out.shapes, space.faces)
        results = [normals if name == "normals" else getattr(out, name) for name in named]
        if single and self.keepdim:
            results = [None if value is None else value[0] for value in results]
        return results[0] if len(results) == 1 else tuple(results)

    def _of_graph(self, data: Any, params: Any, space: ShapeSpace | None, pool: ShapeBatch | None) -> Any:
        """A copy of a graph of PyTorch Geometric with other positions ``pos (V, 3)``."""
        if self.data_keys != ("shapes",):
            raise ValueError(f"a graph takes other positions alone; of {self.data_keys}, pass tensors")
        data = data.clone()
        data.pos = self(data.pos[None], params=params, space=space, pool=pool)[0]
        return data

    def _space(self, space: ShapeSpace | None) -> ShapeSpace:
        space = self.space if space is None else space
        if space is None and self.uses_keyframes:
            raise ValueError(
                f"{type(self).__name__} needs key-frames: pass space=ShapeSpace(keyframes, faces) when it is "
                "made or called"
            )
        return space  # type: ignore[return-value]  # None for transforms that ignore it


class AugmentationSequential(ShapeAugmentation):
    """Random transforms in sequence; named after kornia's.

    Args:
        transforms: The transforms, in order.
        data_keys: As for :class:`ShapeAugmentation`; the transforms' own data keys have no effect.
        keepdim: Likewise.
        generator: Source of random numbers of all transforms; by default each has its own.
        space: Key-frames and modes, for all transforms; by default each has its own.

    Raises:
        ValueError: A data key is unknown or doubled, there are no shapes, or an argument is no transform.
    """

    uses_keyframes = False

    def __init__(
        self,
        *transforms: ShapeAugmentation,
        data_keys: Sequence[str] = ("shapes",),
        keepdim: bool = False,
        generator: torch.Generator | None = None,
        space: ShapeSpace | None = None,
    ) -> None:
        super().__init__(1.0, keepdim=keepdim, data_keys=data_keys, generator=generator, space=space)
        others = [type(one).__name__ for one in transforms if not isinstance(one, ShapeAugmentation)]
        if others:
            raise ValueError(f"pass the transforms one by one, AugmentationSequential(*transforms); got {others}")
        self.transforms: Any = nn.ModuleList(transforms)

    def forward_parameters(
        self, n: int, space: ShapeSpace | None = None, generator: torch.Generator | None = None
    ) -> list[Parameters]:
        """Draw parameters of each transform for ``n`` shapes."""
        space, generator = self._space(space), self.generator if generator is None else generator
        return [one.forward_parameters(n, space, generator) for one in self.transforms]

    def transform(
        self, batch: ShapeBatch, params: Any, space: ShapeSpace | None = None, pool: ShapeBatch | None = None
    ) -> ShapeBatch:
        """Transform a batch with given parameters; arguments as for :meth:`ShapeAugmentation.transform`.

        Raises:
            ValueError: As there, or there are not as many sets of parameters as transforms.
        """
        if len(params) != len(self.transforms):
            raise ValueError(f"{len(self.transforms)} transforms need as many sets of parameters; got {len(params)}")
        for one, parameters in zip(self.transforms, params, strict=True):
            batch = one.transform(batch, parameters, self._space(space), pool)
        return batch


def check_range(name: str, span: tuple[float, float], lowest: float, highest: float) -> tuple[float, float]:
    """Check a range of numbers; raises a ValueError unless it lies within the bounds."""
    try:
        low, high = map(float, span)
    except (TypeError, ValueError):
        low = high = math.nan
    if not lowest <= low <= high <= highest:
        raise ValueError(f"{name} must be a range (low, high) within [{lowest}, {highest}]; got {str(span)[:100]}")
    return low, high


def draw_uniform(
    n: int, generator: torch.Generator | None, span: tuple[float, float] = (0.0, 1.0), *size: int
) -> Tensor:
    """Uniform numbers in a range, float64. *Shape:* ``(n, ...)``."""
    device = "cpu" if generator is None else generator.device
    return span[0] + (span[1] - span[0]) * torch.rand(n, *size, dtype=torch.float64, generator=generator, device=device)


def draw_normal(n: int, generator: torch.Generator | None, *size: int) -> Tensor:
    """Standard normal numbers, float64. *Shape:* ``(n, ...)``."""
    device = "cpu" if generator is None else generator.device
    return torch.randn(n, *size, dtype=torch.float64, generator=generator, device=device)
