"""The base class of random transforms of shapes, with the conventions of kornia's augmentations."""

import math
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import full_precision, lasting, require_numbers
from torch_modal.data.space import ShapeSpace

Parameters = dict[str, Tensor]


class ShapeBatch(NamedTuple):
    """Shapes with their key-frames and labels."""

    shapes: Tensor
    """*Shape:* ``(B, V, 3)``."""
    nearest: Tensor | None = None
    """Index of the key-frame whose modes a shape uses; None: the nearest one. On the CPU. *Shape:* ``(B,)``."""
    given: Tensor | None = None
    """Whether a shape equals that key-frame; None: no shape does. On the CPU. *Shape:* ``(B,)``, bool."""
    vertex_labels: Tensor | None = None
    """*Shape:* ``(B, V, ...)``."""
    shape_labels: Tensor | None = None
    """*Shape:* ``(B, ...)``."""

    def rows(self, index: Tensor) -> "ShapeBatch":
        """Some of the shapes."""
        return ShapeBatch._make(None if part is None else part[index.to(part.device)] for part in self)

    def put(self, index: Tensor, other: "ShapeBatch") -> "ShapeBatch":
        """A copy with some of the shapes replaced."""
        parts = (
            mine if mine is None or its is None else mine.index_copy(0, index.to(mine.device), its)
            for mine, its in zip(self, other, strict=True)
        )
        return ShapeBatch._make(parts)

    @classmethod
    def of_keyframes(
        cls,
        space: ShapeSpace,
        like: Tensor | None = None,
        vertex_labels: Tensor | None = None,
        shape_labels: Tensor | None = None,
    ) -> "ShapeBatch":
        """The key-frames of a space.

        Args:
            space: The space.
            like: A tensor of the wanted dtype and device.
            vertex_labels: *Shape:* ``(K, V, ...)``.
            shape_labels: *Shape:* ``(K, ...)``.
        """
        number = torch.arange(len(space))
        given = torch.ones(len(space), dtype=torch.bool)
        return cls(space.keyframes(like), number, given, vertex_labels, shape_labels)

    def scaled(self, factor: float) -> "ShapeBatch":
        """A copy with the shapes multiplied by a number."""
        return self if factor == 1 else self._replace(shapes=factor * self.shapes)

    def located(self, space: ShapeSpace) -> "ShapeBatch":
        """A copy with the nearest key-frame of each shape."""
        nearest = space.nearest(self.shapes) if self.nearest is None else self.nearest
        given = torch.zeros(len(nearest), dtype=torch.bool) if self.given is None else self.given
        return self._replace(nearest=nearest, given=given)


class Pool(NamedTuple):
    """The shapes that partners are drawn from."""

    batch: ShapeBatch
    """With their nearest key-frames."""
    own: Tensor | None
    """Index in the pool of each shape, or of its nearest key-frame. On the CPU. *Shape:* ``(B,)``."""
    neighbours: Tensor | None = None
    """Key-frames before and after each in time, if the pool is a motion. *Shape:* ``(K, 2)``."""


