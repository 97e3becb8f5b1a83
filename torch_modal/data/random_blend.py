"""New members of a shape space in the place of given shapes."""

from typing import Any

import torch
from torch import Tensor

from torch_modal.data.augmentation import Parameters, ShapeAugmentation, ShapeBatch
from torch_modal.data.space import check_density
from torch_modal.geometry.rigid import best_fit


class RandomBlend(ShapeAugmentation):
    """Replaces shapes by random mixtures of all key-frames (:meth:`ShapeSpace.sample`), aligned with the given shapes.

    Labels of the vertices stay, and so do those of shapes: give it shapes whose labels all key-frames share. Gradients
    reach the given shapes through the alignment alone.

    Args:
        concentration: As for :meth:`ShapeSpace.sample`.
        locality: Likewise.
        p: Probability that a shape is transformed.
        options: As for :class:`ShapeAugmentation`.

    Raises:
        ValueError: ``concentration`` or ``locality`` is out of range.
    """

    shown = ("concentration", "locality")

    def __init__(self, concentration: float = 0.2, locality: float = 3.0, p: float = 0.5, **options: Any) -> None:
        super().__init__(p, **options)
        check_density(concentration, locality)
        self.concentration, self.locality = concentration, locality

    def generate_parameters(self, n: int, space: Any, generator: torch.Generator | None) -> Parameters:
        """``weights`` of the key-frames, and ``factors`` by which they vary over the surface."""
        variation = space.variation()
        drawn = [variation.draw(self.concentration, self.locality, generator) for _ in range(n)]
        if not drawn:
            return {"weights": torch.zeros(0, len(variation)), "factors": torch.zeros(0, len(variation), 0)}
        weights, factors = (torch.stack(part) for part in zip(*drawn, strict=True))
        return {"weights": weights, "factors": factors}

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: Any, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Draw a member for each shape; gradients reach the shapes through the rigid alignment with them alone."""
        variation, areas = space.variation(), space.reconstruction(batch.shapes.device).areas.to(batch.shapes)
        rows = zip(*(params[name].detach().double().cpu() for name in ("weights", "factors")), strict=True)
        found = torch.stack([variation.member(*row)[0] for row in rows]).to(batch.shapes)
        shapes: Tensor = best_fit(found, batch.shapes, areas).apply(found)
        return batch._replace(shapes=shapes, nearest=space.nearest(shapes))
