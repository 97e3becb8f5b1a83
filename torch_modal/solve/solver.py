"""The loop that repeats Gauss-Newton steps, each sample of a batch on its own."""

import math
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.solve.gauss_newton import ENERGY_ROUNDING, AmplitudeEnergy, GaussNewtonStep

# A Gauss-Newton step that takes the energy below this fraction needs no help from the second-order term.
GOOD_DECREASE = 0.8

# Where the gradient has grown by this factor after what should have been the last Newton step, it was not the last.
GROWN = 10.0


class Status(IntEnum):
    """How the minimisation of a sample ended."""

    CONVERGED = 0
    """The gradient is within the tolerance, or as small as rounding lets it be."""
    OUT_OF_STEPS = 1
    """There was more to gain."""
    STALLED = 2
    """No step went downhill any more."""
    INVALID = 3
    """No in-between exists: NaN or infinite entries, no size, or one key-frame of a closed mesh is a mirror image."""
    FELL_BACK = 4
    """The minimiser is worse than its start, which is returned: the blend by local rotations, or linear
    interpolation. Gradients are those of the returned shape; amplitudes and energy are those of the minimiser."""


class Solution(NamedTuple):
    """Result of :func:`minimise`, one value per sample."""

    amplitudes: Tensor
    """*Shape:* ``(B, n)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient_norm: Tensor
    """Relative to the gradient norm at the start. *Shape:* ``(B,)``."""
    n_steps: Tensor
    """Steps taken, each with a Hessian of its own. *Shape:* ``(B,)``, int64."""
    status: Tensor
    """A :class:`Status` for each. *Shape:* ``(B,)``, int64."""
    n_crossing: Tensor | None = None
    """With contact, the pairs of triangles of parts that still go through each other. *Shape:* ``(B,)``, int64."""

    @property
    def usable(self) -> Tensor:
        """Whether the shape can be relied on: it converged, or is what it started from. *Shape:* ``(B,)``, bool."""
        return self.converged | (self.status == Status.FELL_BACK)

    @property
    def converged(self) -> Tensor:
        """Whether the gradient is within the tolerance. *Shape:* ``(B,)``, bool."""
        return self.status == Status.CONVERGED


def minimise(
    step: GaussNewtonStep,
    a: Tensor,
    placement: Any,
    max_steps: int = 40,
    tolerance: float = 1e-8,
    energy: Tensor | None = None,
    start: Tensor | None = None,
    n_steps: Tensor | None = None,
) -> Solution:
    """Repeat the step until every sample has converged, or cannot go on.

    Each sample takes its own path: those that are done leave the batch, and what is tried for one that needs the full
    Hessian is not tried for the others. A sample's result does not depend on its batch.

    Args:
        step: The step to repeat.
        a: Where to start. *Shape:* ``(B, n)``.
        placement: What the energy knows of each sample.
        max_steps: Give up after that many.
        tolerance: Bound on the gradient norm, relative to its value at the start.
        energy: At ``a``, where it is known. *Shape:* ``(B,)``.
        start: The gradient norm that the tolerance is relative to. Default: that at ``a``. *Shape:* ``(B,)``.
        n_steps: Steps that led to ``a``, which count. Default: none. *Shape:* ``(B,)``.
    """
    energy = step.energy.value(a, placement) if energy is None else energy
    eps, tiny = torch.finfo(energy.dtype).eps, torch.finfo(energy.dtype).tiny
    found, blank = torch.zeros_like(a), energy.new_zeros(len(a))
    # What decides are a few numbers of each sample: on the host, where a GPU is waited for twice in a step.
    norms = [None] * len(a) if start is None else start.tolist()
    taken_before = [0] * len(a) if n_steps is None else n_steps.tolist()
    each = enumerate(zip(energy.tolist(), norms, taken_before, strict=True))
    everyone = live = [_History(row, *known) for row, known in each]
    for _ in range(max_steps + 1):
        derivatives = step.energy.derivatives(a, placement, second_order=False)
        numbers = torch.stack([derivatives.gradient.norm(dim=-1), step.floor(derivatives)], 1).tolist()
        for own, (norm, floor) in zip(live, numbers, strict=True):
            own.look(norm, floor, tolerance)
        going = [own.status == Status.OUT_OF_STEPS and own.n_steps < max_steps for own in live]
        if any(going):
            needing = [still and own.slow for still, own in zip(going, live, strict=True)]
            if any(needing):
                derivatives = derivatives._replace(second_order=_second_order(step.energy, a, placement, needing))
            taken = step.take(a, energy, derivatives, placement)
            energy, promised, moved, newton = taken.energy, taken.promised, taken.moved, taken.newton.sum(-1)
            numbers = torch.stack([energy, promised, moved.to(energy), newton], 1).tolist()
            pairs = zip(live, going, numbers, strict=True)
            ways = [own.go(each, eps) if still else _STAY for own, still, each in pairs]
            a = _chosen(ways, [a, taken.amplitudes, taken.newton])
            going = [still and own.status == Status.OUT_OF_STEPS for still, own in zip(going, live, strict=True)]
        if not any(going) and len(live) == len(everyone):  # all at once, as one alone always is
            found = a.clone()
            break
        if not all(going):
            left = torch.tensor([not still for still in going], device=a.device)
            gone = [own.row for own, still in zip(live, going, strict=True) if not still]
            found[gone] = a[left]
            live = [own for own, still in zip(live, going, strict=True) if still]
            if not live:
                break
            a, energy, placement = trees.rows((a, energy, placement), torch.nonzero(~left).flatten())
    values = [[own.energy, own.norm / max(own.start, tiny)] for own in everyone]
    counts = [[own.n_steps, own.status] for own in everyone]
    reached, relative = blank.new_tensor(values).reshape(-1, 2).unbind(1)
    counted, status = torch.tensor(counts, dtype=torch.int64, device=a.device).reshape(-1, 2).unbind(1)
    return Solution(found, reached, relative, counted, status)


# Which amplitudes a sample has next: those that it has, those of the step, those of the whole Newton step.
_STAY, _STEP, _NEWTON = range(3)


class _History:
    """The state of one sample."""

    def __init__(self, row: int, energy: float, start: float | None, n_steps: int) -> None:
        self.row, self.energy, self.n_steps = row, energy, n_steps
        self.norm = math.inf
        #: The gradient norm that the tolerance is relative to.
        self.start = math.inf if start is None else start
        self.status = Status.OUT_OF_STEPS
        #: Whether it needs the full Hessian, and whether its next Newton step was to be the last.
        self.slow = self.last = False

    def look(self, norm: float, floor: float, tolerance: float) -> None:
        """Whether it has arrived."""
        before, self.norm = self.norm, norm
        if self.start == math.inf:
            self.start = norm
        if not (math.isfinite(norm) and math.isfinite(self.energy)):
            self.status = Status.INVALID
        elif norm <= max(tolerance * self.start, floor) or (self.last and norm <= GROWN * before):
            self.status = Status.CONVERGED

    def go(self, numbers: list[float], eps: float) -> int:
        """Choose the next step, or set the status with which the sample ends."""
        energy, promised, moved, newton = numbers
        # Where all that is left to gain drowns in the rounding of the energy, nothing compares steps any more: a whole
        # Newton step is taken, and is the last.
        drowned = promised <= ENERGY_ROUNDING * eps * abs(self.energy)
        self.last = self.slow and drowned and math.isfinite(newton)
        if self.slow and not moved and not self.last:
            self.status = Status.CONVERGED if drowned else Status.STALLED
            return _STAY
        self.slow = self.slow or not moved or energy > GOOD_DECREASE * self.energy
        self.n_steps += bool(moved or self.last)
        self.energy = energy
        return _NEWTON if self.last else _STEP


def _chosen(ways: list[int], amplitudes: list[Tensor]) -> Tensor:
    """By sample. *Shape of each:* ``(B, n)``."""
    if len(set(ways)) == 1:
        return amplitudes[ways[0]]
    return torch.stack(amplitudes)[ways, list(range(len(ways)))]


def _blank_solution(a: Tensor) -> Solution:
    number = a.new_zeros(len(a))
    whole = torch.zeros_like(number, dtype=torch.int64)
    return Solution(torch.zeros_like(a), number, number.clone(), whole, whole.clone())


def unmoved(t: Tensor, n_unknowns: int, usable: Tensor) -> Solution:
    """Where there is nothing to do: amplitudes of zero, at the optimum. *Shape:* ``(B,)``."""
    blank = _blank_solution(t.detach().new_zeros(len(t), n_unknowns))
    return blank._replace(status=torch.where(usable, Status.CONVERGED, Status.INVALID))


def _second_order(energy: AmplitudeEnergy, a: Tensor, placement: Any, where: list[bool]) -> Tensor:
    """The second-order term of some samples; NaN, which rules its direction out, for the others."""
    if all(where):
        return energy.second_order(a, placement)
    chosen = torch.tensor(where, device=a.device).nonzero().flatten()
    whole = a.new_full((len(a), a.shape[-1], a.shape[-1]), torch.nan)
    whole[chosen] = energy.second_order(a[chosen], trees.rows(placement, chosen))
    return whole
