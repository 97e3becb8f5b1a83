"""The shape half-way between two key-frames, as a layer."""

from typing import Any, Literal

from torch import Tensor, nn

from torch_modal.inbetween.results import InBetweenResult
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.layers.base import Bases
from torch_modal.layers.in_between import InBetween


class MidShape(nn.Module):
    r"""The mid-shape that is cheapest to reach from both key-frames: :class:`InBetween` at ``t = 1/2``.

    Args:
        bases: The basis at each end (:func:`torch_modal.extract_bases`), or one that serves for both.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        space: ``"joint"`` (one shape in the sum of both spaces) or ``"paired"`` (Eq. 4 of the paper), instead of the
            objective's.
        mu: Weight of the similarity of Eq. 4, in the paired space. Default: the objective's.
        preset: As for :class:`InBetween`. ``"modal"``: one shape in the sum of both modal spaces, then steps of all
            vertices. ``"paper"``: its method, whole: Eq. 4, local interpolation, the mean. Others need no modes.
        objective: What is minimised, instead of the preset's objective.
        solver: How it is solved, instead of the preset's solver.
        regions: Segments that local interpolation takes, in the paired space. Default: the solver's.

    Raises:
        ValueError: An argument is not usable.
    """

    def __init__(
        self,
        bases: Bases,
        faces: Tensor,
        space: Literal["joint", "paired"] | None = None,
        mu: float | Tensor | None = None,
        *,
        preset: Preset = "modal",
        objective: Objective | None = None,
        solver: Solver | None = None,
        regions: int | None = None,
    ) -> None:
        super().__init__()
        objective, solver = settings(preset, objective, solver, regions, space=space, mu=mu)
        self.in_between = InBetween(bases, faces, objective=objective, solver=solver)

    @property
    def space(self) -> Any:
        """The joint or paired space."""
        return self.in_between.core.space

    def solve(self, x_a: Tensor, x_b: Tensor) -> InBetweenResult:
        """The mid-shapes, and how each minimisation went, without a warning. Arguments as for :meth:`forward`.

        In the paired space the result has ``first`` and ``second``, the paper's ``x1*`` and ``x2*``, too. There, a
        shape is what the method gives, whatever its status: it is not replaced by a better one.
        """
        return self.in_between.solve(x_a, x_b, 0.5)

    def forward(self, x_a: Tensor, x_b: Tensor) -> Tensor:
        """The mid-shapes. *Shape:* ``(..., V, 3), (..., V, 3) -> (..., V, 3)``.

        Raises:
            ValueError: Shapes, dtypes or devices that do not fit.
            ConvergenceError: A sample did not converge, gradients are recorded and ``unconverged="raise"``.
        """
        return self.in_between(x_a, x_b, 0.5)
