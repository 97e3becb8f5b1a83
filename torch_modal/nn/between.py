"""In-betweens of a batch between two bases: what all layers share."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.linearised import references_between
from torch_modal.energy.shell import ShellEnergy, enclosed_volume, per_sample
from torch_modal.geometry import connectivity
from torch_modal.nn.adjoint import Minimisation, solve_implicit, solve_unrolled
from torch_modal.nn.frame import DIAGONAL, Frame, Pair
from torch_modal.nn.joint import JointSpace
from torch_modal.nn.paired import PairedSpace
from torch_modal.nn.relax import relax
from torch_modal.nn.solver import GaussNewtonStep, Solution, Status
from torch_modal.precompute.basis import ModalBasis

# Newton steps of the local interpolation, and products with the Hessian in each: what closes 97 % of the gap in energy
# between linear interpolation and the optimum over all vertices, and often 99 % (docs/quality.md).
LOCAL_STEPS = 2
LOCAL_PRODUCTS = 4
POLISH_PRODUCTS = 20

# Vertices of all samples that are relaxed at a time: more would not fit into caches.
FINE_CHUNK = 20_000

# A key-frame smaller than this part of the basis' reference is a point.
SMALLEST_SIZE = 1e-6


class ConvergenceWarning(UserWarning):
    """A minimisation stopped before its gradient vanished."""


class ConvergenceError(RuntimeError):
    """A gradient was asked for through a minimisation that did not converge."""


class InBetweenResult(NamedTuple):
    """Shapes with the solution that they came from."""

    shapes: Tensor
    """*Shape:* ``(..., V, 3)``; NaN where the status is ``INVALID``."""
    solution: Solution
    """One value per shape: energy, relative gradient norm, number of steps, status."""


class Between(nn.Module):
    """In-betweens of one pair of bases, for flat batches. Arguments as for :class:`torch_modal.InBetween`."""

    def __init__(
        self,
        bases: Sequence[ModalBasis],
        faces: Tensor,
        space: str,
        mu: float | Tensor,
        stiffness: Sequence[float | Tensor],
        coarse_faces: int,
        rotations: bool,
        local: bool,
        polish: int,
    ) -> None:
        super().__init__()
        frame = Frame(bases, faces, coarse_faces)
        shell = ShellEnergy(frame.coarse_faces)
        if space == "joint":
            ends = frame.place(*(basis.reference[None].to(frame.scale) for basis in bases))
            references = torch.cat([ends.first, ends.second])
            self.space: Any = JointSpace(frame, shell, frame.modes(bases), references, rotations)
        elif space == "paired":
            self.space = PairedSpace(frame, shell, frame.modes(bases))
        else:
            raise ValueError(f"space is 'joint' or 'paired', got {space!r}")
        self.closed = len(connectivity.boundary_edges(frame.faces.numpy())) == 0
        # Registered here alone: a module that hangs at two places confuses torch.func.functional_call.
        self.alpha, self.beta, self.gamma = stiffness
        self.mu = mu
        self.local, self.polish = local, polish
        #: The energy on the fine mesh, for what is done there.
        self.fine_shell = ShellEnergy(frame.faces) if local or polish else None

    def forward(
        self,
        x_a: Tensor,
        x_b: Tensor,
        t: Tensor,
        gradient: str,
        max_steps: int,
        tolerance: float,
        least_gain: float,
        report: Callable[[Solution], None] | None,
    ) -> InBetweenResult:
        """Solve. *Shape:* ``(B, V, 3), (B, V, 3), (B,)``."""
        frame = self.space.frame
        # A sample that is not finite must not reach the factorisations of the others: the reference stands in for it.
        usable = x_a.isfinite().flatten(1).all(1) & x_b.isfinite().flatten(1).all(1) & (t >= 0) & (t <= 1)
        stand_in = frame.reference / frame.scale
        clean_a, clean_b = (torch.where(usable[:, None, None], x, stand_in) for x in (x_a, x_b))
        pair = frame.place(clean_a, clean_b)
        usable = usable & self._solvable(pair)
        problem = self.problem(pair, t)
        space = self.space
        minimisation = Minimisation(
            self.step,
            space.placement,
            space.guess,
            space.require,
            space.n_unknowns,
            max_steps,
            tolerance,
            least_gain,
            report,
        )
        solve = solve_implicit if gradient == "implicit" else solve_unrolled
        solution = solve(minimisation, usable, problem.inputs)
        shapes = frame.restore(self._refine(self.space.lift(solution.amplitudes, problem), pair, t), pair, t)
        valid = solution.status != Status.INVALID
        return InBetweenResult(torch.where(valid[:, None, None], shapes, torch.nan), solution)

    @property
    def step(self) -> GaussNewtonStep:
        """What is repeated. It has no state: registered, it would name all buffers of the energy twice."""
        return GaussNewtonStep(self.space.energy)

    def problem(self, pair: Pair, t: Tensor) -> Any:
        """The minimisation of each sample, at the times ``t``, *shape* ``(B,)``."""
        return self.space.problem(pair, t, *per_sample((self.mu, self.alpha, self.beta, self.gamma), t))

    def _refine(self, x: Tensor, pair: Pair, t: Tensor) -> Tensor:
        """Local interpolation and polish: what the modes cannot do. *Shape:* ``(B, V, 3)``."""
        if self.fine_shell is None:
            return x
        chunk = max(1, FINE_CHUNK // x.shape[-2])
        per_item = (x, pair.first, pair.second, t, *per_sample((self.alpha, self.beta, self.gamma), t))
        parts = zip(*(value.split(chunk) for value in per_item), strict=True)
        return torch.cat([self._relax(*part) for part in parts])

    def _relax(self, x: Tensor, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> Tensor:
        shell: Any = self.fine_shell
        references = references_between(shell, first, second, t, *stiffness)
        if self.local:
            x = relax(shell, x, references, LOCAL_STEPS, LOCAL_PRODUCTS)
        return relax(shell, x, references, self.polish, POLISH_PRODUCTS)

    def _solvable(self, pair: Pair) -> Tensor:
        """Whether both ends have a size, and, where closed, the same side out: else the volume would vanish on the way.

        *Shape:* ``(B,)``.
        """
        faces = self.space.frame.faces
        ends = [x.detach().movedim(-1, 0) for x in (pair.first, pair.second)]
        sizes = [(x.amax(-1) - x.amin(-1)).norm(dim=0) for x in ends]
        first, second = (enclosed_volume(x, faces) for x in ends)
        mirrored = (first * second < 0) & self.closed
        return (torch.minimum(*sizes) > SMALLEST_SIZE * DIAGONAL) & ~mirrored


def report(solution: Solution, max_steps: int, forbid: bool) -> None:
    """Say what did not converge.

    Args:
        solution: One value per sample.
        max_steps: The limit that held.
        forbid: Whether it is an error.

    Raises:
        ConvergenceError: Something did not converge, and that is an error.
    """
    missed = ~solution.converged
    if not bool(missed.any()):
        return
    counts = {status.name: int((solution.status == status).sum()) for status in Status if status}
    message = (
        f"{int(missed.sum())} of {missed.numel()} in-betweens did not converge in {max_steps} steps "
        f"({', '.join(f'{n} {name}' for name, n in counts.items() if n)}): no gradient flows through their amplitudes; "
        "solve() tells which"
    )
    if forbid:
        raise ConvergenceError(message)
    warnings.warn(message, ConvergenceWarning, stacklevel=2)
