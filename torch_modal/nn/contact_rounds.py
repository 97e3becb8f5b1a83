"""In-betweens that do not pass through themselves: what would is made again, with what was found held apart."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.nn import trees
from torch_modal.nn.between import LOCAL_PRODUCTS, POLISH_PRODUCTS, Batch, Between
from torch_modal.nn.contact import FINE_PRODUCTS, FINE_STEPS, ROUNDS, Contacts, ContactSearch
from torch_modal.nn.gauss_newton import GaussNewtonStep
from torch_modal.nn.modal_energy import SumOfEnergies
from torch_modal.nn.relax import relax
from torch_modal.nn.samples import InBetweenResult, Samples, warn_of_starts
from torch_modal.nn.solver import Solution


class Apart(NamedTuple):
    """In-betweens that were pushed apart."""

    x: Tensor
    """In the frame. *Shape:* ``(S, V, 3)``."""
    solution: Solution
    held: Contacts
    start: Tensor
    """Where the minimisation started. *Shape:* ``(S, n)``."""
    n_left: Tensor
    """Pairs of triangles that are neither kept apart nor tolerated. *Shape:* ``(S,)``."""
    n_far: Tensor
    """Pairs of triangles of parts that go through each other all the same. *Shape:* ``(S,)``."""


class ContactRounds(Between):
    """In-betweens of one pair of bases whose parts do not go through each other. Arguments as for :class:`Between`."""

    def forward(self, samples: Samples, report: Callable[[Solution], None] | None) -> InBetweenResult:
        """Solve. Arguments as there; however many rounds it takes, one report."""
        result = super().forward(samples, None)
        if report is not None and self.solver.gradient == "implicit":
            report(result.solution)
            warn_of_starts(result.solution)
        return result

    def solved(self, batch: Batch) -> tuple[Tensor, Solution]:
        """Shapes and solutions, with what crosses all the same.

        In-betweens that would pass through themselves are made again with what was found held; the others stay as they
        are without contact. What is held is found without a gradient.
        """
        x, solution = super().solved(batch)
        n_crossing, apart = self.found(batch, x, solution)
        if apart is None:
            return x, solution._replace(n_crossing=n_crossing)
        some = apart.held.samples
        again, resolved = apart.x, apart.solution
        if x.requires_grad:
            again, resolved = self.apart(_rows(batch, some, apart.start), apart.held)
        pairs = zip(solution[:-1], resolved[:-1], strict=True)
        merged = (whole.index_copy(0, some, part) for whole, part in pairs)  # type: ignore[union-attr, arg-type]
        return x.index_copy(0, some, again), Solution(*merged)._replace(n_crossing=n_crossing)

    @torch.no_grad()
    def found(self, batch: Batch, x: Tensor, solution: Solution) -> tuple[Tensor, Apart | None]:
        """What crosses in each sample, *shape* ``(B,)``, and those that were pushed apart.

        It is looked again after each push; what left the fewest crossings is taken.
        """
        pair, samples = batch.pair, batch.samples
        search = ContactSearch(self.mesh, pair.first, pair.second, samples.which, samples.t, pairs=self.crossing_pairs)
        held = search(x)
        n_crossing = search.n_far
        if held is None:
            return n_crossing, None
        some = held.samples
        batch = _rows(batch, some, solution.amplitudes[some])
        search = search.of(some)
        best: Apart | None = None
        for _ in range(ROUNDS):
            pushed, resolved = self.apart(batch, held)
            found = search(pushed)
            apart = Apart(pushed, resolved, held, batch.start, search.n_left, search.n_far)
            best = apart if best is None else min(best, apart, key=_left)
            if found is None or not bool(search.n_left.any()):
                break
            held, batch = found.of_all(some).beside(held), batch._replace(start=resolved.amplitudes)
        assert best is not None
        return n_crossing.index_copy(0, some, best.n_far), best

    def apart(self, batch: Batch, held: Contacts) -> tuple[Tensor, Solution]:
        """Shapes and solutions with what is held in each sample."""
        space, problem, minimisation = self.space, batch.problem, batch.minimisation
        term = held.modal(self.mesh, space.columns.fine)
        placement = (*problem.placement, held.place(term, problem.base, space.column(problem.difference)))
        step = GaussNewtonStep(SumOfEnergies(*space.energy.parts, term))
        batch = batch._replace(
            problem=problem._replace(placement=placement), minimisation=minimisation._replace(step=step)
        )
        x, solution = self.modal(batch)
        solver, in_contact = self.solver, held.fine(self.mesh, self.terms)
        parts = []
        for own, reference, fixed in self.fine_chunks(batch):
            moved = relax(self.fine, x[own], reference, solver.local_steps, LOCAL_PRODUCTS, fixed)
            reference = held.rows(own).joined(reference)
            moved = relax(in_contact, moved, reference, FINE_STEPS, FINE_PRODUCTS, fixed)
            parts.append(relax(in_contact, moved, reference, solver.polish, POLISH_PRODUCTS, fixed))
        return torch.cat(parts), solution


def _left(apart: Apart) -> tuple[int, int]:
    return int(apart.n_left.sum()), int(apart.n_far.sum())


def _rows(batch: Batch, some: Tensor, start: Tensor) -> Batch:
    """Some of the samples, started elsewhere. *Shape:* ``(S,), (S, n)``."""
    problem, usable, anchors = trees.rows((batch.problem, batch.usable, batch.anchors), some)
    batch = batch._replace(problem=problem, start=start.detach(), energy=None)
    return batch._replace(usable=usable, samples=batch.samples.rows(some), anchors=anchors)
