"""Shapes between two key-frames at any time, as a differentiable layer."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.nn.between import Between, InBetweenResult, report
from torch_modal.nn.solver import Solution
from torch_modal.precompute.basis import ModalBasis

# The best of a grid over three spans of a hand (tests/benchmarks/quality.py); it depends on the mesh.
DEFAULT_MU = 1.0


class InBetween(nn.Module):
    r"""Shapes :math:`x(t)` that are cheapest to reach from both key-frames, in a space of vibration modes.

    The key-frames may be any shapes of this connectivity near those that the bases were made from. They are given in
    the caller's coordinates and units, and so is the result. A rigid motion between them is taken out first and then
    followed along its geodesic; a rigid motion of both moves the result along. At half a turn, where both senses are
    equally short, the one that kornia's quaternion gives is taken.

    Gradients reach the key-frames, the times, ``mu`` and the stiffnesses. The modes are constants.

    Args:
        bases: The bases (:func:`torch_modal.extract_bases`); one alone serves for both ends.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        space: ``"joint"`` (one shape in the sum of both spaces) or ``"paired"`` (Eq. 4 of the paper, t = 1/2 only).
        mu: Weight of the similarity of Eq. 4; of no effect in the joint space.
        pairs: Which bases belong together, where there are more than two. Default: each with the next.
        alpha: Stretching stiffness of Eq. 5: a number, or a tensor or parameter of one value or ``(B,)``.
        beta: Bending stiffness of Eq. 5, likewise.
        gamma: Volume stiffness of Eq. 5, likewise.
        coarse_faces: Faces of the mesh that the energy is evaluated on.
        max_steps: Gauss-Newton steps at most; exactly that many with ``gradient="unroll"``.
        tolerance: Bound on the gradient norm, relative to the one at the start.
        least_gain: A step that promises less than this part of the energy is the last one. At 0.01 the result is the
            same to the eye at half the time; gradients are then only as exact. 0 goes on to the tolerance.
        gradient: ``"implicit"`` (by the implicit function theorem with the full Hessian; memory does not grow with the
            steps) or ``"unroll"`` (through all steps).
        unconverged: What happens when samples did not converge: ``"warn"`` warns and lets no gradient flow through
            their amplitudes, ``"raise"`` raises where gradients are recorded. With ``gradient="unroll"`` only
            :meth:`solve` tells.
        rotations: Whether the modes are added to a blend by local rotations of the triangles, in place of linear
            interpolation: less is then left for them to do. Joint space only. It solves a sparse system on the CPU.
        local: Whether all vertices take a few steps on the fine mesh at the end, for what the modes cannot reach:
            fingertips, hooves, creases. Gradients go through these steps; they cost memory in proportion to V.
        polish: Further steps on the fine mesh, each four times as long; two come within 2 % of the optimum.

    Raises:
        ValueError: An argument is not usable.
    """

    def __init__(
        self,
        bases: ModalBasis | Sequence[ModalBasis],
        faces: Tensor,
        space: str = "joint",
        mu: float | Tensor = DEFAULT_MU,
        *,
        pairs: Sequence[tuple[int, int]] | None = None,
        alpha: float | Tensor = 500.0,
        beta: float | Tensor = 10.0,
        gamma: float | Tensor = 1000.0,
        coarse_faces: int = 1000,
        max_steps: int = 40,
        tolerance: float = 1e-10,
        least_gain: float = 0.0,
        gradient: str = "implicit",
        unconverged: str = "warn",
        rotations: bool = False,
        local: bool = False,
        polish: int = 0,
    ) -> None:
        super().__init__()
        bases = [bases, bases] if isinstance(bases, ModalBasis) else list(bases)
        if len(bases) < 2:
            raise ValueError(f"an in-between needs two bases, got {len(bases)}; pass [basis_a, basis_b]")
        if gradient not in ("implicit", "unroll"):
            raise ValueError(f"gradient is 'implicit' or 'unroll', got {gradient!r}")
        if unconverged not in ("warn", "raise"):
            raise ValueError(f"unconverged is 'warn' or 'raise', got {unconverged!r}")
        if rotations and space == "paired":
            raise ValueError("rotations=True needs space='joint': Eq. 4 of the paired space starts from the key-frames")
        if not 0 <= least_gain < 1:
            raise ValueError(f"least_gain is a part of the energy, from 0 to less than 1; got {least_gain!r}")
        if not isinstance(polish, int) or polish < 0:
            raise ValueError(f"polish is a number of steps, 0 or more; got {polish!r}")
        self.pairs = list(pairs) if pairs is not None else [(i, i + 1) for i in range(len(bases) - 1)]
        if not self.pairs or any(not 0 <= i < len(bases) for pair in self.pairs for i in pair):
            raise ValueError(f"pairs hold indices of {len(bases)} bases, got {self.pairs}")
        self.members = nn.ModuleList(
            Between(
                [bases[i], bases[j]], faces, space, mu, (alpha, beta, gamma), coarse_faces, rotations, local, polish
            )
            for i, j in self.pairs
        )
        self.max_steps = max_steps
        self.tolerance = tolerance
        self.least_gain = least_gain
        self.gradient = gradient
        self.unconverged = unconverged

    def solve(self, x_a: Tensor, x_b: Tensor, t: Tensor | float, pair: Tensor | int = 0) -> InBetweenResult:
        """The in-betweens, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        return self._batched(x_a, x_b, t, pair, None)

    def _batched(
        self, x_a: Tensor, x_b: Tensor, t: Tensor | float, pair: Tensor | int, report: Callable[[Solution], None] | None
    ) -> InBetweenResult:
        times = self._check(x_a, x_b, t)
        lead = torch.broadcast_shapes(x_a.shape[:-2], x_b.shape[:-2], times.shape[:-1])
        n_times, item = times.shape[-1], x_a.shape[-2:]
        flat_t = times.expand(*lead, n_times).reshape(-1)
        flat_a, flat_b = (
            x.to(self.dtype).expand(*lead, *item)[..., None, :, :].expand(*lead, n_times, *item).reshape(-1, *item)
            for x in (x_a, x_b)
        )
        result = self._solve(flat_a, flat_b, flat_t, self._chosen(pair, lead, n_times), report)
        result_type = torch.promote_types(x_a.dtype, x_b.dtype)
        shapes = result.shapes.to(result_type).reshape(*lead, n_times, *item)
        # The ends are the key-frames to the last bit; their gradients are those of the in-between there.
        for end, x in ((0, x_a), (1, x_b)):
            exact = x[..., None, :, :].to(result_type).detach() + (shapes - shapes.detach())
            shapes = torch.where((times == end)[..., None, None], exact, shapes)
        return InBetweenResult(
            shapes, Solution(*(value.reshape(*lead, n_times, *value.shape[1:]) for value in result.solution))
        )

    def forward(self, x_a: Tensor, x_b: Tensor, t: Tensor | float, pair: Tensor | int = 0) -> Tensor:
        """The in-betweens.

        Args:
            x_a: Key-frames at 0. *Shape:* ``(..., V, 3)``.
            x_b: Key-frames at 1. *Shape:* ``(..., V, 3)``.
            t: Times in [0, 1], the same for all samples or each its own. *Shape:* ``(T,)``, ``(..., T)``, or a number.
            pair: Which of the ``pairs`` each sample lies between. *Shape:* ``(...)``, or one number.

        Returns:
            The key-frames exactly at 0 and 1. *Shape:* ``(..., T, V, 3)``.

        Raises:
            ValueError: Shapes, dtypes, devices or times that do not fit.
            ConvergenceError: A sample did not converge, gradients are recorded and ``unconverged="raise"``.
        """
        forbid = self.unconverged == "raise" and torch.is_grad_enabled()
        return self._batched(x_a, x_b, t, pair, partial(report, max_steps=self.max_steps, forbid=forbid)).shapes

    @property
    def dtype(self) -> torch.dtype:
        """What is computed in."""
        return self._reference.dtype

    @property
    def _reference(self) -> Tensor:
        space: Any = self.members[0].space
        return space.frame.reference

    def _solve(
        self, x_a: Tensor, x_b: Tensor, t: Tensor, chosen: Tensor | int, report: Callable[[Solution], None] | None
    ) -> InBetweenResult:
        options = (self.gradient, self.max_steps, self.tolerance, self.least_gain, report)
        if isinstance(chosen, int):
            return self.members[chosen](x_a, x_b, t, *options)
        order, parts = [], []
        for i, member in enumerate(self.members):
            mine = torch.nonzero(chosen == i).flatten()
            if len(mine):
                order.append(mine)
                parts.append(member(x_a[mine], x_b[mine], t[mine], *options))
        back = torch.argsort(torch.cat(order))
        widest = max(part.solution.amplitudes.shape[-1] for part in parts)
        amplitudes = torch.cat(
            [nn.functional.pad(p.solution.amplitudes, (0, widest - p.solution.amplitudes.shape[-1])) for p in parts]
        )
        others = [torch.cat(values)[back] for values in zip(*(part.solution[1:] for part in parts), strict=True)]
        shapes = torch.cat([part.shapes for part in parts])
        return InBetweenResult(shapes[back], Solution(amplitudes[back], *others))

    def _chosen(self, pair: Tensor | int, lead: torch.Size, n_times: int) -> Tensor | int:
        if isinstance(pair, int) or pair.dim() == 0 or len(self.members) == 1:
            pair = int(pair) if isinstance(pair, int) or pair.dim() == 0 else 0
            if not 0 <= pair < len(self.members):
                raise ValueError(f"pair is one of 0 to {len(self.members) - 1}, got {pair}")
            return pair
        if bool(((pair < 0) | (pair >= len(self.members))).any()):
            raise ValueError(f"pair holds numbers from 0 to {len(self.members) - 1}, got up to {int(pair.max())}")
        return pair.expand(lead)[..., None].expand(*lead, n_times).reshape(-1)

    def _check(self, x_a: Tensor, x_b: Tensor, t: Tensor | float) -> Tensor:
        """Times as a tensor ``(..., T)``."""
        reference = self._reference
        for name, x in (("x_a", x_a), ("x_b", x_b)):
            if x.shape[-2:] != reference.shape or not x.is_floating_point():
                raise ValueError(
                    f"{name} must be floating-point of shape (..., {len(reference)}, 3) as the bases are; got "
                    f"{tuple(x.shape)} of {x.dtype}"
                )
            if x.device != reference.device:
                raise ValueError(f"{name} is on {x.device}, the layer on {reference.device}; move one with .to()")
        times = torch.as_tensor(t, dtype=reference.dtype, device=reference.device)
        return times[None] if times.dim() == 0 else times
