"""Random deformations along vibration modes, in rotation-strain coordinates."""

from typing import Any

import torch
from torch import Tensor

from torch_modal.data.augmentation import Parameters, ShapeAugmentation, check_range, draw_normal, draw_uniform
from torch_modal.data.in_betweens import compute_by_kind
from torch_modal.data.shape_batch import ShapeBatch
from torch_modal.data.space import ShapeSpace
from torch_modal.data.strain import edge_strains
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.triangle_frames import bend, bend_sides, frames_of, sides

# A draw beyond the bound is scaled to this fraction of it; its largest strain is nearly linear in the scale.
_WITHIN_BOUND = 0.98
_SMALLEST_FACTOR = 0.05
_SCALING_ROUNDS = 8


class RandomModalDeformation(ShapeAugmentation):
    r"""Deforms shapes along the vibration modes of the nearest key-frame, with thermal amplitudes.

    Amplitudes are independent and normal, :math:`a_i \sim N(0, \sigma^2 / \lambda_i)`, so that each mode has the same
    energy on average: limbs bend far, thickness hardly changes. The linear displacement gives each triangle a rotation
    and a strain, the rotation is made finite, and vertices follow by a Poisson problem (rotation-strain coordinates,
    Huang et al. 2011): large draws bend. A draw whose largest edge strain would exceed the bound is scaled down until
    it does not. The result is aligned with the input.

    Args:
        strain: Range of the expected root mean square edge strain (which is sigma, in other units), drawn uniformly; a
            number means exactly that. Sheets bend without changes of length: for them it is the strain of their two
            sides, at a thickness of a hundredth of their size: 0.02 bends by about 4 radians over the size.
        max_strain: Bound on the relative change of length of every edge.
        p: Probability that a shape is transformed.
        options: As for :class:`ShapeAugmentation`.

    Raises:
        ValueError: ``strain`` is no range of positive numbers, or ``max_strain`` is not between 0 and 1.
    """

    def __init__(
        self, strain: float | tuple[float, float] = (0.0, 0.02), max_strain: float = 0.2, p: float = 0.5, **options: Any
    ) -> None:
        super().__init__(p, **options)
        strain = (strain, strain) if isinstance(strain, (int, float)) else strain
        self.strain = check_range("strain", strain, 0, 1)
        if not 0 < max_strain < 1:
            raise ValueError(f"max_strain is above 0 and below 1, got {max_strain}")
        self.max_strain = max_strain

    def generate_parameters(self, n: int, space: ShapeSpace, generator: torch.Generator | None) -> Parameters:
        """``noise``, a standard normal number for each mode, and the ``strain``."""
        return {"strain": draw_uniform(n, generator, self.strain), "noise": draw_normal(n, generator, space.n_modes)}

    def apply_transform(
        self, batch: ShapeBatch, params: Parameters, space: ShapeSpace, partners: ShapeBatch | None
    ) -> ShapeBatch:
        """Deform each shape along the modes of its nearest key-frame."""
        assert batch.nearest is not None
        amplitudes = params["strain"][:, None] * params["noise"]

        def deform_rows(kind: list[int], rows: Tensor) -> Tensor:
            rows = rows.to(amplitudes.device)
            return self._deform_nearest(batch.shapes[rows], amplitudes[rows], space, kind[0])

        return batch._replace(shapes=compute_by_kind(batch.nearest[:, None], deform_rows))

    def _deform_nearest(self, x: Tensor, amplitudes: Tensor, space: ShapeSpace, index: int) -> Tensor:
        """Deform shapes whose nearest key-frame is the same. *Shape:* ``(B, V, 3), (B, n) -> (B, V, 3)``.

        Each draw is scaled down, by a constant of the graph, until it keeps the bound; without any such scale, the
        shape stays as it was.
        """
        basis, reconstruction = space.bases[index], space.reconstruction(x.device)
        keyframe, modes, scales = (tensor.to(x) for tensor in (basis.reference, basis.modes, space.mode_scales(index)))
        displacement = (amplitudes[:, : len(scales)] * scales) @ modes.flatten(1)
        displacement = displacement.unflatten(1, (-1, 3)).movedim(-1, 0).contiguous()
        with torch.no_grad():
            largest = edge_strains(displacement, keyframe, reconstruction.edges).abs().amax(1)
        scale, shapes, rows = torch.ones_like(largest), x, torch.arange(len(x), device=x.device)
        for _ in range(_SCALING_ROUNDS):
            factor = _WITHIN_BOUND * self.max_strain / largest.clamp_min(torch.finfo(x.dtype).tiny)
            scale = scale * factor.clamp(_SMALLEST_FACTOR, 1)
            deformed = deform(x[rows], scale[:, None] * displacement[:, rows], keyframe, reconstruction)
            with torch.no_grad():
                largest = space.strain(deformed, x[rows]).abs().amax(1).nan_to_num(torch.inf)
            within = largest <= self.max_strain
            shapes = shapes.index_copy(0, rows[within], deformed[within])
            rows, scale, largest = rows[~within], scale[~within], largest[~within]
            if not len(rows):
                break
        return shapes


def deform(x: Tensor, displacement: Tensor, keyframe: Tensor, reconstruction: Reconstruction) -> Tensor:
    """Bend shapes by the rotations and strains that a linear displacement of a key-frame gives its triangles.

    A shape of another pose gets the same rotations, and strains along its own triangles; results are aligned with it.

    *Shape:* ``(B, V, 3), (3, B, V), (V, 3) -> (B, V, 3)``.
    """
    faces, weights = reconstruction.faces, reconstruction.areas.to(x)
    turn, strain = bend(sides(displacement, faces), frames_of(keyframe[None], faces))
    pose = best_fit(keyframe.expand_as(x), x, weights).rotation
    turn = (pose @ turn.movedim(0, 1)).movedim(0, 1)
    wanted = bend_sides(turn, strain, frames_of(x, faces))
    bent = reconstruction(wanted, x)
    return best_fit(bent, x, weights).apply(bent)
