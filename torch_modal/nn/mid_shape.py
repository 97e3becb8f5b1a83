"""The shape half-way between two key-frames, as a layer."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.basis import ModalBasis
from torch_modal.nn.frame import Frame
from torch_modal.nn.gauss_newton import GaussNewtonStep, Solution, minimise
from torch_modal.nn.joint import JointSpace
from torch_modal.nn.paired import PairedSpace
from torch_modal.nn.shell import ShellEnergy

# The best of a grid over hand, woman and horse (docs/quality.md); results change slowly with it.
DEFAULT_MU = 0.1


class ConvergenceWarning(UserWarning):
    """A minimisation stopped before its gradient vanished."""


class InBetweenResult(NamedTuple):
    """Shapes with the solution that they came from."""

    shapes: Tensor
    """*Shape:* ``(..., V, 3)``."""
    solution: Solution
    """One value per shape: energy, relative gradient norm, number of steps, converged."""


class MidShape(nn.Module):
    r"""The mid-shape :math:`x` that is cheapest to reach from both key-frames, in a space of vibration modes.

    The key-frames may be any shapes of this connectivity near those that the bases were made from. They are given in
    the caller's coordinates and units, and so is the result. A rigid motion between them is taken out first and then
    followed half-way; a rigid motion of both moves the result along.

    Args:
        bases: The basis at each end (:func:`torch_modal.extract_bases`), or one that serves for both. The modes are
            constants: no gradient reaches them.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        space: ``"joint"`` (one shape in the sum of both spaces) or ``"paired"`` (Eq. 4 of the paper).
        mu: Weight of the similarity of Eq. 4; of no effect in the joint space.
        alpha: Stretching stiffness of Eq. 5.
        beta: Bending stiffness of Eq. 5.
        gamma: Volume stiffness of Eq. 5.
        coarse_faces: Faces of the mesh that the energy is evaluated on.
        max_steps: Gauss-Newton steps at most.
        tolerance: Bound on the gradient norm, relative to the one at the start.

    Raises:
        ValueError: The bases, the faces or the space are not usable.
    """

    def __init__(
        self,
        bases: ModalBasis | Sequence[ModalBasis],
        faces: Tensor,
        space: str = "joint",
        mu: float | Tensor = DEFAULT_MU,
        *,
        alpha: float | Tensor = 500.0,
        beta: float | Tensor = 10.0,
        gamma: float | Tensor = 1000.0,
        coarse_faces: int = 1000,
        max_steps: int = 40,
        tolerance: float = 1e-8,
    ) -> None:
        super().__init__()
        frame = Frame(bases, faces, coarse_faces)
        shell = ShellEnergy(frame.coarse_faces, alpha, beta, gamma)
        if space == "joint":
            self.space: Any = JointSpace(frame, shell)
        elif space == "paired":
            self.space = PairedSpace(frame, shell, mu)
        else:
            raise ValueError(f"space is 'joint' or 'paired', got {space!r}")
        self.step = GaussNewtonStep(self.space.energy)
        self.max_steps = max_steps
        self.tolerance = tolerance

    def solve(self, x_a: Tensor, x_b: Tensor) -> InBetweenResult:
        """The mid-shapes, and how the minimisation went.

        Args:
            x_a: First key-frames. *Shape:* ``(..., V, 3)``.
            x_b: Second key-frames, broadcast against the first. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes or dtypes that do not fit.
        """
        frame = self.space.frame
        for name, x in (("x_a", x_a), ("x_b", x_b)):
            if x.shape[-2:] != frame.reference.shape or not x.is_floating_point():
                raise ValueError(
                    f"{name} must be floating-point of shape (..., {len(frame.reference)}, 3) as the bases are; got "
                    f"{tuple(x.shape)} of {x.dtype}"
                )
        lead = torch.broadcast_shapes(x_a.shape[:-2], x_b.shape[:-2])
        dtype = frame.reference.dtype
        flat_a, flat_b = (x.to(dtype).expand(*lead, *x.shape[-2:]).reshape(-1, *x.shape[-2:]) for x in (x_a, x_b))
        t = flat_a.new_full((len(flat_a),), 0.5)
        pair = frame.place(flat_a, flat_b)
        problem = self.space.problem(pair, t)
        start = t.new_zeros(len(t), self.space.n_unknowns)
        solution = minimise(self.step, start, problem.placement, self.max_steps, self.tolerance)
        shapes = frame.restore(self.space.lift(solution.amplitudes, problem), pair, t)
        result_type = torch.promote_types(x_a.dtype, x_b.dtype)
        return InBetweenResult(
            shapes.to(result_type).reshape((*lead, *shapes.shape[1:])),
            Solution(*(value.reshape((*lead, *value.shape[1:])) for value in solution)),
        )

    def forward(self, x_a: Tensor, x_b: Tensor) -> Tensor:
        """The mid-shapes. *Shape:* ``(..., V, 3), (..., V, 3) -> (..., V, 3)``.

        Args:
            x_a: First key-frames. *Shape:* ``(..., V, 3)``.
            x_b: Second key-frames. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes or dtypes that do not fit.
        """
        shapes, solution = self.solve(x_a, x_b)
        missed = ~solution.converged
        if bool(missed.any()):
            warnings.warn(
                f"{int(missed.sum())} of {missed.numel()} mid-shapes did not converge in {self.max_steps} steps "
                f"(largest relative gradient {float(solution.gradient_norm.max()):.1e}); solve() tells which",
                ConvergenceWarning,
                stacklevel=2,
            )
        return shapes
