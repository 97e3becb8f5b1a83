"""Random in-betweens, members of the space, and rigid motions."""

import math
from typing import Any

import torch
from kornia.geometry.conversions import quaternion_to_axis_angle
from torch import Tensor
from torch.nn.functional import normalize

from torch_modal.data.augmentation import Parameters, ShapeAugmentation, check_range, draw_normal, draw_uniform
from torch_modal.data.shape_batch import ShapeBatch
from torch_modal.data.space import ShapeSpace
from torch_modal.geometry.rigid import RigidMotion, best_fit
from torch_modal.geometry.rotations import exp
from torch_modal.statistics.variation import check_density


class RandomInBetween(ShapeAugmentation):
    """Replaces a shape by one between it and a partner, of least elastic energy (:class:`torch_modal.InBetween`).

    Partners are other shapes of the batch, as in kornia's ``RandomMixUpV2``, or key-frames of a ``pool``. One shape
    alone, without labels, has the key-frames of the space as partners.

    Where the key-frames are a motion (``keyframe_times`` of the :class:`ShapeSpace`), the partner from a pool is the
    key-frame before or after in time, with equal probability, and the in-between lies on the :class:`torch_modal.Path`.
    Shapes that are not key-frames have the same partners; their in-betweens depend on these two shapes only.

    Args:
        t: Range of times, drawn uniformly: 0 is the shape itself, 1 its partner.
        blend_labels: Whether labels become ``(1-t) y_a + t y_b``; they must be floating-point then (one-hot vectors,
            for classes). Otherwise a shape has the labels of the nearer end in time.
        p: Probability that a shape is transformed.
        options: As for :class:`ShapeAugmentation`.

    Raises:
        ValueError: ``t`` is no range within [0, 1].
    """

    def __init__(
        self, t: tuple[float, float] = (0.0, 1.0), blend_labels: bool = False, p: float = 0.5, **options: Any
    ) -> None:
        super().__init__(p, **options)
        self.t = check_range("t", t, 0, 1)
        self.blend_labels = blend_labels

    def generate_parameters(self, n: int, space: ShapeSpace, generator: torch.Generator | None) -> Parameters:
        """``partner`` in [0, 1), the partner's place among the other shapes of the pool, and the times ``t``.

        In a motion these are the key-frame before (below 0.5) and the one after.
        """
        return {"partner": draw_uniform(n, generator), "t": draw_uniform(n, generator, self.t)}

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: ShapeSpace, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Move each shape towards its partner."""
        assert partners is not None and batch.nearest is not None and partners.nearest is not None
        t = params["t"]
        nearer = (t.detach() > 0.5).cpu()
        return batch._replace(
            shapes=self.shapes(batch, partners, t, space),
            nearest=torch.where(nearer, partners.nearest, batch.nearest),
            vertex_labels=self._labels(batch.vertex_labels, partners.vertex_labels, t),
            shape_labels=self._labels(batch.shape_labels, partners.shape_labels, t),
        )

    def _labels(self, labels: Tensor | None, others: Tensor | None, t: Tensor) -> Tensor | None:
        if labels is None or others is None:
            return labels
        t = t.detach().to(labels.device).reshape(-1, *[1] * (labels.dim() - 1))
        if not self.blend_labels:
            return torch.where(t > 0.5, others, labels)
        if not labels.is_floating_point():
            raise ValueError(f"blended labels must be floating-point, one-hot for classes; got {labels.dtype}")
        return torch.lerp(labels, others, t.clamp(0, 1).to(labels.dtype))

    def shapes(self, batch: ShapeBatch, partners: ShapeBatch, t: Tensor, space: ShapeSpace) -> Tensor:
        """The shapes at the times ``t``, for a subclass to replace. *Shape:* ``(B,) -> (B, V, 3)``."""
        nearest = batch.nearest, partners.nearest  # all shapes of a space have some
        return space.in_betweens(batch.shapes, partners.shapes, t, *nearest)  # type: ignore[arg-type]


class RandomBlend(ShapeAugmentation):
    """Replaces shapes by random mixtures of all key-frames (:meth:`ShapeSpace.sample`).

    Labels of vertices and of shapes stay: use it for shapes whose labels all key-frames share. Gradients reach the
    given shapes through the alignment with them, which ``on_keyframes=False`` makes.

    Args:
        concentration: As for :meth:`ShapeSpace.sample`.
        locality: Likewise.
        p: Probability that a shape is transformed.
        members: Number of mixtures of a space, which are computed once and stored with its tables; each draw is one of
            them. By default each draw is a new mixture.
        on_keyframes: Whether mixtures are laid on the key-frames, as by :meth:`ShapeSpace.sample`, wherever the given
            shapes are: transforms that move shapes come after this one. Otherwise each is laid on the shape that it
            replaces, by least squares over the surface, which turns it by some degrees where the two differ in pose.
        beyond: As for :meth:`ShapeSpace.sample`: shapes beyond the key-frames.
        options: As for :class:`ShapeAugmentation`.

    Raises:
        ValueError: ``concentration``, ``locality``, ``beyond`` or ``members`` is out of range.
    """

    def __init__(
        self,
        concentration: float = 0.2,
        locality: float = 3.0,
        p: float = 0.5,
        *,
        members: int | None = None,
        on_keyframes: bool = True,
        beyond: tuple[float, float] = (0.0, 0.0),
        **options: Any,
    ) -> None:
        super().__init__(p, **options)
        check_density(concentration, locality, beyond)
        if members is not None and members < 1:
            raise ValueError(f"members must be 1 or more, or None; got {members}")
        self.concentration, self.locality, self.members = concentration, locality, members
        self.on_keyframes, self.beyond = on_keyframes, beyond

    def generate_parameters(self, n: int, space: ShapeSpace, generator: torch.Generator | None) -> Parameters:
        """``weights`` of the key-frames, ``factors`` by which they vary over the surface, and how far ``beyond``.

        With a table, the place of the ``member`` in it, in [0, 1).
        """
        if self.members is not None:
            return {"member": draw_uniform(n, generator)}
        drawn = space.variation().draw(n, self.concentration, self.locality, self.beyond, generator)
        return dict(zip(("weights", "factors", "beyond"), drawn, strict=True))

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: ShapeSpace, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Draw a member for each shape; gradients reach the shapes through the rigid alignment with them alone."""
        drawn = {name: value.detach().double().cpu() for name, value in params.items()}
        if self.members is None:
            variation = space.variation()
            members = variation.members(drawn["weights"], drawn["factors"], drawn["beyond"]) + variation.origin
        else:
            table = space.members(self.members, self.concentration, self.locality, self.beyond)
            members = table[(drawn["member"] * len(table)).long().clamp_max(len(table) - 1)]
        shapes: Tensor = members.to(batch.shapes)
        if not self.on_keyframes:
            areas = space.reconstruction(shapes.device).areas.to(shapes)
            shapes = best_fit(shapes, batch.shapes, areas).apply(shapes)
        return batch._replace(shapes=shapes, nearest=space.nearest(shapes))


