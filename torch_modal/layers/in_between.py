"""Shapes between two key-frames at any time, as a differentiable layer."""

import warnings
from functools import partial

import torch
from torch import Tensor

from torch_modal.autograd import disable_compile, is_traced, outside_inference_mode, run_outside_transforms
from torch_modal.inbetween.results import InBetweenResult, report, with_exact_keyframes
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.keyframes.arrays import broadcast_leading
from torch_modal.layers.base import Bases, InBetweenLayer, basis_buffers

ROUNDING = 1e-6
"""Distance from [0, 1] within which a time counts as 0 or 1."""


class InBetween(InBetweenLayer):
    r"""Shapes :math:`x(t)` that are cheap to reach from both key-frames: local rotations, then steps of all vertices.

    The key-frames may be any shapes of this connectivity near those that the bases were made from. They are given in
    the caller's coordinates and units, and so is the result. A rigid motion between them is taken out first and then
    followed along its geodesic; a rigid motion of both moves the result along. At half a turn, where both senses are
    equally short, one is taken.

    Gradients reach the key-frames, the times, ``mu`` and the stiffnesses. Modes, with ``preset="modal"`` and
    ``"paper"``, are constants.

    It computes in its own dtype, float64 unless ``.to(torch.float32)`` says otherwise, and never below float32: under
    ``autocast``, ``.half()`` and ``.bfloat16()`` it stays there. Results have the dtype of the key-frames.

    Args:
        bases: Key-frames, *shape* ``(2, V, 3)``, or one that serves for both ends, ``(1, V, 3)``. Instead, their bases
            (:func:`torch_modal.extract_bases`), which ``preset="modal"``, ``"paper"`` and further terms need.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        preset: ``"accurate"``, ``"fast"``, ``"modal"`` or ``"paper"``: docs/layer.md says what each costs and gives.
        objective: What is minimised, instead of the preset's objective.
        solver: How it is solved, instead of the preset's solver.
        contact: True to keep parts from passing through each other; overrides the objective
            (docs/contact.md; extra ``contact``). Each in-between is then pushed apart on its own: a motion is made by
            :class:`torch_modal.Path`, which does it the same way at all times.

    Raises:
        ValueError: An argument is not usable.
        MissingPackageError: ``contact`` without that extra.
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
        contact: bool | None = None,
    ) -> None:
        chosen = settings(preset, objective, solver, contact=contact)
        objective = chosen.objective
        ends = basis_buffers(bases, objective.space is not None, bool(objective.terms) or objective.contact)
        if objective.terms and not any(len(end.modes) for end in ends):
            warnings.warn(
                "without modes, further energy terms act on the local steps alone, which reach a few edges far: pass "
                "bases (tm.extract_bases) instead of key-frames",
                UserWarning,
                stacklevel=3,
            )
        if not 1 <= len(ends) <= 2:
            raise ValueError(
                f"an in-between lies between two bases, got {len(ends)}; Path and Blend take more: pass "
                "[basis_a, basis_b]"
            )
        super().__init__(ends * 2 if len(ends) == 1 else ends, faces, chosen)

    @disable_compile
    def forward(self, x_a: Tensor, x_b: Tensor, t: Tensor | float) -> Tensor:
        """The in-betweens.

        All leading dimensions broadcast against each other, as in ``torch.lerp``: a number gives one shape for each
        pair of key-frames, ``t`` of ``(B,)`` with ``(B, V, 3)`` each its own time, ``t`` of ``(T,)`` with ``(V, 3)`` T
        times, and with ``x_a[:, None]`` all pairs. So does ``t`` of ``(B, 1)`` with ``(B, V, 3)``: squeeze it first.

        Args:
            x_a: Key-frames at 0. *Shape:* ``(..., V, 3)``.
            x_b: Key-frames at 1. *Shape:* ``(..., V, 3)``.
            t: Times in [0, 1]; those within 1e-6 of it count as its ends. *Shape:* ``(...)``, or a number.

        Returns:
            The key-frames exactly at 0 and 1. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes, dtypes, devices or times that do not fit.
            ConvergenceError: A sample did not converge, gradients are recorded and ``unconverged="raise"``.
        """
        result = self.solve(x_a, x_b, t)
        report(result.solution, self.solver)
        return result.shapes

    @disable_compile
    def solve(self, x_a: Tensor, x_b: Tensor, t: Tensor | float) -> InBetweenResult:
        """The in-betweens, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        self.check_shapes(x_a=x_a, x_b=x_b)
        times = torch.as_tensor(t, dtype=self.dtype, device=x_a.device)
        # Sums of steps end beside 0 and 1. Gradients stay, which they would not through a clamp.
        times = times + (times.detach().clamp(0, 1) - times.detach()).clamp(-ROUNDING, ROUNDING)
        hint = "for all times of all pairs pass x_a[:, None] and x_b[:, None]"
        lead = broadcast_leading(hint, x_a=x_a.shape[:-2], x_b=x_b.shape[:-2], t=times.shape)
        if is_traced(times):
            times = torch.where((times >= 0) & (times <= 1), times, torch.nan)
        else:
            run_outside_transforms(partial(_check_times, paired=self.objective.space == "paired"), times)
        dtype = torch.promote_types(x_a.dtype, x_b.dtype)
        keyframes = torch.stack(torch.broadcast_tensors(x_a.to(dtype), x_b.to(dtype)), -3)
        weights = torch.stack([1 - times, times], -1)
        result = self.solve_samples(keyframes, weights, lead)
        return result._replace(shapes=with_exact_keyframes(result.shapes, keyframes, weights))


def _check_times(t: Tensor, paired: bool) -> None:
    if paired and bool((t != 0.5).any()):
        raise ValueError("the paired space (Eq. 4) is defined at t = 1/2 only; other presets have all times")
    outside = ~((t >= 0) & (t <= 1))
    if bool(outside.any()):
        raise ValueError(f"t lies in [0, 1], from key-frame to key-frame; got {float(t[outside][0])}")
