"""The damped Gauss-Newton step on modal amplitudes."""

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torch_modal.autograd import full_precision
from torch_modal.energy.modal_energy import Derivatives

# Fractions of a step that are tried, side by side, where the whole step disappoints.
STEP_LENGTHS = (0.5, 0.25, 0.1, 0.03, 0.003)

# A whole step is good if the energy falls by this part of what its quadratic model says.
GOOD_AGREEMENT = 0.5

# Of saddle-free Newton steps, relative to Gauss-Newton's Hessian.
LEAST_CURVATURE = 0.1

# Rounding errors add up along the sum over edges and hinges; this many times their size is as far as a gradient goes.
ROUNDING_MARGIN = 4.0
ENERGY_ROUNDING = 64.0


class AmplitudeEnergy(Protocol):
    """Protocol of an energy of amplitudes with its derivatives."""

    def value(self, a: Tensor, placement: Any) -> Tensor:
        """Energy. *Shape:* ``(..., B, n) -> (..., B)``."""

    def derivatives(self, a: Tensor, placement: Any, second_order: bool = True) -> Derivatives:
        """Derivatives. *Shape:* ``(B, n)``."""

    def value_and_gradient(self, a: Tensor, placement: Any) -> tuple[Tensor, Tensor]:
        """Energy and gradient. *Shape:* ``(B, n) -> (B,), (B, n)``."""

    def second_order(self, a: Tensor, placement: Any) -> Tensor:
        """The second-order term of the full Hessian. *Shape:* ``(B, n, n)``."""

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
    """Where a whole Newton step leads; NaN where none was requested or the Hessian is indefinite.

    *Shape:* ``(B, n)``.
    """


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
        return torch.where(definite[..., None], direction, torch.nan)

    @staticmethod
    def floor(derivatives: Derivatives) -> Tensor:
        """Gradient norm below which there is only rounding. *Shape:* ``(B,)``."""
        return ROUNDING_MARGIN * derivatives.resolution

    def take(self, a: Tensor, energy: Tensor, derivatives: Derivatives, placement: Any) -> Step:
        """The best of the candidate steps from a point whose derivatives are known."""
        plain = self.directions(derivatives)
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
        return found if derivatives.second_order is None else found._replace(newton=a + plain[1])

    @full_precision
    def forward(self, a: Tensor, placement: Any) -> Step:
        """Take one step, trying both directions at all lengths, without a branch that depends on data.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: What the energy knows of each sample.

        Raises:
            ValueError: The amplitudes have no batch dimension, or several.
        """
        if a.dim() != 2:
            raise ValueError(
                f"amplitudes have the shape (B, n), as the placement has B samples; got {tuple(a.shape)}: of one "
                "sample, pass a[None] and place start[None]"
            )
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
        return Step(reached, torch.where(moved, lowest, energy), norm, promised, moved, newton)

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
