"""In-betweens of one pair of bases, for flat batches: what all layers share."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.energy import Energy, Reference, Rest
from torch_modal.energy.shell import DIAGONAL
from torch_modal.energy.terms import Mesh, Term
from torch_modal.geometry.hermite import Spacing
from torch_modal.geometry.vectors import cross, pick
from torch_modal.nn import trees
from torch_modal.nn.adjoint import ConvergenceWarning, Minimisation, solve_implicit, solve_unrolled
from torch_modal.nn.contact import FINE_PRODUCTS, FINE_STEPS, ROUNDS, Contacts, ContactSearch
from torch_modal.nn.frame import Frame, Pair
from torch_modal.nn.fused_relax import FusedRelax
from torch_modal.nn.joint import JointSpace
from torch_modal.nn.launch import has_kernels
from torch_modal.nn.levels import Levels, Stiffness, coarse_values
from torch_modal.nn.modal_energy import SumOfEnergies
from torch_modal.nn.paired import PairedSpace
from torch_modal.nn.relax import relax
from torch_modal.nn.settings import Objective, Solver
from torch_modal.nn.solver import GaussNewtonStep, Solution, Status, unmoved

# Products with the Hessian in each local step, and in each step of the polish: with two local steps, what closes 97 %
# of the gap in energy between linear interpolation and the optimum over all vertices, and often 99 % (docs/quality.md).
LOCAL_PRODUCTS = 4
POLISH_PRODUCTS = 20

# Vertices of all samples that are relaxed at a time: more would not fit into a processor's caches, or, of a GPU, into
# its memory (6 KB a vertex where gradients are recorded).
FINE_CHUNK = 20_000
FINE_CHUNK_OF_GPU = 1_000_000

# A key-frame smaller than this part of the basis' reference is a point.
SMALLEST_SIZE = 1e-6


def fine_chunk(n_vertices: int, device: torch.device) -> int:
    """How many samples of so many vertices are relaxed at a time."""
    return max(1, (FINE_CHUNK if device.type == "cpu" else FINE_CHUNK_OF_GPU) // n_vertices)


class ConvergenceError(RuntimeError):
    """A gradient was asked for through a minimisation that did not converge."""


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
    """The key-frames before those at 0, where the course is to be smooth in time. *Shape:* ``(P, V, 3)``."""
    after: Tensor | None = None
    """The key-frames after those at 1. *Shape:* ``(P, V, 3)``."""
    spacing: Spacing | None = None
    """Durations of the three intervals; None if the course is of the pair alone. *Shape of each:* ``(P,)``."""


class _Batch(NamedTuple):
    """The minimisations of a batch."""

    problem: Any
    minimisation: Minimisation
    start: Tensor
    usable: Tensor
    pair: Pair
    samples: Samples
    anchors: Tensor | None

    def rows(self, some: Tensor, solution: Solution, start: Tensor | None = None) -> "_Batch":
        """Some of the samples, started where they ended, or elsewhere."""
        samples = self.samples
        of = torch.arange(len(samples.t), device=some.device) if samples.which is None else samples.which
        picked = samples._replace(
            which=of[some], t=samples.t[some], mu=samples.mu[some], stiffness=[k[some] for k in samples.stiffness]
        )
        return _Batch(
            trees.rows(self.problem, some),
            self.minimisation,
            solution.amplitudes.detach()[some] if start is None else start,
            self.usable[some],
            self.pair,
            picked,
            None if self.anchors is None else self.anchors[some],
        )


class _Apart(NamedTuple):
    """In-betweens that were pushed apart."""

    x: Tensor
    """In the frame. *Shape:* ``(B, V, 3)``."""
    solution: Solution
    held: Contacts
    start: Tensor
    """Where the minimisation started. *Shape:* ``(B, n)``."""
    n_far: Tensor
    """*Shape:* ``(B,)``."""


class Between(nn.Module):
    """In-betweens of one pair of bases.

    Args:
        shapes: The references of both bases, float64 on the CPU. *Shape:* ``(2, V, 3)``.
        modes: Their modes, likewise. *Shape of each:* ``(k, V, 3)``.
        mesh: The caller's mesh.
        objective: What is minimised.
        solver: How.
        terms: The terms of the energy, which the layer owns.
        weights: Of the vertices in alignments. Default: their mean areas. *Shape:* ``(V,)``.
    """

    def __init__(
        self,
        shapes: Tensor,
        modes: Sequence[Tensor],
        mesh: Mesh,
        objective: Objective,
        solver: Solver,
        terms: Sequence[Term],
        weights: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.solver = solver
        self.contact = objective.contact
        self.mesh = mesh
        #: Whether Eq. 5 has no company: what has no strain then stays as it is.
        self.bare = not objective.terms
        self.frame = Frame(shapes, mesh.faces, objective.coarse_faces, weights)
        levels = Levels(self.frame, mesh, terms)
        if objective.space == "joint":
            ends = self.frame.place(*shapes[:, None])
            references = torch.cat([ends.first, ends.second])
            fine = mesh if objective.base == "rotations" else None
            self.space: Any = JointSpace(self.frame, levels, modes, references, fine, has_kernels(solver.backend))
        else:
            self.space = PairedSpace(self.frame, levels, modes)
        self.closed = len(mesh.connectivity.boundary_edges) == 0
        #: The energy on the fine mesh, for the local steps, and for stiffnesses of its elements.
        self.fine = Energy(mesh, terms)
        self.fused = FusedRelax(self.fine, mesh) if FusedRelax.serves(self.fine, solver.backend) else None

    def prepare(self) -> None:
        """Make at once what would be made at the first minimisation."""
        if isinstance(self.space, JointSpace):
            self.space.modal  # noqa: B018

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Between":
        """Nothing is made in a lower precision, or on another device, than float64 on the CPU."""
        before = self.frame.reference
        after = fn(before)
        if (after.dtype, after.device) != (before.dtype, before.device):
            self.prepare()
        return super()._apply(fn, recurse)

    def forward(
        self,
        samples: Samples,
        exact: bool,
        report: Callable[[Solution], None] | None,
        held: Contacts | None = None,
    ) -> InBetweenResult:
        """Solve.

        Args:
            samples: The batch.
            exact: Whether the minimisation goes on to the tolerance, whatever ``least_gain`` says.
            report: Told how it went.
            held: What is held, in the place of what would be found.
        """
        space, solver = self.space, self.solver
        index, t = samples.which, samples.t
        pair, finite = self._placed(samples)
        usable, placed = trees.picked((finite & self._solvable(pair), pair), index)
        usable = usable & (t >= 0) & (t <= 1)
        if pair.around is not None and self.bare:
            # The course is a shape at rest: there is nothing to minimise.
            solution = unmoved(t, 0, usable)
            return self._restored(space.on_course(pair, index, t), solution, placed, t)
        anchors = self.anchors(placed, t)
        problem = self.problem(pair, samples, anchors)
        least_gain = 0.0 if exact or isinstance(space, PairedSpace) else solver.least_gain
        limits = solver.max_steps, solver.tolerance, least_gain
        minimisation = Minimisation(self.step, *limits, problem.start is not None, space.require, report)
        start = t.new_zeros(len(t), space.n_unknowns) if problem.start is None else problem.start
        batch = _Batch(problem, minimisation, start, usable, pair, samples, anchors)
        if not self.contact:
            return self._restored(*self._minimised(batch), placed, t)
        x, solution, n_crossing = self._in_contact(batch, held, exact)
        return self._restored(x, solution._replace(n_crossing=n_crossing), placed, t)

    def placed(self, samples: Samples) -> Pair:
        """The pairs of key-frames in the frame, with their neighbours in time."""
        return self._placed(samples)[0]

    def _placed(self, samples: Samples) -> tuple[Pair, Tensor]:
        """The same, and which are finite."""
        frame = self.frame
        # A sample that is not finite must not reach the factorisations of the others: the reference stands in for it.
        given = [samples.before, samples.x_a, samples.x_b, samples.after]
        finite = torch.stack([x.isfinite().flatten(1).all(1) for x in given if x is not None]).all(0)
        stand_in = frame.reference / frame.scale
        before, x_a, x_b, after = (
            None if x is None else torch.where(finite[:, None, None], x, stand_in) for x in given
        )
        pair = frame.place(x_a, x_b)  # type: ignore[arg-type]
        if samples.spacing is not None:
            pair = frame.surround(pair, before, after, samples.spacing)
        return pair, finite

    def fine_reference(
        self, samples: Samples, pair: Pair, energy: Energy, vertices: Tensor, stiffness: list[Tensor]
    ) -> Reference:
        """What an energy on a part of the fine mesh compares shapes with. *Shape of the vertices:* ``(R,)``."""

        def rest(x: Tensor) -> Rest:
            return energy.rest(energy.extend(x[:, vertices.to(x.device)].movedim(-1, 0).contiguous()))

        if pair.around is not None:
            return Energy.against(rest(self.space.on_course(pair, samples.which, samples.t)), stiffness)
        first, second = trees.picked([rest(end) for end in (pair.first, pair.second)], samples.which)
        return energy.between(first, second, samples.t, stiffness)

    def coarse_reference(self, samples: Samples, pair: Pair) -> Reference:
        """What shapes on the coarse mesh are compared with."""
        levels, stiffness = self.space.levels, self._levelled(samples.stiffness)
        if pair.around is not None:
            course = self.space.on_course(pair, samples.which, samples.t)
            return levels.against(course, self.frame.coarsen(course), stiffness)[0]
        ends = [levels.rests(levels.seen(x, self.frame.coarsen(x))) for x in (pair.first, pair.second)]
        return levels.between(*ends, samples.which, samples.t, stiffness)[0]

    def _minimised(self, batch: "_Batch", contacts: Contacts | None = None) -> tuple[Tensor, Solution]:
        """The fine shapes of the frame, with what they came from. *Shape:* ``(B, V, 3)``."""
        space, solver, problem, minimisation = self.space, self.solver, batch.problem, batch.minimisation
        solve = solve_implicit if solver.gradient == "implicit" else solve_unrolled
        placement = problem.placement
        if contacts is not None:
            modal = contacts.modal(self.mesh, space.columns.fine)
            placement = (*placement, contacts.place(modal, problem.base, space.column(problem.difference)))
            minimisation = minimisation._replace(step=GaussNewtonStep(SumOfEnergies(*space.energy.parts, modal)))
        solution = solve(minimisation, placement, batch.start, batch.usable, batch.samples.t)
        x = space.lift(solution.amplitudes, problem)
        if len(x) and (solver.local_steps or solver.polish or contacts is not None):
            x = self._refine(x, problem.base, batch.pair, batch.samples, batch.anchors, contacts)
        return x, solution

    def _in_contact(self, batch: "_Batch", held: Contacts | None, exact: bool) -> tuple[Tensor, Solution, Tensor]:
        """In-betweens that do not pass through themselves, and the pairs of triangles that do all the same.

        Those that would are made again with what was found held; the others stay as they are without contact. What is
        held is found without a gradient.
        """
        x, solution = self._minimised(batch)
        n_crossing = torch.zeros_like(solution.status)
        start = None
        if held is None:
            with torch.no_grad():
                search = ContactSearch(
                    self.mesh, batch.pair.first, batch.pair.second, batch.samples.which, batch.samples.t
                )
                held = search(x)
                n_crossing = search.n_far
                if held is None:
                    return x, solution, n_crossing
                found = self._found(batch.rows(held.samples, solution), held, search)
                held, start = found.held, found.start
                n_crossing = n_crossing.index_copy(0, held.samples, found.n_far)
        if exact or start is None:
            again, resolved = self._minimised(batch.rows(held.samples, solution, start), held)
        else:
            again, resolved = found.x, found.solution
        pairs = zip(solution[:-1], resolved[:-1], strict=True)
        merged = Solution(*(whole.index_copy(0, held.samples, part) for whole, part in pairs))  # type: ignore[union-attr, arg-type]
        return x.index_copy(0, held.samples, again), merged, n_crossing

    @torch.no_grad()
    def _found(self, batch: "_Batch", held: Contacts, search: ContactSearch) -> "_Apart":
        """What to hold: it is looked again after each push; what left the fewest crossings is taken."""
        search.keep(held.samples)
        best: _Apart | None = None
        for _ in range(ROUNDS):
            x, solution = self._minimised(batch, held)
            found = search(x)
            if best is None or int(search.n_far.sum()) < int(best.n_far.sum()):
                best = _Apart(x, solution, held, batch.start, search.n_far)
            if found is None or not bool(search.n_far.any()):
                break
            held, batch = found.of_all(held.samples), batch._replace(start=solution.amplitudes)
        assert best is not None
        return best

    def _restored(self, x: Tensor, solution: Solution, placed: Pair, t: Tensor) -> InBetweenResult:
        shapes = self.frame.restore(x, placed, t)
        valid = solution.status != Status.INVALID
        return InBetweenResult(torch.where(valid[:, None, None], shapes, torch.nan), solution)

    def problem(self, pair: Pair, samples: Samples, anchors: Tensor | None = None) -> Any:
        """The minimisation of each sample, of key-frames that are placed."""
        stiffness = self._levelled(samples.stiffness)
        return self.space.problem(pair, samples.which, samples.t, stiffness, samples.mu, anchors)

    @property
    def terms(self) -> tuple[Term, ...]:
        """Of the energy; the layer owns them."""
        return tuple(part.term for part in self.fine.parts)

    @property
    def step(self) -> GaussNewtonStep:
        """What is repeated. It has no state: registered, it would name all buffers of the energy twice."""
        return GaussNewtonStep(self.space.energy)

    def _refine(
        self,
        x: Tensor,
        base: Tensor,
        pair: Pair,
        samples: Samples,
        anchors: Tensor | None,
        contacts: Contacts | None = None,
    ) -> Tensor:
        """Local interpolation and polish: what the modes cannot do. *Shape:* ``(B, V, 3)``."""
        energy, solver = self.fine, self.solver
        in_contact = energy if contacts is None else contacts.fine(self.mesh, self.terms)
        chunk = fine_chunk(x.shape[-2], x.device)
        ends = pair.first, pair.second
        if self.fused is not None and contacts is None:
            rest = trees.picked(ends, samples.which)
            for n_steps, n_products in ((solver.local_steps, LOCAL_PRODUCTS), (solver.polish, POLISH_PRODUCTS)):
                x = self.fused(x, *rest, samples.t, samples.stiffness, n_steps, n_products, chunk)
            return x
        known = None if samples.which is None else [self._fine_rest(end) for end in ends]
        parts = []
        for i in range(0, len(x), chunk):
            own = slice(i, i + chunk)
            start, course, t, stiffness, fixed = trees.rows((x, base, samples.t, samples.stiffness, anchors), own)
            if pair.around is not None:
                reference = Energy.against(self._fine_rest(course), stiffness)
            else:
                if known is None or samples.which is None:
                    first, second = (self._fine_rest(end[own]) for end in ends)
                else:
                    first, second = trees.rows(known, samples.which[own])
                reference = energy.between(first, second, t, stiffness)
            moved = relax(energy, start, reference, solver.local_steps, LOCAL_PRODUCTS, fixed)
            if contacts is not None:
                reference = contacts.rows(own).joined(reference)
                moved = relax(in_contact, moved, reference, FINE_STEPS, FINE_PRODUCTS, fixed)
            parts.append(relax(in_contact, moved, reference, solver.polish, POLISH_PRODUCTS, fixed))
        return torch.cat(parts)

    def _fine_rest(self, x: Tensor) -> Rest:
        """Shapes as rest shapes on the fine mesh. *Shape:* ``(B, V, 3)``."""
        return self.fine.rest(self.fine.extend(x.movedim(-1, 0).contiguous()))

    def _levelled(self, stiffness: list[Tensor]) -> Stiffness:
        """Stiffnesses of the elements of the fine mesh, on those of each level."""
        levels = self.space.levels
        coarse, *sampled = levels.energies
        parts = zip(levels.members[0], coarse.parts, strict=True)
        found = [[coarse_values(stiffness[i], self.fine.parts[i], part, self.frame.clusters) for i, part in parts]]
        if sampled:
            found.append([stiffness[i] for i in levels.members[1]])
        return Stiffness(stiffness, found)

    def anchors(self, placed: Pair, t: Tensor) -> Tensor | None:
        """Those of all terms, in the frame. *Shape:* ``(B, P, 3)``."""
        points = [part.term.anchors for part in self.fine.parts if part.term.anchors is not None]
        if not points:
            return None
        return self.frame.bring(torch.cat(points).to(t).expand(len(t), -1, -1), placed, t)

    def _solvable(self, pair: Pair) -> Tensor:
        """Whether both ends have a size, and, where closed, the same side out: else the volume would vanish on the way.

        *Shape:* ``(P,)``.
        """
        ends = [x.detach() for x in (pair.first, pair.second)]
        sizes = [(x.amax(-2) - x.amin(-2)).norm(dim=-1) for x in ends]
        usable = torch.minimum(*sizes) > SMALLEST_SIZE * DIAGONAL
        if not self.closed:
            return usable
        first, second = (_enclosed(x, self.frame.faces) for x in ends)
        return usable & ~(first * second < 0)


def _enclosed(x: Tensor, faces: Tensor) -> Tensor:
    """Six times the signed volume. *Shape:* ``(B, V, 3), (F, 3) -> (B,)``."""
    rows = x.movedim(-1, 0).contiguous()
    a, b, c = (pick(rows, corner) for corner in faces.unbind(1))
    return (a * cross(b, c)).sum((0, -1))


def report(solution: Solution, max_steps: int, forbid: bool) -> None:
    """Say what did not converge.

    Args:
        solution: One value per sample.
        max_steps: The limit that held.
        forbid: Whether it is an error.

    Raises:
        ConvergenceError: Something did not converge, and that is an error.
    """
    missed = ~solution.usable
    if not bool(missed.any()):
        return
    counts = {status.name: int((solution.status == status).sum()) for status in Status if status}
    counts.pop(Status.ENOUGH.name)
    message = (
        f"{int(missed.sum())} of {missed.numel()} in-betweens did not converge in {max_steps} steps "
        f"({', '.join(f'{n} {name}' for name, n in counts.items() if n)}): no gradient flows through their amplitudes; "
        "solve() tells which"
    )
    if forbid:
        raise ConvergenceError(message)
    warnings.warn(message, ConvergenceWarning, stacklevel=2)
