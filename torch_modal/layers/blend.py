"""Weighted in-betweens of several key-frames, as a differentiable layer."""

import torch
from torch import Tensor

from torch_modal.autograd import (
    disable_compile,
    is_traced,
    outside_inference_mode,
    run_outside_transforms,
)
from torch_modal.inbetween.results import InBetweenResult, report, with_exact_keyframes
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.keyframes.arrays import broadcast_leading, check_tensor
from torch_modal.layers.base import Bases, InBetweenLayer, basis_buffers

MOST_BELOW_ZERO = 0.25
"""Largest sum of the weights below zero with which energies still have a minimum."""

SUM_TOLERANCE = 1e-5
"""Sums of weights may differ from one by so much, or by the rounding of their dtype."""


class Blend(InBetweenLayer):
    r"""Shapes in between several key-frames, by weights: of little :math:`\sum_k w_k\, d(x_k, x)`.

    ``d`` is Eq. 5. The key-frames may be any shapes of this connectivity near those that the bases were made from, as
    many or as few as are wanted. Their order does not matter, nor do key-frames of weight 0. Two key-frames of a layer
    of two bases have the shapes of :class:`InBetween` at the time of the second weight. A rigid motion between
    key-frames is taken out first; the result has the weighted mean of their poses.

    Gradients reach the key-frames, the weights and the stiffnesses, also second ones. The modes are constants.
    Precision, warnings and statuses are as for :class:`InBetween`.

    Args:
        bases: Key-frames, one or more, in any order, *shape* ``(K, V, 3)``; or bases, as for :class:`InBetween`.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        preset: ``"accurate"``, ``"fast"`` or ``"modal"``, as for :class:`InBetween`.
        objective: What is minimised, instead of the preset's objective.
        solver: How it is solved, instead of the preset's solver.

    Raises:
        ValueError: An argument is not usable, or the objective has contact or the paired space, which are of pairs.
    """

    @outside_inference_mode
    def __init__(
        self,
        bases: Bases,
        faces: Tensor,
        preset: Preset = "accurate",
        *,
        objective: Objective | None = None,
        solver: Solver | None = None,
    ) -> None:
        chosen = settings(preset, objective, solver)
        if chosen.objective.space == "paired" or chosen.objective.contact:
            raise ValueError("contact and space='paired' are of two key-frames; a blend has neither")
        several = basis_buffers(bases, chosen.objective.space is not None, bool(chosen.objective.terms))
        super().__init__(several * 2 if len(several) == 1 else several, faces, chosen)

    @disable_compile
    def forward(self, keyframes: Tensor, weights: Tensor) -> Tensor:
        """The weighted in-betweens.

        All leading dimensions broadcast against each other: weights of ``(T, K)`` with key-frames of ``(K, V, 3)`` give
        T shapes.

        Args:
            keyframes: *Shape:* ``(..., K, V, 3)``.
            weights: They add up to one. Some may be below zero, down to a sum of -0.25. *Shape:* ``(..., K)``.

        Returns:
            The key-frame exactly where it has all the weight. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes, dtypes, devices or weights that do not fit.
            ConvergenceError: A sample did not converge, gradients are recorded and ``unconverged="raise"``.
        """
        result = self.solve(keyframes, weights)
        report(result.solution, self.solver)
        return result.shapes

    @disable_compile
    def solve(self, keyframes: Tensor, weights: Tensor) -> InBetweenResult:
        """The shapes, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        check_tensor("weights", weights, "...", "K", device=self.bases[0].reference.device)
        self.check_shapes(weights.shape[-1], keyframes=keyframes)
        lead = broadcast_leading(keyframes=keyframes.shape[:-3], weights=weights.shape[:-1])
        if not is_traced(weights):
            run_outside_transforms(_check_weights, weights)
        normalised = weights
        if torch.finfo(weights.dtype).bits < 32:  # of an autocast model: to more digits, they do not add up to one
            normalised = weights.to(self.dtype)
            normalised = normalised / normalised.sum(-1, keepdim=True)
        result = self.solve_samples(keyframes, normalised, lead)
        return result._replace(shapes=with_exact_keyframes(result.shapes, keyframes, weights))


def _check_weights(weights: Tensor) -> None:
    known, rounding = weights.double(), max(SUM_TOLERANCE, torch.finfo(weights.dtype).eps)
    off, below = (known.sum(-1) - 1).abs(), -known.clamp_max(0).sum(-1)
    wrong = ~((off <= rounding) & (below <= MOST_BELOW_ZERO + rounding))
    if bool(wrong.any()):
        raise ValueError(
            f"weights add up to 1, those below zero to -{MOST_BELOW_ZERO} at most; got {known[wrong][0].tolist()}"
        )
