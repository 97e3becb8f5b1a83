"""Flat batches of in-betweens, their results, and warnings about those that did not converge."""

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import is_eager, is_traced, is_transformed, run_outside_transforms
from torch_modal.elastic.implicit import ConvergenceWarning
from torch_modal.elastic.minimise import Solution, Status
from torch_modal.errors import ConvergenceError
from torch_modal.inbetween.settings import Solver


class InBetweenResult(NamedTuple):
    """Shapes with the solution that they came from."""

    shapes: Tensor
    """*Shape:* ``(..., V, 3)``; NaN where the status is ``INVALID``."""
    solution: Solution
    """One value per shape: energy, relative gradient norm, number of steps, status."""
    first: Tensor | None = None
    """In the paired space, ``x1*`` near the first key-frame; the shapes are the mean of ``first`` and ``second``."""
    second: Tensor | None = None
    """In the paired space, ``x2*`` near the second key-frame."""

    def unflatten(self, lead: torch.Size) -> "InBetweenResult":
        """A flat batch with these leading dimensions."""
        return trees.map_leaves(self, lambda x: x.reshape(lead + x.shape[1:]))  # type: ignore[no-any-return]


class Samples(NamedTuple):
    """A flat batch of weighted in-betweens; of a pair, the weights are ``(1 - t, t)``."""

    keyframes: Tensor
    """*Shape:* ``(B, K, V, 3)``."""
    weights: Tensor
    """They add up to one. *Shape:* ``(B, K)``."""
    mu: Tensor
    """*Shape:* ``(B,)``."""
    stiffness: list[Tensor]
    """Stiffness of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""


def trivial_solution(x: Tensor, usable: Tensor) -> Solution:
    """The solution where there is nothing to minimise. *Shape:* ``(B, V, 3), (B,)``."""
    number = x.detach().new_zeros(len(x))
    status = torch.where(usable, Status.CONVERGED, Status.INVALID)
    return Solution(number.new_zeros(len(x), 0), number, number.clone(), torch.zeros_like(status), status)


def join_bodies(results: Sequence[InBetweenResult], vertices: Sequence[Any]) -> InBetweenResult:
    """Results of bodies as one, from the vertices of each: with the sum of the energies, otherwise the worst of all."""
    a, *numbers = zip(*(result.solution[:5] for result in results), strict=True)
    energy, norm, n_steps, status = (torch.stack(values) for values in numbers)
    worst = (status % Status.FELL_BACK).amax(0)  # that a body fell back is the least of all
    worst = torch.where(worst > 0, worst, status.amax(0))
    shapes = torch.cat([result.shapes for result in results], 1)[:, torch.argsort(torch.cat(list(vertices)))]
    compared: Any = [(result.solution.distortion_ratio, result.solution.start_weights) for result in results]
    ratio, weights = (torch.stack(each).amax(0) for each in zip(*compared, strict=True))
    solution = Solution(torch.cat(a, 1), energy.sum(0), norm.amax(0), n_steps.amax(0), worst)
    return InBetweenResult(shapes, solution._replace(distortion_ratio=ratio, start_weights=weights))


def report(solution: Solution, solver: Solver) -> None:
    """Warn about samples that did not converge, and about those that are what they started from.

    Raises:
        ConvergenceError: Something did not converge where gradients are recorded, and that is an error.
    """
    if not is_traced(solution.status):
        forbid = solver.unconverged == "raise" and torch.is_grad_enabled()
        seen = [x for x in (solution.status, solution.distortion_ratio) if x is not None]
        run_outside_transforms(partial(_report, max_steps=solver.max_steps, forbid=forbid), *seen)


def _report(status: Tensor, ratio: Tensor | None = None, *, max_steps: int, forbid: bool) -> None:
    if not bool((status != Status.CONVERGED).any()):
        return
    counts = {kind.name: int((status == kind).sum()) for kind in Status if kind}
    fell, missed = counts.pop(Status.FELL_BACK.name), sum(counts.values())
    if missed:
        message = (
            f"{missed} of {status.numel()} in-betweens did not converge in {max_steps} steps "
            f"({', '.join(f'{n} {name}' for name, n in counts.items() if n)}): no gradient flows through their "
            "amplitudes; solve() tells which"
        )
        if forbid:
            raise ConvergenceError(message)
        warnings.warn(message, ConvergenceWarning, stacklevel=2)
    if fell:
        most = "more" if ratio is None else f"up to {float(ratio[status == Status.FELL_BACK].max()):.3g} times"
        warnings.warn(
            f"{fell} of {status.numel()} in-betweens had {most} the distortion of what they started from, the blend by "
            "local rotations or linear interpolation, which is returned instead (status FELL_BACK); more coarse faces "
            "or local steps may help: Objective(coarse_faces=...), Solver(local_steps=...)",
            ConvergenceWarning,
            stacklevel=2,
        )


def with_exact_keyframes(shapes: Tensor, keyframes: Tensor, weights: Tensor) -> Tensor:
    """In-betweens, and key-frames to the last bit where they have all the weight; gradients stay as they are.

    Non-finite in-betweens contribute neither value nor gradient there.

    Args:
        shapes: *Shape:* ``(..., V, 3)``.
        keyframes: The result has their dtype. *Shape:* ``(..., K, V, 3)``.
        weights: *Shape:* ``(..., K)``.
    """
    shapes = shapes.to(keyframes.dtype)
    if is_eager(weights) and not bool((weights == 1).any()):
        return shapes
    alone = (weights != 0).sum(-1, keepdim=True) == 1
    for x, there in zip(keyframes.unbind(-3), ((weights == 1) & alone).unbind(-1), strict=True):
        exactly = x.detach()
        if torch.is_grad_enabled() or is_transformed(shapes):
            known = shapes.detach()
            exactly = exactly + torch.where(known.isfinite(), shapes - known, 0)
        shapes = torch.where(there[..., None, None], exactly, shapes)
    return shapes
