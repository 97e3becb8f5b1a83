"""In-betweens of one pair of bases, for flat batches; all layers use it."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.arrays import FloatArray, IntArray
from torch_modal.backends.choice import choose
from torch_modal.backends.torch.alignment import Pair
from torch_modal.backends.torch.backend import TorchBackend
from torch_modal.backends.torch.distortion import Distortion
from torch_modal.backends.torch.energies import FineEnergy, RestShapes
from torch_modal.energy.energy import Energy
from torch_modal.energy.shell import N_SHELL_TERMS
from torch_modal.energy.term import Mesh, Term
from torch_modal.inbetween.blend import Blends
from torch_modal.inbetween.comparison import SLACK, SLACK_OF_PATHS, needs_gradient, no_worse
from torch_modal.inbetween.frame import Collapsing, Frame, mean_areas, shared_collapses
from torch_modal.inbetween.joint import JointSpace
from torch_modal.inbetween.levels import Levels
from torch_modal.inbetween.paired import PairedSpace
from torch_modal.inbetween.placing import Placing
from torch_modal.inbetween.samples import InBetweenResult, Samples, warn_of_starts
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.solve.adjoint import Minimisation, solve_implicit, solve_unrolled
from torch_modal.solve.gauss_newton import GaussNewtonStep
from torch_modal.solve.solver import Solution, Status, unmoved

# Products with the Hessian in each local step, and in each step of the polish: with two local steps, what closes 97 %
# of the gap in energy between linear interpolation and the optimum over all vertices, and often 99 % (docs/quality.md).
LOCAL_PRODUCTS = 4
POLISH_PRODUCTS = 20


class Batch(NamedTuple):
    """The minimisations of a batch, in the frame."""

    problem: Any
    minimisation: Minimisation
    start: Tensor
    usable: Tensor
    pair: Pair
    samples: Samples
    anchors: Tensor | None


class Shared(NamedTuple):
    """Data shared by all pairs of a layer."""

    backend: TorchBackend
    """Makes the parts."""
    fine: FineEnergy
    """The energy on the caller's mesh."""
    distortion: Distortion
    """Judges results."""
    weights: Tensor
    """Of the vertices in alignments, so that a motion through several pairs has one trajectory. *Shape:* ``(V,)``."""
    collapses: Callable[..., Collapsing]
    """Those of pairs of references, by their places."""
    blends: Blends
    """Shapes by local rotations, likewise."""

    @classmethod
    def of(
        cls, mesh: Mesh, shapes: Tensor, pairs: Sequence[tuple[int, int]], terms: Sequence[Term], solver: Solver
    ) -> "Shared":
        """Of these terms and pairs of the references of all bases, float64 on the CPU. *Shape:* ``(K, V, 3)``."""
        backend, others = choose(solver.backend), terms[N_SHELL_TERMS:]
        distortion = backend.distortion(mesh, Energy(mesh, others) if others else None)
        blends = Blends(mesh.connectivity, shapes, pairs[0], backend)
        weights, collapses = mean_areas(shapes, mesh.faces), shared_collapses(mesh.faces)
        return cls(backend, backend.fine_energy(mesh, terms), distortion, weights, collapses, blends)

    def alone(self, shapes: Tensor) -> "Shared":
        """The same, but for what depends on the references, of which these are all. *Shape:* ``(K, V, 3)``."""
        mesh = self.blends.mesh
        faces = torch.tensor(mesh.faces)
        blends = Blends(mesh, shapes, (0, 1), self.backend)
        return self._replace(weights=mean_areas(shapes, faces), collapses=shared_collapses(faces), blends=blends)


