"""In-betweens that do not pass through themselves: those that would are pushed apart, each sample on its own."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.contact.active import ActiveContacts
from torch_modal.contact.search import FINE_PRODUCTS, FINE_STEPS, ROUNDS, Contacts, ContactSearch, refuse_transforms
from torch_modal.inbetween.between import Batch, Between
from torch_modal.inbetween.samples import InBetweenResult, Samples
from torch_modal.solve.solver import Solution

MOST_MOVED = 3.0
"""How far a vertex may be moved, times the depth of the contacts of its shape."""


class Pushed(NamedTuple):
    """A shape that was pushed apart."""

    rounds: list[Contacts]
    """The active contacts of each round that led to it."""
    x: Tensor
    """In the frame. *Shape:* ``(1, V, 3)``."""
    n_crossing: Tensor
    """Pairs of triangles of parts that still go through each other. *Shape:* ``(1,)``."""


class ContactRounds(Between):
    """In-betweens of one pair of bases whose parts do not go through each other. Arguments as for :class:`Between`.

    A shape that passes through itself takes steps of all vertices with its contacts as active constraints; the others
    stay as they are. The result has never more pairs of triangles of parts that go through each other than the shape
    without contact, and no vertex is moved by more than :data:`MOST_MOVED` times the depth of its contacts; where
    nothing does that, it is the shape without contact.
    """

    def forward(self, samples: Samples, report: Callable[[Solution], None] | None) -> InBetweenResult:
        """Solve. Arguments as there.

        Samples with contacts are solved again alone: rounding depends on the batch, and contacts amplify it.
        """
        if len(samples.t) == 1:
            return super().forward(_alone(samples, 0), report)
        whole = super().forward(samples, report)
        n_crossing = whole.solution.n_crossing
        if n_crossing is None or not bool(n_crossing.any()):
            return whole
        some = torch.nonzero(n_crossing).flatten()
        parts = [super(ContactRounds, self).forward(_alone(samples, i), None) for i in some.tolist()]
        each = zip(whole.solution, *(part.solution for part in parts), strict=True)
        merged = (values[0].index_copy(0, some, torch.cat(values[1:])) for values in each)  # type: ignore[union-attr, arg-type]
        shapes = whole.shapes.index_copy(0, some, torch.cat([part.shapes for part in parts]))
        return InBetweenResult(shapes, Solution(*merged))

    def solved(self, batch: Batch) -> tuple[Tensor, Solution]:
        """The shapes, with the pairs of triangles whose parts go through each other; one alone is pushed apart.

        Contacts are found without a gradient; the steps with them have one.
        """
        x, solution = super().solved(batch)
        if not len(x):
            return x, solution._replace(n_crossing=torch.zeros_like(solution.status))
        refuse_transforms(x)
        pair, samples = batch.pair, batch.samples
        search = ContactSearch(self.mesh, pair.first, pair.second, samples.which, samples.t, pairs=self.crossing_pairs)
        pushed = self.found(batch, x.detach(), search) if len(x) == 1 else None
        if pushed is None:
            search.count(x)
            return x, solution._replace(n_crossing=search.n_far)
        if x.requires_grad:
            for active in pushed.rounds:
                x = self._step(batch, x, active)
        else:
            x = pushed.x
        return x, solution._replace(n_crossing=pushed.n_crossing)

    @torch.no_grad()
    def found(self, batch: Batch, x: Tensor, search: ContactSearch) -> Pushed | None:
        """A sample pushed apart; None where it has no contacts, or nothing makes it better.

        After each round contacts are searched again. The shape with the fewest pairs is taken.
        """
        active = search(x)
        if active is None or not bool(search.n_far.any()):
            return None
        start, n_far, least = x, int(search.n_far), _left(search)
        most = MOST_MOVED * search.depth(x)
        rounds: list[Contacts] = []
        best = None
        for _ in range(ROUNDS):
            x = self._step(batch, x, active)
            rounds.append(active)
            fresh, left = search(x), _left(search)
            moved = float((x - start).norm(dim=-1).max())
            if left < least and int(search.n_far) <= n_far and moved <= most:
                least, best = left, Pushed(list(rounds), x, search.n_far)
            if fresh is None or not bool(search.n_left.any()):
                break
            active = fresh.beside(active)
        return best

    def _step(self, batch: Batch, x: Tensor, active: Contacts) -> Tensor:
        """Steps of all vertices of one sample with its contacts. *Shape:* ``(1, V, 3)``."""
        stages = [(FINE_STEPS, FINE_PRODUCTS)]

        def contacts(own: slice, like: Tensor) -> list[ActiveContacts]:
            return [ActiveContacts(active.rows(own), like)]

        return self.fine.relax(x, self.rests_of(batch), stages, contacts)


def _left(search: ContactSearch) -> tuple[int, int]:
    """Pairs of one sample that are not tolerated, and all."""
    return int(search.n_left), int(search.n_far)


def _alone(samples: Samples, i: int) -> Samples:
    """One sample as a batch."""
    pair = slice(i, i + 1) if samples.which is None else samples.which[i : i + 1]
    around = samples.before, samples.after, samples.spacing
    x_a, x_b, before, after, spacing = trees.rows((samples.x_a, samples.x_b, *around), pair)
    t, mu, stiffness = trees.rows((samples.t, samples.mu, samples.stiffness), slice(i, i + 1))
    return Samples(x_a, x_b, None, t, mu, stiffness, before, after, spacing)
