"""The base class of random transforms of shapes, with the conventions of kornia's augmentations."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import full_precision, require_numbers
from torch_modal.data.space import ShapeSpace

Parameters = dict[str, Tensor]


class ShapeBatch(NamedTuple):
    """Shapes with their key-frames and labels."""

    shapes: Tensor
    """*Shape:* ``(B, V, 3)``."""
    nearest: Tensor | None = None
    """Index of the key-frame whose modes a shape uses; None: the nearest one. On the CPU. *Shape:* ``(B,)``."""
    is_keyframe: Tensor | None = None
    """True for shapes that equal that key-frame; None: none does. On the CPU. *Shape:* ``(B,)``, bool."""
    vertex_labels: Tensor | None = None
    """*Shape:* ``(B, V, ...)``."""
    shape_labels: Tensor | None = None
    """*Shape:* ``(B, ...)``."""

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
        every = torch.arange(len(space))
        return cls(space.keyframes(like), every, every >= 0, vertex_labels, shape_labels)

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


class ShapeAugmentation(nn.Module):
    """A random transform of shapes of one connectivity, batched, differentiable in the shapes.

    Parameters are drawn for each sample on the device of the generator, independent of the shapes' device and dtype.
    :attr:`params` has those of the last call, ``batch_prob`` (which shapes were transformed) among them; a call with
    ``params`` repeats them.

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
        self.params: Parameters = {}

    uses_keyframes = True
    """True if the transform needs key-frames and modes."""
    shown: tuple[str, ...] = ()
    """Settings of a subclass that its ``repr`` shows."""

    def extra_repr(self) -> str:
        """Settings, as kornia shows them."""
        return ", ".join(f"{name}={getattr(self, name)}" for name in (*self.shown, "p", "same_on_batch", "keepdim"))

    # ------------------------------------------------------------------------------------------------ for subclasses
    def generate_parameters(self, n: int, space: Any, generator: torch.Generator | None) -> Parameters:
        """Draw parameters for ``n`` shapes. *Shape of each:* ``(n, ...)``.

        A parameter ``partner`` in [0, 1) draws a second shape for each.
        """
        raise NotImplementedError

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: Any, partners: ShapeBatch | None
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

        Raises:
            ValueError: There is no space, and the transform needs one.
        """
        space = self._space(space)
        generator = self.generator if generator is None else generator
        same = self.same_on_batch if same_on_batch is None else same_on_batch
        drawn = 1 if same and n else n
        with torch.inference_mode(False):  # a later call, with gradients, may repeat them
            chosen = uniform(drawn, generator) < self.p
            params = {"batch_prob": chosen, **self.generate_parameters(drawn, space, generator)}
        return {name: value.expand(n, *value.shape[1:]) for name, value in params.items()}

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
            ValueError: There is no space, or the rows of ``params`` or ``pool`` do not fit.
        """
        space = self._space(space)
        if self.uses_keyframes or torch.compiler.is_exporting():
            require_numbers(type(self).__name__, batch.shapes)
        n, dtype, device = len(batch.shapes), batch.shapes.dtype, batch.shapes.device
        wrong = {name: tuple(value.shape) for name, value in params.items() if len(value) != n}
        if wrong:
            raise ValueError(f"{n} shapes need parameters with {n} rows; got {wrong}")
        chosen = torch.nonzero(params["batch_prob"].cpu()).flatten()
        if not len(chosen):
            return batch
        if self.uses_keyframes:
            batch = _located(batch, space, torch.promote_types(dtype, space.least_dtype))
        mine, partners = batch.rows(chosen), None
        if "partner" in params:
            partners = _partners(params["partner"].cpu()[chosen], batch, chosen, space, pool)
            if partners is None:
                return batch._replace(shapes=batch.shapes.to(dtype))
        own = {}
        for name, value in params.items():
            kind = mine.shapes.dtype if value.is_floating_point() else None
            own[name] = value[chosen.to(value.device)].to(device, kind)
        found = self.apply_transform(mine, own, space, partners)
        if batch.is_keyframe is not None:
            found = found._replace(is_keyframe=torch.zeros(len(chosen), dtype=torch.bool))
        batch = batch.put(chosen, found)
        return batch._replace(shapes=batch.shapes.to(dtype))

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
            pool: As for :meth:`transform`.

        Returns:
            *Shape:* ``(B, V, 3)``; ``(V, 3)`` for one shape if ``keepdim`` is set.

        Raises:
            ValueError: The shapes do not fit; or as for :meth:`transform`.
        """
        space = self._space(space)
        check_shapes(shapes, space)
        single = shapes.dim() == 2
        batch = ShapeBatch(shapes[None] if single else shapes)
        self.params = self.forward_parameters(len(batch.shapes), space) if params is None else params
        out = self.transform(batch, self.params, space, pool).shapes
        return out[0] if single and self.keepdim else out

    def _space(self, space: ShapeSpace | None) -> Any:
        space = self.space if space is None else space
        if space is None and self.uses_keyframes:
            raise ValueError(
                f"{type(self).__name__} needs key-frames and modes: pass space=ShapeSpace(bases, faces) when it is "
                "made or called"
            )
        return space


def _located(batch: ShapeBatch, space: ShapeSpace, dtype: torch.dtype) -> ShapeBatch:
    """A batch in a dtype, with the nearest key-frame of each shape."""
    shapes = batch.shapes.to(dtype)
    nearest = space.nearest(shapes) if batch.nearest is None else batch.nearest
    none = torch.zeros(len(shapes), dtype=torch.bool)
    return batch._replace(
        shapes=shapes, nearest=nearest, is_keyframe=none if batch.is_keyframe is None else batch.is_keyframe
    )


def _partners(
    draw: Tensor, batch: ShapeBatch, chosen: Tensor, space: ShapeSpace, pool: ShapeBatch | None
) -> ShapeBatch | None:
    """A second shape for each of the chosen ones; None if there is no other.

    Args:
        draw: Its place among the other shapes, in [0, 1); of key-frames in a motion, that before (below 0.5) or after.
            *Shape:* ``(n,)``.
        batch: All shapes.
        chosen: *Shape:* ``(n,)``.
        space: The space.
        pool: Its key-frames, if partners are drawn from these.
    """
    size = len(batch.shapes) if pool is None else len(pool.shapes)
    if pool is not None and size != len(space):
        raise ValueError(f"a pool holds the {len(space)} key-frames of the space; got {size} shapes")
    if size < 2:
        return None
    if pool is not None:
        assert batch.nearest is not None
        pool, own = _located(pool, space, batch.shapes.dtype), batch.nearest[chosen]
        if space.motion is not None:
            return pool.rows(space.motion.neighbours[own, (draw >= 0.5).long()])
    else:
        pool, own = batch, chosen
    return pool.rows((own + (draw * (size - 1)).long().clamp(0, size - 2) + 1) % size)


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
    device = "cpu" if generator is None else generator.device
    return torch.rand(n, *size, dtype=torch.float64, generator=generator, device=device)


def normal(n: int, generator: torch.Generator | None, *size: int) -> Tensor:
    """Standard normal numbers, float64. *Shape:* ``(n, ...)``."""
    device = "cpu" if generator is None else generator.device
    return torch.randn(n, *size, dtype=torch.float64, generator=generator, device=device)