class RandomRigidMotion(ShapeAugmentation):
    """Rotates shapes about the mean of their vertices, and translates them.

    Args:
        degrees: Range of the angle, drawn uniformly; a number means the range from its negative to it. With None,
            rotations are uniform over SO(3) (``axis`` has no effect).
        axis: Axis of rotation, such as ``(0, 1, 0)`` for shapes with y up; by default uniform directions.
        translation: Largest move along each axis, in diagonals of the shape's bounding box.
        p: Probability that a shape is transformed.
        options: As for :class:`ShapeAugmentation`.

    Raises:
        ValueError: The angle is beyond 180 degrees, the axis has no length, or the translation is negative.
    """

    uses_keyframes = False

    def __init__(
        self,
        degrees: float | tuple[float, float] | None = None,
        axis: tuple[float, float, float] | None = None,
        translation: float = 0.0,
        p: float = 0.5,
        **options: Any,
    ) -> None:
        super().__init__(p, **options)
        if isinstance(degrees, (int, float)):
            degrees = (-degrees, degrees)
        self.degrees = None if degrees is None else check_range("degrees", degrees, -180, 180)
        if axis is not None and not math.hypot(*axis) > 0:
            raise ValueError(f"axis must have a length above zero; got {axis}")
        self.axis = axis
        if translation < 0:
            raise ValueError(f"translation must be 0 or more; got {translation}")
        self.translation = translation

    def generate_parameters(self, n: int, space: ShapeSpace, generator: torch.Generator | None) -> Parameters:
        """``rotation``, axis times angle in radians; and ``translation``, in diagonals."""
        low, high = (math.radians(degree) for degree in self.degrees or (0.0, 0.0))
        direction, angle = draw_normal(n, generator, 4), draw_uniform(n, generator, (low, high))
        move = self.translation * draw_uniform(n, generator, (-1.0, 1.0), 3)
        if self.degrees is None:
            # A normal vector of four has a uniform direction: a uniform quaternion.
            return {"rotation": quaternion_to_axis_angle(normalize(direction, dim=1)), "translation": move}
        axis = direction[:, 1:] if self.axis is None else direction.new_tensor([self.axis])
        return {"rotation": angle[:, None] * normalize(axis, dim=1), "translation": move}

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: ShapeSpace, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Move each shape."""
        x = batch.shapes
        centre, diagonal = x.mean(1), (x.amax(1) - x.amin(1)).norm(dim=1, keepdim=True).detach()
        motion = RigidMotion(exp(params["rotation"]), centre, centre + params["translation"] * diagonal)
        return batch._replace(shapes=motion.apply(x))