class ShapeAugmentation(nn.Module):
    """A random transform of shapes of one connectivity, batched, differentiable in the shapes.

    Parameters are drawn for each sample on the device of the generator, independent of the shapes' device and dtype.
    :attr:`params` has those of the last call; a call with ``params`` repeats them.

    Args:
        p: Probability that a shape is transformed.
        same_on_batch: Whether all shapes of a batch get the same parameters.
        keepdim: Whether one shape ``(V, 3)`` gives ``(V, 3)`` rather than a batch of one.
        generator: Source of random numbers; by default PyTorch's own generator.
        space: Default key-frames and modes of the calls.

    Raises:
        ValueError: ``p`` is no probability.
    """

    def __init__(
        self,
        p: float = 0.5,
        same_on_batch: bool = False,
        keepdim: bool = False,
        *,
        generator: torch.Generator | None = None,
        space: ShapeSpace | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= p <= 1:
            raise ValueError(f"p is a probability, from 0 to 1; got {p}")
        self.p = p
        self.same_on_batch = same_on_batch
        self.keepdim = keepdim
        self.generator = generator
        self.space = space
        self._params: Parameters = {}

    uses_keyframes = True
    """Whether the transform uses the nearest key-frame of a shape."""
    shown: tuple[str, ...] = ()
    """Settings of a subclass that its ``repr`` shows."""

    @property
    def params(self) -> Parameters:
        """Parameters of the last call, ``batch_prob`` (which shapes were transformed) among them."""
        return self._params

    def extra_repr(self) -> str:
        """Settings, as kornia shows them."""
        return ", ".join(f"{name}={getattr(self, name)}" for name in (*self.shown, "p", "same_on_batch", "keepdim"))

    # ------------------------------------------------------------------------------------------------ for subclasses
    def generate_parameters(self, n: int, space: ShapeSpace | None, generator: torch.Generator | None) -> Parameters:
        """Draw parameters for ``n`` shapes. *Shape of each:* ``(n, ...)``."""
        raise NotImplementedError

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: ShapeSpace | None, pool: "Pool"
    ) -> ShapeBatch:
        """Transform all shapes of a batch.

        Args:
            batch: The shapes, with their nearest key-frames if there is a space, in its units.
            params: Their parameters, on their device.
            space: Key-frames and modes, of a size that float32 can square (:meth:`ShapeSpace.in_units`).
            pool: The shapes that partners are drawn from.
        """
        raise NotImplementedError

    # -------------------------------------------------------------------------------------------------------- calls
    @full_precision
    def forward_parameters(
        self,
        n: int,
        space: ShapeSpace | None = None,
        generator: torch.Generator | None = None,
        same_on_batch: bool | None = None,
    ) -> Parameters:
        """Draw parameters for ``n`` shapes, and which of them are transformed.

        Args:
            n: Number of shapes.
            space: Key-frames and modes; by default the module's.
            generator: By default the module's.
            same_on_batch: By default the module's.
        """
        space = self.space if space is None else space
        generator = self.generator if generator is None else generator
        same = self.same_on_batch if same_on_batch is None else same_on_batch
        drawn = 1 if same and n else n
        draw = partial(self._drawn, drawn, space, generator)
        params = lasting(draw)() if torch.is_inference_mode_enabled() else draw()
        return {name: value.expand(n, *value.shape[1:]) for name, value in params.items()}

    def _drawn(self, n: int, space: ShapeSpace | None, generator: torch.Generator | None) -> Parameters:
        return {"batch_prob": uniform(n, generator) < self.p, **self.generate_parameters(n, space, generator)}

    @full_precision
    def transform(
        self,
        batch: ShapeBatch,
        params: Parameters,
        space: ShapeSpace | None = None,
        pool: ShapeBatch | None = None,
    ) -> ShapeBatch:
        """Transform the shapes that the parameters select, and their labels.

        Args:
            batch: The shapes.
            params: From :meth:`forward_parameters`, or :attr:`params`.
            space: Key-frames and modes; by default the module's.
            pool: The key-frames of the space with their labels (:meth:`ShapeBatch.of_keyframes`), if partners are drawn
                from these; by default they are drawn from the batch.

        Raises:
            ValueError: The rows of ``params`` or ``pool`` do not fit.
        """
        space = self.space if space is None else space
        if self.uses_keyframes or torch.compiler.is_exporting():
            require_numbers(type(self).__name__, batch.shapes)
        own = self._own_rows(batch.shapes, params)
        chosen = torch.nonzero(params["batch_prob"].cpu()).flatten()
        if not len(chosen):
            return batch
        own = {name: value[chosen.to(value.device)] for name, value in own.items()}
        if space is None or not self.uses_keyframes:
            return batch.put(chosen, self.apply_transform(batch.rows(chosen), own, space, Pool(batch, chosen)))
        unit, space = space.unit, space.in_units()
        batch = batch.scaled(1 / unit).located(space)
        mine = batch.rows(chosen)
        if pool is None:
            others = Pool(batch, chosen)
        elif len(pool.shapes) == len(space):
            others = Pool(
                pool.scaled(1 / unit).located(space),
                mine.nearest,
                None if space.motion is None else space.motion.neighbours,
            )
        else:
            raise ValueError(f"a pool holds the {len(space)} key-frames of the space; got {len(pool.shapes)} shapes")
        return batch.put(chosen, self.apply_transform(mine, own, space, others)).scaled(unit)

    def forward(
        self,
        shapes: Tensor,
        params: Parameters | None = None,
        *,
        space: ShapeSpace | None = None,
        pool: ShapeBatch | None = None,
    ) -> Tensor:
        """Transform shapes.

        Args:
            shapes: Vertex positions. *Shape:* ``(B, V, 3)`` or ``(V, 3)``.
            params: Parameters of an earlier call, to repeat it.
            space: Key-frames and modes; by default the module's.
            pool: The key-frames of the space (:meth:`ShapeBatch.of_keyframes`), if partners are drawn from these; by
                default they are drawn from the batch.

        Returns:
            *Shape:* ``(B, V, 3)``; ``(V, 3)`` for one shape if ``keepdim`` is set.

        Raises:
            ValueError: The shapes, or the rows of ``params``, do not fit.
        """
        space = self.space if space is None else space
        check_shapes(shapes, space)
        single = shapes.dim() == 2
        batch = ShapeBatch(shapes[None] if single else shapes)
        self._params = self.forward_parameters(len(batch.shapes), space) if params is None else params
        out = self.transform(batch, self._params, space, pool).shapes
        return out[0] if single and self.keepdim else out

    @staticmethod
    def _own_rows(shapes: Tensor, params: Parameters) -> Parameters:
        """Parameters on the device and in the dtype of the shapes."""
        n = len(shapes)
        wrong = {name: tuple(value.shape) for name, value in params.items() if len(value) != n}
        if wrong:
            raise ValueError(f"{n} shapes need parameters with {n} rows; got {wrong}")
        return {
            name: value.to(shapes.device, shapes.dtype if value.is_floating_point() else None)
            for name, value in params.items()
        }

    def _space(self, space: ShapeSpace | None) -> ShapeSpace:
        if space is None:
            raise ValueError(
                f"{type(self).__name__} needs key-frames and modes: pass space=ShapeSpace(bases, faces) when it is "
                "made or called"
            )
        return space


