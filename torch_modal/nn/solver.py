"""The damped Gauss-Newton step on modal amplitudes, and the loop that repeats it."""

import math
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torch_modal.nn import trees
from torch_modal.nn.modal_energy import Derivatives

# Fractions of a step that are tried, side by side, where the whole step disappoints.
STEP_LENGTHS = (0.5, 0.25, 0.1, 0.03, 0.003)

# A whole step is good if the energy falls by this part of what its quadratic model says.
GOOD_AGREEMENT = 0.5

# A Gauss-Newton step that takes the energy below this fraction needs no help from the second-order term.
GOOD_DECREASE = 0.8

# Of saddle-free Newton steps, relative to Gauss-Newton's Hessian.
LEAST_CURVATURE = 0.1

# Where the gradient has grown by this factor after what should have been the last Newton step, it was not the last.
GROWN = 10.0

# A Newton step that promises less than this part of the energy is followed by steps with the same Hessian, which cost a
# gradient each, while that falls by this factor.
NEAR = 0.01
FALLS = 0.25
MOST_WITH_ONE_HESSIAN = 12

# Rounding errors add up along the sum over edges and hinges; this many times their size is as far as a gradient goes.
ROUNDING_MARGIN = 4.0
ENERGY_ROUNDING = 64.0


class AmplitudeEnergy(Protocol):
    """What can be minimised here: an energy of amplitudes, with its derivatives."""

    def value(self, a: Tensor, placement: Any) -> Tensor:
        """Energy. *Shape:* ``(..., B, n) -> (..., B)``."""

    def derivatives(self, a: Tensor, placement: Any, second_order: bool = True) -> Derivatives:
        """Derivatives. *Shape:* ``(B, n)``."""

    def gradient(self, a: Tensor, placement: Any) -> Tensor:
        """The gradient alone. *Shape:* ``(B, n)``."""

    def second_order(self, a: Tensor, placement: Any) -> Tensor:
        """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""

    def pull_back(self, a: Tensor, direction: Tensor, placement: Any) -> Any:
        """Gradient of ``direction . dE/da`` in all that the placement holds. *Shape:* ``(B, n), (B, n)``."""


class Step(NamedTuple):
    """One step of every sample of a batch."""

    amplitudes: Tensor
    """*Shape:* ``(B, n)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient_norm: Tensor
    """Before the step. *Shape:* ``(B,)``."""
    promised: Tensor
    """Decrease of the energy that the quadratic model expects of the whole step. *Shape:* ``(B,)``."""
    moved: Tensor
    """False where no step was found that does not go uphill. *Shape:* ``(B,)``, bool."""
    newton: Tensor
    """Where a whole Newton step leads; NaN where none was asked for or the Hessian is indefinite.

    *Shape:* ``(B, n)``.
    """
    factor: Tensor | None
    """Of the full Hessian, where one was asked for. *Shape:* ``(B, n, n)``."""


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
    ENOUGH = 4
    """The next step promised less than ``least_gain`` of the energy: a good shape, and no exact gradient."""


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
    def converged(self) -> Tensor:
        """Whether the gradient is within the tolerance. *Shape:* ``(B,)``, bool."""
        return self.status == Status.CONVERGED

    @property
    def usable(self) -> Tensor:
        """Whether the shape is what was asked for: converged, or close enough by ``least_gain``. *Shape:* ``(B,)``."""
        return self.converged | (self.status == Status.ENOUGH)


