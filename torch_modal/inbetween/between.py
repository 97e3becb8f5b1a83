"""In-betweens of one pair of bases, for flat batches; all layers use it."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import traced, transformed
from torch_modal.backends.further import FurtherEnergy, FurtherTerms
from torch_modal.backends.torch.alignment import Alignment, Pair
from torch_modal.backends.torch.fine_steps import relax
from torch_modal.backends.warp import alignment as fused_alignment
from torch_modal.backends.warp.crossings import FusedPairs
from torch_modal.backends.warp.fine_steps import FusedRelax
from torch_modal.backends.warp.launch import has_kernels
from torch_modal.backends.warp.shell import ShellReference
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.shell import DIAGONAL
from torch_modal.energy.terms import N_SHELL_TERMS, Mesh, Term
from torch_modal.errors import MeshWarning
from torch_modal.geometry.vectors import cross, pick
from torch_modal.geometry.winding import looks_mirrored
from torch_modal.inbetween.blend import Blends
from torch_modal.inbetween.comparison import SLACK, SLACK_OF_PATHS, Distortion, no_worse
from torch_modal.inbetween.frame import Collapsing, Frame, mean_areas, shared_collapses
from torch_modal.inbetween.joint import JointSpace
from torch_modal.inbetween.levels import Levels, Stiffness, coarse_values
from torch_modal.inbetween.paired import PairedSpace
from torch_modal.inbetween.samples import InBetweenResult, Samples, warn_of_starts
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.solve.adjoint import Minimisation, solve_implicit, solve_unrolled
from torch_modal.solve.gauss_newton import GaussNewtonStep
from torch_modal.solve.solver import Solution, Status, unmoved

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

# A key-frame that is larger or smaller than the basis' reference by this factor is in other units, or another body.
OTHER_SIZE = 3.0


def fine_chunk(n_vertices: int, device: torch.device) -> int:
    """How many samples of so many vertices are relaxed at a time."""
    return max(1, (FINE_CHUNK if device.type == "cpu" else FINE_CHUNK_OF_GPU) // n_vertices)


class Batch(NamedTuple):
    """The minimisations of a batch, in the frame."""

    problem: Any
    minimisation: Minimisation
    start: Tensor
    energy: Tensor | None
    """There, where it is known. *Shape:* ``(B,)``."""
    usable: Tensor
    pair: Pair
    samples: Samples
    anchors: Tensor | None


class Shared(NamedTuple):
    """Data shared by all pairs of a layer."""

    energy: Energy
    """On the caller's mesh."""
    further: Energy | None
    """Its terms beyond Eq. 5, where there are some."""
    fused: FusedRelax | None
    """The kernels of Eq. 5, where there are some."""
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
        has = has_kernels(solver.backend)
        shell, others = Energy(mesh, terms[:N_SHELL_TERMS]), terms[N_SHELL_TERMS:]
        further = Energy(mesh, others) if others else None
        energy = Energy(mesh, terms) if others else shell
        fused = FusedRelax(shell, mesh) if has else None
        blends, distortion = Blends(mesh.connectivity, shapes, pairs[0], has), Distortion(mesh, further, has)
        weights, collapses = mean_areas(shapes, mesh.faces), shared_collapses(mesh.faces)
        return cls(energy, further, fused, distortion, weights, collapses, blends)