class Between(nn.Module):
    """In-betweens of one pair of bases.

    Args:
        shapes: The references of both bases, float64 on the CPU. *Shape:* ``(2, V, 3)``. More give further modes.
        places: Of these among those that all pairs have.
        modes: Their modes, likewise. *Shape of each:* ``(k, V, 3)``.
        mesh: The caller's mesh.
        objective: What is minimised.
        solver: How.
        shared: What all pairs have, of terms that the layer owns.
    """

    def __init__(
        self,
        shapes: Tensor,
        places: Sequence[int],
        modes: Sequence[Tensor],
        mesh: Mesh,
        objective: Objective,
        solver: Solver,
        shared: Shared,
    ) -> None:
        super().__init__()
        self.solver, self.backend, self.mesh = solver, shared.backend, mesh
        #: Whether Eq. 5 has no company: what has no strain then stays as it is.
        self.bare = not objective.terms
        #: The energy on the fine mesh, for the local steps, and for stiffnesses of its elements.
        self.fine, self.distortion = shared.fine, shared.distortion
        collapses = partial(shared.collapses, places)
        self.frame = Frame(shapes, mesh.faces, objective.coarse_faces, shared.weights, collapses, modes)
        self.placing = Placing(self.frame, self.fine)
        # The paired space, and steps that are unrolled, are differentiated like any other expression: by torch.
        modal = objective.space == "joint" and solver.gradient == "implicit"
        levels = partial(Levels, self.frame, self.fine, self.backend if modal else TorchBackend())
        if objective.space == "joint":
            ends = self.frame.place(*shapes[:2, None])
            references = torch.cat([ends.first, ends.second])
            blend = shared.blends.of(*places[:2]) if objective.base == "rotations" else None
            anchor = 0.0 if blend is None else objective.anchor
            self.space: Any = JointSpace(self.frame, levels, modes, references, blend, anchor)
        else:
            self.space = PairedSpace(self.frame, levels(), modes)

    @cached_property
    def crossing_pairs(self) -> Callable[[FloatArray], IntArray] | None:
        """A search for triangles that cross; None: that of :class:`~torch_modal.geometry.crossings.Crossings`."""
        reference = self.frame.reference.detach().cpu().double().numpy()
        return self.backend.crossings(self.mesh.connectivity, reference)

    def prepare(self) -> None:
        """Build the tables of the minimisation, otherwise built on first use."""
        if isinstance(self.space, JointSpace):
            self.space.modal  # noqa: B018

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Between":
        """Nothing is made in a lower precision, or on another device, than float64 on the CPU."""
        before = self.frame.reference
        after = fn(before)
        if (after.dtype, after.device) != (before.dtype, before.device):
            self.prepare()
        return super()._apply(fn, recurse)

    def forward(self, samples: Samples, report: Callable[[Solution], None] | None) -> InBetweenResult:
        """Solve.

        Args:
            samples: The batch.
            report: Receives the solution.
        """
        space, t = self.space, samples.t
        pair, usable = self.placing(samples)
        usable, placed = trees.picked((usable, pair.motions()), samples.which)
        usable = usable & (t >= 0) & (t <= 1)
        if pair.around is not None and self.bare:
            # The path is a shape at rest: there is nothing to minimise.
            x, *starts = space.on_trajectory(pair, samples.which, t)
            x, solution = self.compared(x, starts, unmoved(t, 0, usable), pair, samples, None)
        else:
            anchors = self.anchors(placed, t)
            problem = self.problem(pair, samples, anchors)
            start = t.new_zeros(len(t), space.n_unknowns) if problem.start is None else problem.start
            limits = self.solver.max_steps, self.solver.tolerance
            minimisation = Minimisation(self.step, *limits, problem.start is not None, space.require, report)
            x, solution = self.solved(Batch(problem, minimisation, start, usable, pair, samples, anchors))
        shapes = self.frame.restore(x, placed, t)
        if report is not None:
            warn_of_starts(solution)
        valid = solution.status != Status.INVALID
        return InBetweenResult(torch.where(valid[:, None, None], shapes, torch.nan), solution)

    def solved(self, batch: Batch) -> tuple[Tensor, Solution]:
        """Fine shapes in the frame, and their solutions. *Shape:* ``(B, V, 3)``."""
        x, solution = self.modal(batch)
        x = self.refined(x, self.rests_of(batch))
        return self.compared(x, batch.problem.starts, solution, batch.pair, batch.samples, batch.anchors)

    def compared(
        self,
        x: Tensor,
        starts: Sequence[Tensor],
        solution: Solution,
        pair: Pair,
        samples: Samples,
        anchors: Tensor | None,
    ) -> tuple[Tensor, Solution]:
        """Replace shapes that are worse than their starts, and mark their solutions."""
        rests = self.ends(samples, pair, anchors)
        return self.judged(x, starts, solution, rests, SLACK if pair.around is None else SLACK_OF_PATHS)

    @staticmethod
    def ends(samples: Samples, pair: Pair, anchors: Tensor | None) -> RestShapes:
        """The key-frames of each sample as its rest shapes."""
        weights = torch.stack([1 - samples.t, samples.t], -1)
        return RestShapes(trees.picked(pair.shapes, samples.which), weights, samples.stiffness, anchors)

    def judged(
        self, x: Tensor, starts: Sequence[Tensor], solution: Solution, rests: RestShapes, slack: float
    ) -> tuple[Tensor, Solution]:
        """The same with what shapes are compared with."""
        if not starts or not len(x):
            return x, solution
        shapes, slight = [x, *starts], self.distortion.slight(rests.stiffness, x)
        with torch.no_grad():
            distortion = self.distortion(shapes, rests)
        if torch.is_grad_enabled() and needs_gradient(distortion, slight, slack):
            distortion = self.distortion(shapes, rests)
        x, replaced = no_worse(x, starts, distortion, slight, slack)
        fell = replaced & (solution.status != Status.INVALID)
        return x, solution._replace(status=torch.where(fell, Status.FELL_BACK, solution.status))

    def modal(self, batch: Batch) -> tuple[Tensor, Solution]:
        """Shapes of least energy in the modal space, and their solutions."""
        solve = solve_implicit if self.solver.gradient == "implicit" else solve_unrolled
        problem = batch.problem
        given = problem.placement, batch.start, batch.usable, batch.samples.t
        solution = solve(batch.minimisation, *given)
        return self.space.lift(solution.amplitudes, problem), solution

    def placed(self, samples: Samples) -> Pair:
        """The pairs of key-frames in the frame, with their neighbours in time."""
        return self.placing(samples)[0]

    def rests(
        self, samples: Samples, pair: Pair, anchors: Tensor | None, trajectory: Tensor | None = None
    ) -> RestShapes:
        """What the steps of all vertices compare with, of key-frames that are placed.

        Args:
            samples: The batch.
            pair: Its key-frames.
            anchors: Of the terms. *Shape:* ``(B, P, 3)``.
            trajectory: The shapes on a smooth path, where they are known. *Shape:* ``(B, V, 3)``.
        """
        if pair.around is None:
            return self.ends(samples, pair, anchors)
        if trajectory is None:
            trajectory = self.space.on_trajectory(pair, samples.which, samples.t)[0]
        return RestShapes(trajectory[:, None], torch.ones_like(samples.t)[:, None], samples.stiffness, anchors)

    def rests_of(self, batch: Batch) -> RestShapes:
        """The same of a batch."""
        trajectory = None if batch.pair.around is None else batch.problem.base
        return self.rests(batch.samples, batch.pair, batch.anchors, trajectory)

    def coarse_reference(self, samples: Samples, pair: Pair) -> Any:
        """The reference of Eq. 5 on the coarse mesh."""
        levels, rests = self.space.levels, self.rests(samples, pair, None)
        seen = levels.seen(rests.shapes, self.frame.coarsen(rests.shapes))
        return levels.references(seen, rests.weights, levels.stiffness(samples.stiffness))[0]

    def problem(self, pair: Pair, samples: Samples, anchors: Tensor | None = None) -> Any:
        """The minimisation of each sample, of key-frames that are placed."""
        stiffness = self.space.levels.stiffness(samples.stiffness)
        return self.space.problem(pair, samples.which, samples.t, stiffness, samples.mu, anchors)

    @property
    def step(self) -> GaussNewtonStep:
        """The Gauss-Newton step. It has no state: registered, it would name all buffers of the energy twice."""
        return GaussNewtonStep(self.space.energy)

    def refined(self, x: Tensor, rests: RestShapes) -> Tensor:
        """Local interpolation and polish: deformation that the modes cannot represent. *Shape:* ``(B, V, 3)``."""
        if not len(x) or not (self.solver.local_steps or self.solver.polish):
            return x
        stages = (self.solver.local_steps, LOCAL_PRODUCTS), (self.solver.polish, POLISH_PRODUCTS)
        return self.fine.relax(x, rests, stages)

    def anchors(self, placed: Pair, t: Tensor) -> Tensor | None:
        """Those of all terms, in the frame. *Shape:* ``(B, P, 3)``."""
        points = self.fine.energy.anchors
        return None if points is None else self.frame.bring(points.to(t).expand(len(t), -1, -1), placed, t)