class GaussNewtonStep(nn.Module):
    """One damped step of every sample of a batch, never uphill.

    The residual at the optimum is large: Gauss-Newton alone gains a digit every six steps there, and the full Hessian
    alone is often indefinite far from it. Both directions are tried, at several step lengths, in one batched evaluation
    of the energy; the lowest wins. A sample where none is lower stays where it is::

        shell = tm.ShellEnergy(faces)
        energy = tm.ModalEnergy(shell, basis.modes)
        placement = energy.place(start, shell.against(rest))  # both (B, V, 3)
        step = tm.GaussNewtonStep(energy)
        a = torch.zeros(len(start), basis.n_modes, dtype=start.dtype)
        for _ in range(10):
            a = step(a, placement).amplitudes
        x = start + torch.tensordot(a, basis.modes, 1)

    Args:
        energy: What is minimised.
        damping: Ridge on the Hessian, relative to its mean diagonal. The line search does the globalisation; the
            ridge only keeps directions that do nothing (coincident key-frames) from breaking the factorisation.
            Default: 1e-12 in float64, 1e-6 in float32.
    """

    def __init__(self, energy: AmplitudeEnergy, damping: float | None = None) -> None:
        super().__init__()
        self.energy = energy
        self.damping = damping

    def ridged(self, hessian: Tensor) -> Tensor:
        """A Hessian with the ridge. *Shape:* ``(..., n, n)``."""
        damping = self.damping
        if damping is None:
            damping = 1e-12 if hessian.dtype == torch.float64 else 1e-6
        size = hessian.diagonal(dim1=-2, dim2=-1).mean(-1)
        ridge = damping * size.abs() + torch.finfo(size.dtype).tiny
        return hessian + torch.diag_embed(ridge[..., None].expand(hessian.shape[:-1]))

    def directions(self, derivatives: Derivatives) -> Tensor:
        """Directions ``-H^-1 g`` of Gauss-Newton and, where given, of the full Hessian.

        Returns:
            NaN for a sample whose Hessian is not positive definite. *Shape:* ``(D, B, n)``.
        """
        return self._factored(derivatives)[0]

    def _factored(self, derivatives: Derivatives) -> tuple[Tensor, Tensor]:
        """The same, with the factors of the Hessians. *Shape:* ``(D, B, n), (D, B, n, n)``."""
        hessians = derivatives.gauss_newton[None]
        if derivatives.second_order is not None:
            hessians = torch.cat([hessians, hessians + derivatives.second_order])
        hessians = self.ridged(hessians)
        factor, info = torch.linalg.cholesky_ex(hessians)
        definite = info == 0
        if torch.is_grad_enabled():
            # A failed factorisation that is not used would still give NaN gradients.
            eye = torch.eye(hessians.shape[-1], dtype=hessians.dtype, device=hessians.device)
            factor, _ = torch.linalg.cholesky_ex(torch.where(definite[..., None, None], hessians, eye))
        gradient = derivatives.gradient.expand(len(hessians), -1, -1)[..., None]
        direction = -torch.cholesky_solve(gradient, factor).squeeze(-1)
        return torch.where(definite[..., None], direction, torch.nan), factor

    @staticmethod
    def floor(derivatives: Derivatives) -> Tensor:
        """Gradient norm below which there is only rounding. *Shape:* ``(B,)``."""
        return ROUNDING_MARGIN * derivatives.resolution

    def take(self, a: Tensor, energy: Tensor, derivatives: Derivatives, placement: Any) -> Step:
        """The best of the candidate steps from a point whose derivatives are known."""
        plain, factors = self._factored(derivatives)
        directions = self._past_saddles(plain, derivatives)
        best, lowest = self.lowest(a, directions, placement)
        promised = self._promised(directions, derivatives)
        poor = energy - lowest < GOOD_AGREEMENT * promised
        if bool(poor.any()):
            shorter, energies = self.lowest(a, self._shortened(directions), placement)
            improves = poor & (energies < lowest)
            best = torch.where(improves[:, None], shorter, best)
            lowest = torch.where(improves, energies, lowest)
        found = self._unless_uphill(a, energy, best, lowest, promised, derivatives)
        return found if derivatives.second_order is None else found._replace(newton=a + plain[1], factor=factors[1])

    def forward(self, a: Tensor, placement: Any) -> Step:
        """Take one step, trying both directions at all lengths, without a branch that depends on data.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: What the energy knows of each sample.
        """
        derivatives = self.energy.derivatives(a, placement)
        directions = self.directions(derivatives)
        best, lowest = self.lowest(a, torch.cat([directions, self._shortened(directions)]), placement)
        promised = self._promised(directions, derivatives)
        value = self.energy.value(a, placement)
        found = self._unless_uphill(a, value, best, lowest, promised, derivatives)
        return found._replace(newton=a + directions[-1])

    def _past_saddles(self, directions: Tensor, derivatives: Derivatives) -> Tensor:
        """The directions, with saddle-free Newton (Dauphin et al. 2014) where the full Hessian is indefinite.

        Negative eigenvalues are turned positive, so that what Newton's method would climb is run down. They are taken
        relative to Gauss-Newton's Hessian, which is the scale of this problem. Near triangles that are about to
        collapse, Gauss-Newton's direction alone crawls along such a ridge for dozens of steps.
        """
        if derivatives.second_order is None:
            return directions
        indefinite = ~directions[1].isfinite().all(-1) & derivatives.second_order.isfinite().all(-1).all(-1)
        chosen = torch.nonzero(indefinite).flatten()
        if not len(chosen):
            return directions
        factor, _ = torch.linalg.cholesky_ex(self.ridged(derivatives.gauss_newton[chosen]))

        def whitened(columns: Tensor) -> Tensor:
            return torch.linalg.solve_triangular(factor, columns, upper=False)

        relative = whitened(whitened(derivatives.second_order[chosen]).mT)
        finite = relative.isfinite().all(-1).all(-1)[:, None, None]
        eigenvalues, vectors = torch.linalg.eigh(torch.where(finite, 0.5 * (relative + relative.mT), 0))
        curvatures = (1 + eigenvalues).abs().clamp_min(LEAST_CURVATURE)
        slope = vectors.mT @ whitened(derivatives.gradient[chosen, :, None])
        step = torch.linalg.solve_triangular(factor.mT, -vectors @ (slope / curvatures[..., None]), upper=True)
        return directions.index_put((torch.ones_like(chosen), chosen), step.squeeze(-1))

    @staticmethod
    def _shortened(directions: Tensor) -> Tensor:
        """Shorter steps along each direction. *Shape:* ``(D, B, n) -> (D * L, B, n)``."""
        return torch.cat([length * directions for length in STEP_LENGTHS])

    @staticmethod
    def _promised(directions: Tensor, derivatives: Derivatives) -> Tensor:
        """The quadratic model of a Newton step falls by half the slope along it. *Shape:* ``(D, B, n) -> (B,)``."""
        promised = -0.5 * (directions * derivatives.gradient).sum(-1)
        return torch.where(promised.isfinite(), promised, 0).amax(0)

    @staticmethod
    def _unless_uphill(
        a: Tensor,
        energy: Tensor,
        best: Tensor,
        lowest: Tensor,
        promised: Tensor,
        derivatives: Derivatives,
    ) -> Step:
        # At the optimum the energy is flat to rounding while the gradient still has digits to gain.
        moved = lowest <= energy + 4 * torch.finfo(energy.dtype).eps * energy.abs()
        norm = derivatives.gradient.norm(dim=-1)
        reached = torch.where(moved[:, None], best, a)
        newton = torch.full_like(a, torch.nan)
        return Step(reached, torch.where(moved, lowest, energy), norm, promised, moved, newton, None)

    def settled(self, a: Tensor, taken: Step, near: Tensor, small: Tensor, placement: Any) -> tuple[Tensor, Tensor]:
        """Further steps with the Hessian of the last one, never uphill.

        Args:
            a: Where that one led. *Shape:* ``(B, n)``.
            taken: That one.
            near: Which samples go further. *Shape:* ``(B,)``, bool.
            small: Gradient norms from which on there is one more step. *Shape:* ``(B,)``.
            placement: What the energy knows of each sample.

        Returns:
            Where they lead, and the energy there.
        """
        assert taken.factor is not None
        start, energy, norm = a, taken.energy, taken.gradient_norm
        for _ in range(MOST_WITH_ONE_HESSIAN):
            gradient = self.energy.gradient(a, placement)
            found = gradient.norm(dim=-1)
            near = near & (found <= FALLS * norm)
            further = torch.cholesky_solve(gradient[..., None], taken.factor).squeeze(-1)
            a, norm = torch.where(near[:, None], a - further, a), torch.where(near, found, norm)
            near = near & (found > small)
            if not bool(near.any()):
                break
        reached = self.energy.value(a, placement)
        downhill = reached <= energy + ENERGY_ROUNDING * torch.finfo(energy.dtype).eps * energy.abs()
        return torch.where(downhill[:, None], a, start), torch.where(downhill, reached, energy)

    def lowest(self, a: Tensor, steps: Tensor, placement: Any) -> tuple[Tensor, Tensor]:
        """Where the energy is lowest after one of the steps ``(D, B, n)``, and how low; ``a`` if nowhere finite."""
        usable = steps.isfinite().all(-1)
        candidates = a + torch.where(usable[..., None], steps, 0)
        energies = self.energy.value(candidates, placement)
        energies = torch.where(usable & energies.isfinite(), energies, torch.inf)
        if len(steps) == 1:
            return torch.where((energies[0] < torch.inf)[:, None], candidates[0], a), energies[0]
        lowest, index = energies.min(0)
        return candidates.gather(0, index[None, :, None].expand(1, *a.shape)).squeeze(0), lowest


