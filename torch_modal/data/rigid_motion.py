"""Random rigid motions."""

import math
from typing import Any

import torch
from kornia.geometry.conversions import quaternion_to_axis_angle
from torch.nn.functional import normalize

from torch_modal.data.augmentation import Parameters, ShapeAugmentation, ShapeBatch, check_range, normal, uniform
from torch_modal.geometry.rigid import RigidMotion
from torch_modal.geometry.rotations import exp


class RandomRigidMotion(ShapeAugmentation):
    """Rotates shapes about the mean of their vertices, and translates them.

    Args:
        degrees: Range of the angle, drawn uniformly; a number is the range from it to its negative. With None,
            rotations are uniform over SO(3) (``axis`` has no effect).
        axis: Axis of rotation, such as ``(0, 1, 0)`` for shapes with y up; by default uniform directions.
        translation: Largest move along each axis, in diagonals of the shape's bounding box.
        p: Probability that a shape is transformed.
        options: As for :class:`ShapeAugmentation`.

    Raises:
        ValueError: The angle is beyond 180 degrees, the axis has no length, or the translation is negative.
    """

    uses_keyframes = False
    shown = ("degrees", "axis", "translation")

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
            raise ValueError(f"an axis has a length, got {axis}")
        self.axis = axis
        if translation < 0:
            raise ValueError(f"translation is the largest move, 0 or more; got {translation}")
        self.translation = translation

    def generate_parameters(self, n: int, space: Any, generator: torch.Generator | None) -> Parameters:
        """``rotation``, axis times angle in radians; and ``translation``, in diagonals."""
        direction, angle = normal(n, generator, 4), uniform(n, generator)
        move = self.translation * (2 * uniform(n, generator, 3) - 1)
        if self.degrees is None:
            # A normal vector of four has a uniform direction: a uniform quaternion.
            return {"rotation": quaternion_to_axis_angle(normalize(direction, dim=1)), "translation": move}
        low, high = (math.radians(degree) for degree in self.degrees)
        angle = low + (high - low) * angle
        axis = direction[:, 1:]
        if self.axis is not None:
            axis = torch.as_tensor(self.axis).to(axis).expand_as(axis)
        return {"rotation": angle[:, None] * normalize(axis, dim=1), "translation": move}

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: Any, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Move each shape."""
        x = batch.shapes
        centre, diagonal = x.mean(1), (x.amax(1) - x.amin(1)).norm(dim=1, keepdim=True).detach()
        motion = RigidMotion(exp(params["rotation"]), centre, centre + params["translation"] * diagonal)
        return batch._replace(shapes=motion.apply(x))