class Between(nn.Module):
    """In-betweens of one pair of bases.

    Args:
        shapes: The references of both bases, float64 on the CPU. *Shape:* ``(2, V, 3)``.
        places: Of both among those that all pairs have.
        modes: Their modes, likewise. *Shape of each:* ``(k, V, 3)``.
        mesh: The caller's mesh.
        objective: What is minimised.
        solver: How.
        shared: What all pairs have, of terms that the layer owns.
    """

    def __init__(
        self,
        shapes: Tensor,
        places: tuple[int, int],
        modes: Sequence[Tensor],
        mesh: Mesh,
        objective: Objective,
        solver: Solver,
        shared: Shared,
    ) -> None:
        super().__init__()
        self.solver = solver
        self.mesh = mesh
        #: Whether Eq. 5 has no company: what has no strain then stays as it is.
        self.bare = not objective.terms
        #: The energy on the fine mesh, for the local steps, and for stiffnesses of its elements.
        self.fine, self.further, self.fused = shared.energy, shared.further, shared.fused
        self.distortion = shared.distortion
        collapses = partial(shared.collapses, places)
        self.frame = Frame(shapes, mesh.faces, objective.coarse_faces, shared.weights, collapses, modes[0])
        # Steps that are unrolled are differentiated like any other expression: by torch.
        modal = objective.space == "joint" and solver.gradient == "implicit"
        levels = partial(Levels, self.frame, mesh, self.terms, solver.backend if modal else "torch")
        if objective.space == "joint":
            ends = self.frame.place(*shapes[:, None])
            references = torch.cat([ends.first, ends.second])
            blend = shared.blends.of(*places) if objective.base == "rotations" else None
            self.space: Any = JointSpace(self.frame, levels, modes, references, blend)
        else:
            self.space = PairedSpace(self.frame, levels(), modes)
        self.closed = len(mesh.connectivity.boundary_edges) == 0
        self.size_warned = False

    @cached_property
    def crossing_pairs(self) -> FusedPairs | None:
        """A search for triangles that cross by kernels, where there are some."""
        if not has_kernels(self.solver.backend):
            return None
        return FusedPairs(self.mesh.connectivity, self.frame.reference.detach().cpu().double().numpy()[None])

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
        pair, usable = self._placed_by_kernels(samples) or self._placed_by_torch(samples)
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
            x, solution = self.solved(
                Batch(problem, minimisation, start, problem.energy, usable, pair, samples, anchors)
            )
        fused = self.fused is not None and fused_alignment.serves(x, pair.first, t)
        shapes = (fused_alignment.restore if fused else Alignment.restore)(self.frame, x, placed, t)
        if report is not None:
            warn_of_starts(solution)
        valid = solution.status != Status.INVALID
        return InBetweenResult(torch.where(valid[:, None, None], shapes, torch.nan), solution)

    def solved(self, batch: Batch) -> tuple[Tensor, Solution]:
        """Fine shapes in the frame, and their solutions. *Shape:* ``(B, V, 3)``."""
        x, solution = self.modal(batch)
        if len(x) and (self.solver.local_steps or self.solver.polish):
            x = self._refine(x, batch)
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
        if not starts or not len(x):
            return x, solution
        with torch.no_grad():
            ends = pair.first, pair.second
            given = ends, samples.which, samples.t, samples.stiffness, anchors
            distortion = self.distortion([x, *starts], *given)
        rounding = self.distortion.rounding(samples.stiffness, x)
        slack = SLACK if pair.around is None else SLACK_OF_PATHS
        x, worse = no_worse(x, starts, distortion, rounding, slack)
        fell = worse & (solution.status != Status.INVALID)
        return x, solution._replace(status=torch.where(fell, Status.FELL_BACK, solution.status))

    def modal(self, batch: Batch) -> tuple[Tensor, Solution]:
        """Shapes of least energy in the modal space, and their solutions."""
        solve = solve_implicit if self.solver.gradient == "implicit" else solve_unrolled
        problem = batch.problem
        given = problem.placement, batch.start, batch.usable, batch.samples.t, batch.energy
        solution = solve(batch.minimisation, *given)
        return self.space.lift(solution.amplitudes, problem), solution

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

    def fine_reference(self, samples: Samples, pair: Pair) -> Reference:
        """The reference of Eq. 5 on the fine mesh."""
        if pair.around is not None:
            return Energy.against(
                self.fine.rest_of(self.space.on_trajectory(pair, samples.which, samples.t)[0]), samples.stiffness
            )
        first, second = trees.picked([self.fine.rest_of(end) for end in (pair.first, pair.second)], samples.which)
        return self.fine.between(first, second, samples.t, samples.stiffness)

    def coarse_reference(self, samples: Samples, pair: Pair) -> Any:
        """The reference of Eq. 5 on the coarse mesh."""
        levels, stiffness = self.space.levels, self._levelled(samples.stiffness)
        if pair.around is not None:
            trajectory = self.space.on_trajectory(pair, samples.which, samples.t)[0]
            return levels.against(trajectory, self.frame.coarsen(trajectory), stiffness)[0]
        ends = [levels.seen(x, self.frame.coarsen(x)) for x in (pair.first, pair.second)]
        return levels.between(*ends, samples.which, samples.t, stiffness)[0]

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
        """The Gauss-Newton step. It has no state: registered, it would name all buffers of the energy twice."""
        return GaussNewtonStep(self.space.energy)

    def _refine(self, x: Tensor, batch: Batch) -> Tensor:
        """Local interpolation and polish: deformation that the modes cannot represent. *Shape:* ``(B, V, 3)``."""
        solver, samples = self.solver, batch.samples
        stages = (solver.local_steps, LOCAL_PRODUCTS), (solver.polish, POLISH_PRODUCTS)
        if self.fused is not None and self.further is None:
            rest = trees.picked((batch.pair.first, batch.pair.second), samples.which)
            chunk = fine_chunk(x.shape[-2], x.device)
            for n_steps, n_products in stages:
                x = self.fused(x, *rest, samples.t, samples.stiffness, n_steps, n_products, chunk)
            return x
        if self.kernels_serve(x):
            return self.descend(x, batch, stages)
        parts = []
        for own, reference, fixed in self.fine_chunks(batch):
            moved = x[own]
            for n_steps, n_products in stages:
                moved = relax(self.fine, moved, reference, n_steps, n_products, fixed)
            parts.append(moved)
        return torch.cat(parts)

    def kernels_serve(self, x: Tensor) -> bool:
        """Whether kernels compute the local steps with energies beside Eq. 5."""
        recorded = torch.is_grad_enabled() and x.requires_grad
        return self.fused is not None and not (recorded or traced(x) or transformed(x))

    def descend(
        self, x: Tensor, batch: Batch, stages: Sequence[tuple[int, int]], contacts: Sequence[FurtherEnergy] = ()
    ) -> Tensor:
        """Steps of all vertices by kernels, with further terms and contacts.

        Args:
            x: *Shape:* ``(B, V, 3)``.
            batch: The samples.
            stages: Steps, and products in each.
            contacts: Of a batch of one.
        """
        assert self.fused is not None
        parts = []
        for own, to, others in self.fused_chunks(batch.samples, batch.pair, batch.anchors):
            moved = x[own].double().contiguous()
            for n_steps, n_products in stages:
                moved = self.fused.descend(moved, to, [*others, *contacts], n_steps, n_products)
            parts.append(moved)
        return torch.cat(parts).to(x)

    def fused_chunks(
        self, samples: Samples, pair: Pair, anchors: Tensor | None
    ) -> Iterator[tuple[slice, ShellReference, list[FurtherEnergy]]]:
        """Chunks of samples for the kernels, with their references and further terms."""
        fused = self.fused
        assert fused is not None
        first, second = trees.picked((pair.first, pair.second), samples.which)
        if pair.around is not None:
            first = second = self.space.on_trajectory(pair, samples.which, samples.t)[0]
        chunk = fine_chunk(self.mesh.n_vertices, samples.t.device)
        for i in range(0, len(samples.t), chunk):
            own = slice(i, i + chunk)
            given = trees.rows((first, second, samples.t, samples.stiffness, anchors), own)
            a, b, t, stiffness, fixed = trees.mapped(given, lambda value: value.double().contiguous())
            others: list[FurtherEnergy] = []
            if self.further is not None:
                one, other = (self.further.rest_of(x) for x in (a, b))
                reference = self.further.between(one, other, t, stiffness[N_SHELL_TERMS:])
                others.append(FurtherTerms(self.further, reference, fixed))
            yield own, fused.reference(a, b, t, *stiffness[:N_SHELL_TERMS]), others

    def fine_chunks(self, batch: Batch) -> Iterator[tuple[slice, Reference, Tensor | None]]:
        """Chunks of samples, with their references on the fine mesh and their anchors."""
        pair, samples = batch.pair, batch.samples
        ends = pair.first, pair.second
        known = None if samples.which is None else [self.fine.rest_of(end) for end in ends]
        chunk = fine_chunk(self.mesh.n_vertices, samples.t.device)
        for i in range(0, len(samples.t), chunk):
            own = slice(i, i + chunk)
            t, stiffness, fixed = trees.rows((samples.t, samples.stiffness, batch.anchors), own)
            if pair.around is not None:
                reference = Energy.against(self.fine.rest_of(batch.problem.base[own]), stiffness)
            else:
                if known is None or samples.which is None:
                    first, second = (self.fine.rest_of(end[own]) for end in ends)
                else:
                    first, second = trees.rows(known, samples.which[own])
                reference = self.fine.between(first, second, t, stiffness)
            yield own, reference, fixed

    def _levelled(self, stiffness: list[Tensor]) -> Stiffness:
        """Stiffnesses of the elements of the fine mesh, on those of each level."""
        levels, found = self.space.levels, []
        for energy, members in zip(levels.energies, levels.members, strict=True):
            values = [stiffness[i] for i in members]
            if not energy.sampled:
                parts = zip(values, members, energy.parts, strict=True)
                clusters = self.frame.coarse.clusters
                values = [coarse_values(own, self.fine.parts[i], part, clusters) for own, i, part in parts]
            found.append(values)
        return Stiffness(stiffness, found)

    def anchors(self, placed: Pair, t: Tensor) -> Tensor | None:
        """Those of all terms, in the frame. *Shape:* ``(B, P, 3)``."""
        points = self.fine.anchors
        return None if points is None else self.frame.bring(points.to(t).expand(len(t), -1, -1), placed, t)

    def _placed_by_torch(self, samples: Samples) -> tuple[Pair, Tensor]:
        """The pairs in the frame, and whether there is something between them."""
        pair, finite = self._placed(samples)
        return pair, finite & self._solvable(pair)

    def _placed_by_kernels(self, samples: Samples) -> tuple[Pair, Tensor] | None:
        """The same by kernels; None where they cannot."""
        x_a, x_b = samples.x_a, samples.x_b
        if self.fused is None or samples.spacing is not None or not fused_alignment.serves(x_a, x_b, samples.t):
            return None
        found = fused_alignment.place(self.frame, x_a, x_b)
        if found is None:
            return None
        pair, sizes = found
        self._warn_of_size(sizes)
        usable = sizes > SMALLEST_SIZE * DIAGONAL
        if self.closed:
            usable = usable & ~self._mirrored(pair, self.fused.volumes(pair.first, pair.second).prod(-1) < 0)
        return pair, usable

    def _warn_of_size(self, sizes: Tensor) -> None:
        """Say, once for a layer, that key-frames and bases seem to be in different units. *Shape:* ``(P,)``."""
        if self.size_warned or traced(sizes) or transformed(sizes):
            return
        reference = self.frame.reference
        ratios = sizes.detach() / (reference.amax(0) - reference.amin(0)).norm()
        other = (ratios > SMALLEST_SIZE) & ((ratios > OTHER_SIZE) | (ratios < 1 / OTHER_SIZE))
        if not bool(other.any()):
            return
        self.size_warned = True
        warnings.warn(
            f"key-frames are {float(ratios[other][0]):.3g} times as large as the shapes that the bases were made from; "
            "Eq. 5 depends on the size, so that the in-betweens differ from those of bases in the same units: "
            "scale the key-frames, or make the bases from them",
            MeshWarning,
            stacklevel=2,
        )

    def _solvable(self, pair: Pair) -> Tensor:
        """Whether both ends have a size, and none, where closed, is a mirror image. *Shape:* ``(P,)``."""
        # Rows that lie together in memory are looked through several times as fast.
        ends = [x.detach().movedim(-1, 0).contiguous() for x in (pair.first, pair.second)]
        sizes = [(x.amax(-1) - x.amin(-1)).norm(dim=0) for x in ends]
        self._warn_of_size(torch.minimum(*sizes))
        usable = torch.minimum(*sizes) > SMALLEST_SIZE * DIAGONAL
        if not self.closed:
            return usable
        first, second = (_enclosed(x, self.frame.faces) for x in ends)
        return usable & ~self._mirrored(pair, first * second < 0)

    def _mirrored(self, pair: Pair, turned: Tensor) -> Tensor:
        """Samples with a mirrored key-frame, among those whose volumes differ in sign. *Shape:* ``(P,)``."""
        if not traced(turned) and not transformed(turned) and not turned.any():
            return turned
        return turned & looks_mirrored(pair.first, pair.second, self.frame.faces)


def _enclosed(rows: Tensor, faces: Tensor) -> Tensor:
    """Six times the signed volume. *Shape:* ``(3, B, V), (F, 3) -> (B,)``."""
    a, b, c = (pick(rows, corner) for corner in faces.unbind(1))
    return (a * cross(b, c)).sum((0, -1))
