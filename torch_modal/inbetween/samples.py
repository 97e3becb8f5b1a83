"""Flat batches of inputs and results of one pair of bases; warnings about samples that did not converge."""

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import traced, transformed
from torch_modal.geometry.hermite import Spacing
from torch_modal.solve.adjoint import ConvergenceWarning
from torch_modal.solve.solver import Solution, Status


class ConvergenceError(RuntimeError):
    """A gradient was requested through a minimisation that did not converge."""


class InBetweenResult(NamedTuple):
    """Shapes with the solution that they came from."""

    shapes: Tensor
    """*Shape:* ``(..., V, 3)``; NaN where the status is ``INVALID``."""
    solution: Solution
    """One value per shape: energy, relative gradient norm, number of steps, status."""


class Samples(NamedTuple):
    """A flat batch of in-betweens."""

    x_a: Tensor
    """Key-frames at 0. *Shape:* ``(P, V, 3)``."""
    x_b: Tensor
    """Key-frames at 1. *Shape:* ``(P, V, 3)``."""
    which: Tensor | None
    """Which of the P pairs each sample lies between; each its own where None. *Shape:* ``(B,)``."""
    t: Tensor
    """*Shape:* ``(B,)``."""
    mu: Tensor
    """*Shape:* ``(B,)``."""
    stiffness: list[Tensor]
    """Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
    before: Tensor | None = None
    """The key-frames before those at 0, for trajectories that are smooth in time. *Shape:* ``(P, V, 3)``."""
    after: Tensor | None = None
    """The key-frames after those at 1. *Shape:* ``(P, V, 3)``."""
    spacing: Spacing | None = None
    """Durations of the three intervals; None for the pair alone. *Shape of each:* ``(P,)``."""

    def rows(self, some: Tensor) -> "Samples":
        """Some of the samples, of the same pairs. *Shape:* ``(S,)``."""
        of = torch.arange(len(self.t), device=some.device) if self.which is None else self.which
        stiffness = [values[some] for values in self.stiffness]
        return self._replace(which=of[some], t=self.t[some], mu=self.mu[some], stiffness=stiffness)


def report(solution: Solution, max_steps: int, forbid: bool) -> None:
    """Warn about samples that did not converge.

    Args:
        solution: One value per sample.
        max_steps: The limit of the solver.
        forbid: Whether it is an error.

    Raises:
        ConvergenceError: Something did not converge, and that is an error.
    """
    missed = ~solution.usable
    if not bool(missed.any()):
        return
    counts = {status.name: int((solution.status == status).sum()) for status in Status if status}
    counts.pop(Status.FELL_BACK.name)
    message = (
        f"{int(missed.sum())} of {missed.numel()} in-betweens did not converge in {max_steps} steps "
        f"({', '.join(f'{n} {name}' for name, n in counts.items() if n)}): no gradient flows through their amplitudes; "
        "solve() tells which"
    )
    if forbid:
        raise ConvergenceError(message)
    warnings.warn(message, ConvergenceWarning, stacklevel=2)


def warn_of_starts(solution: Solution) -> None:
    """Say how many shapes are the ones that they started from.

    Args:
        solution: One value per sample.
    """
    fell = solution.status == Status.FELL_BACK
    if traced(fell) or transformed(fell) or not bool(fell.any()):
        return
    warnings.warn(
        f"{int(fell.sum())} of {fell.numel()} in-betweens came out worse than what they started from, the blend by "
        "local rotations or linear interpolation, which is returned in their place (status FELL_BACK); more coarse "
        "faces or local steps may help: Objective(coarse_faces=...), Solver(local_steps=...)",
        ConvergenceWarning,
        stacklevel=2,
    )