def minimise(
    step: GaussNewtonStep,
    a: Tensor,
    placement: Any,
    max_steps: int = 40,
    tolerance: float = 1e-8,
    least_gain: float = 0.0,
    energy: Tensor | None = None,
    hessians: list[Tensor] | None = None,
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
        least_gain: Where a step promises less than this part of the energy, it is the last one. The gradient norm of
            the solution is then the one before that step.
        energy: At the start, where it is known. *Shape:* ``(B,)``.
        hessians: Receives Gauss-Newton's at the amplitudes of those that converged. *Shape:* ``(B, n, n)``.
    """
    energy = step.energy.value(a, placement) if energy is None else energy
    eps, tiny = torch.finfo(energy.dtype).eps, torch.finfo(energy.dtype).tiny
    found, blank = torch.zeros_like(a), energy.new_zeros(len(a))
    inner = None if hessians is None else a.new_zeros(*a.shape, a.shape[-1])
    # What decides are a few numbers of each sample: on the host, where a GPU is waited for twice in a step.
    everyone = live = [_Course(row, value) for row, value in enumerate(energy.tolist())]
    for k in range(max_steps + 1):
        derivatives = step.energy.derivatives(a, placement, second_order=False)
        told = torch.stack([derivatives.gradient.norm(dim=-1), step.floor(derivatives)], 1).tolist()
        for own, (norm, floor) in zip(live, told, strict=True):
            own.look(norm, floor, tolerance, k == 0)
        going = [own.status == Status.OUT_OF_STEPS and k < max_steps for own in live]
        if any(going):
            needing = [still and own.slow for still, own in zip(going, live, strict=True)]
            if any(needing):
                derivatives = derivatives._replace(second_order=_second_order(step.energy, a, placement, needing))
            taken = step.take(a, energy, derivatives, placement)
            energy, promised, moved, newton = taken.energy, taken.promised, taken.moved, taken.newton.sum(-1)
            numbers = torch.stack([energy, promised, moved.to(energy), newton], 1).tolist()
            pairs = zip(live, going, numbers, strict=True)
            ways = [own.go(each, eps, least_gain) if still else _STAY for own, still, each in pairs]
            a = _chosen(ways, [a, taken.amplitudes, taken.newton])
            near = [still and own.near and not least_gain for still, own in zip(going, live, strict=True)]
            if any(near):
                small = a.new_tensor(
                    [max(tolerance * own.start, floor) for own, (_, floor) in zip(live, told, strict=True)]
                )
                a, energy = step.settled(a, taken, torch.tensor(near, device=a.device), small, placement)
                for own, value in zip(live, energy.tolist(), strict=True):
                    own.energy = value
            going = [still and own.status == Status.OUT_OF_STEPS for still, own in zip(going, live, strict=True)]
        if not any(going) and len(live) == len(everyone):  # all at once, as one alone always is
            found, inner = a.clone(), None if inner is None else derivatives.gauss_newton
            break
        if not all(going):
            left = torch.tensor([not still for still in going], device=a.device)
            gone = [own.row for own, still in zip(live, going, strict=True) if not still]
            found[gone] = a[left]
            if inner is not None:
                inner[gone] = derivatives.gauss_newton[left]
            live = [own for own, still in zip(live, going, strict=True) if still]
            if not live:
                break
            a, energy, placement = trees.rows((a, energy, placement), torch.nonzero(~left).flatten())
    if hessians is not None and inner is not None:
        hessians.append(inner)
    values = [[own.energy, own.norm / max(own.start, tiny)] for own in everyone]
    counts = [[own.n_steps, own.status] for own in everyone]
    reached, norms = blank.new_tensor(values).reshape(-1, 2).unbind(1)
    n_steps, status = torch.tensor(counts, dtype=torch.int64, device=a.device).reshape(-1, 2).unbind(1)
    return Solution(found, reached, norms, n_steps, status)


# Which amplitudes a sample has next: those that it has, those of the step, those of the whole Newton step.
_STAY, _STEP, _NEWTON = range(3)


class _Course:
    """What one sample has gone through."""

    def __init__(self, row: int, energy: float) -> None:
        self.row, self.energy = row, energy
        self.norm = self.start = math.inf
        self.n_steps = 0
        self.status = Status.OUT_OF_STEPS
        #: Whether it needs the full Hessian, and whether its next Newton step was to be the last.
        self.slow = self.last = False
        #: Whether the Hessian of the last step is good for others.
        self.near = False

    def look(self, norm: float, floor: float, tolerance: float, first: bool) -> None:
        """Whether it has arrived."""
        before, self.norm = self.norm, norm
        if first:
            self.start = norm
        if not (math.isfinite(norm) and math.isfinite(self.energy)):
            self.status = Status.INVALID
        elif norm <= max(tolerance * self.start, floor) or (self.last and norm <= GROWN * before):
            self.status = Status.CONVERGED

    def go(self, told: list[float], eps: float, least_gain: float) -> int:
        """Which way it goes from here, or the status with which it ends, by what is told of a step."""
        energy, promised, moved, newton = told
        # Where all that is left to gain drowns in the rounding of the energy, nothing compares steps any more: a whole
        # Newton step is taken, and is the last.
        drowned = promised <= ENERGY_ROUNDING * eps * abs(self.energy)
        self.last = self.slow and drowned and math.isfinite(newton)
        self.near = bool(moved) and not self.last and math.isfinite(newton) and promised < NEAR * abs(self.energy)
        if self.slow and not moved and not self.last:
            self.status = Status.CONVERGED if drowned else Status.STALLED
            return _STAY
        if moved and promised < least_gain * abs(self.energy):
            self.status = Status.ENOUGH
        self.slow = self.slow or not moved or energy > GOOD_DECREASE * self.energy
        self.n_steps += bool(moved or self.last)
        self.energy = energy
        return _NEWTON if self.last and self.status != Status.ENOUGH else _STEP


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