def check_shapes(shapes: Tensor, space: ShapeSpace | None) -> None:
    """Raise unless a tensor is a batch of shapes of a space.

    Raises:
        ValueError: The message names shape and dtype.
    """
    v: Any = "V" if space is None else space.n_vertices
    fits = shapes.dim() in (2, 3) and shapes.shape[-1] == 3 and (space is None or shapes.shape[-2] == v)
    if not fits or shapes.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"shapes must be float32 or float64 of the shape (B, {v}, 3) or ({v}, 3); got {tuple(shapes.shape)} of "
            f"{shapes.dtype}"
        )


def check_range(name: str, given: tuple[float, float], lowest: float, highest: float) -> tuple[float, float]:
    """Check a range of numbers.

    Raises:
        ValueError: It is no range within the bounds.
    """
    try:
        low, high = map(float, given)
    except (TypeError, ValueError):
        low = high = math.nan
    if not lowest <= low <= high <= highest:
        raise ValueError(f"{name} is a range (low, high) within [{lowest}, {highest}]; got {str(given)[:100]}")
    return low, high


def uniform(n: int, generator: torch.Generator | None, *size: int) -> Tensor:
    """Uniform numbers in [0, 1), float64. *Shape:* ``(n, ...)``."""
    return torch.rand(n, *size, dtype=torch.float64, generator=generator, device=_device(generator))


def normal(n: int, generator: torch.Generator | None, *size: int) -> Tensor:
    """Standard normal numbers, float64. *Shape:* ``(n, ...)``."""
    return torch.randn(n, *size, dtype=torch.float64, generator=generator, device=_device(generator))


def _device(generator: torch.Generator | None) -> torch.device:
    return torch.device("cpu") if generator is None else generator.device
