r"""Contact along a course of shapes: what passes through itself is pushed apart, the same way at all times.

Shapes that are pushed apart one by one jump where a contact begins and ends. Here one displacement serves all times of
an interval between two key-frames: a cubic spline in time, :math:`d(t) = \sum_j B_j(t)\, c_j`, which vanishes at the
key-frames. What is minimised is the sum of the energies of all shapes, with the contact term, and of the squared
accelerations of the displacement:

.. math:: \sum_i E_i(x_i + d(t_i)) + \lambda \sum_v A_v \int |\ddot d_v|^2 dt

and of what is beyond the largest acceleration that a vertex may have (``sequence/acceleration.py``).

At last each shape comes to rest on its own, with what is held in it. The displacement is then what comes nearest to
that among those that accelerate no vertex too much: where nothing is in the way, it is at rest.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.nn import trees
from torch_modal.nn.between import Between
from torch_modal.nn.contact import Contacts, ContactSearch
from torch_modal.nn.frame import Pair
from torch_modal.nn.held import settled
from torch_modal.nn.samples import Samples
from torch_modal.sequence.acceleration import AccelerationLimit
from torch_modal.sequence.coupled import Coupled
from torch_modal.sequence.splines import splines, through

ROOM = 1.15
"""A vertex may be accelerated so many times as much as the one that is most without contact."""
LEAST_LIMIT = 30.0
"""That is never less than this, at a diagonal of 100: a straight course has to be left, too."""
REGION = 0.18
"""Of the diagonal, along the surface: how far from what is held vertices move on their own, beside the modes."""
LOOKED_AT = 8
SEARCHED = 16
""":func:`push_apart` has it."""
BESIDE = 0.125
ROUNDS = 1, 4
"""How often all shapes are pushed apart together, the second where a key-frame passes through itself, at most."""
FINE_STEPS = 2
LEAST_SETTLINGS = 2
SETTLINGS = 4
"""How often all shapes come to rest, each on its own, and their displacement is fitted to what may be accelerated."""
INSISTENCE = 10.0
"""How much more the displacement of a shape counts in the fit, each time that it is not free of crossings."""
LEADING = 4
"""Of the shapes that hold nothing, one of so many comes to rest the first time, and the others along with it."""
SETTLING_STEPS = 2
SETTLING_PRODUCTS = 20
AROUND = 2
"""Shapes beside those that hold something in which the same is watched."""


class Displacement(NamedTuple):
    """What pushes the shapes between two key-frames apart, at all times."""

    field: Tensor | None
    """At the times of the shapes, in the frame; None where nothing passes through anything. *Shape:* ``(3, T, V)``."""
    times: Tensor
    """*Shape:* ``(T,)``."""
    n_before: Tensor
    """Pairs of triangles of parts that went through each other, in those that were looked at. *Shape:* ``(T,)``."""
    n_crossing: Tensor
    """Those that are left. *Shape:* ``(T,)``, int64."""

    def apply(self, member: Between, samples: Samples, shapes: Tensor) -> Tensor:
        """Push shapes apart, at any times; between those of the field, along a cubic spline.

        The gradient reaches shapes and times; the field is a constant.

        Args:
            member: In-betweens of the pair of key-frames.
            samples: Of that pair, with the times of the shapes.
            shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.
        """
        if self.field is None:
            return shapes
        frame, t = member.frame, samples.t
        placed = trees.picked(member.placed(samples), samples.which)
        moved = self.field
        if t.requires_grad or not torch.equal(t, self.times):
            moved = through(self.times, t) @ moved
        return frame.restore(frame.bring(shapes, placed, t) + moved.movedim(0, -1), placed, t)


@torch.no_grad()
def push_apart(member: Between, samples: Samples, shapes: Tensor) -> Displacement:
    """Find what pushes shapes between two key-frames apart where parts went through each other.

    A few of many shapes are looked at first: where parts go through each other in none of these, there is nothing to
    do. What is found pushes about :data:`SEARCHED` of the shapes apart, and the others along with them; all are looked
    at as they come to rest.

    Args:
        member: In-betweens of the pair.
        samples: Of one pair of key-frames, with the times of the shapes, which are even.
        shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.
    """
    frame, t = member.frame, samples.t
    pair = member.placed(samples)
    start = frame.bring(shapes, trees.picked(pair, samples.which), t)
    limit = _limit(member, samples, pair, shapes, start)
    free = samples.before is None, samples.after is None
    search = ContactSearch(
        member.mesh, pair.first, pair.second, samples.which, t, limit.most, free, member.crossing_pairs
    )
    every = -(-len(t) // LOOKED_AT)
    few = range(every - 1, len(t), every)
    first = next(search.crossing(start, few), None)
    if first is None:
        return Displacement(None, t, search.n_far, search.n_far)
    stride = max(1, (len(t) + 1) // SEARCHED)
    # The first and the last hardly cost energy, and would be bent by what is done to the next.
    chosen = {0, *range(stride - 1, len(t), stride), len(t) - 1}
    if search.is_tolerant:
        # What a key-frame has comes out beside it.
        chosen |= set(torch.nonzero((t < BESIDE) | (t > 1 - BESIDE)).flatten().tolist())
    course = _Course(member, samples, pair, start, limit, search)
    some = torch.tensor(sorted(chosen), device=start.device)
    held = search(start, sorted(chosen - {i for i in few if i < first}))
    if held is None or not bool(search.n_left.any()):
        return Displacement(None, t, search.n_far, search.n_far)
    held = held.of_all(torch.arange(len(t), device=start.device))
    search.watch(held, AROUND)
    search.count(start, search.beside(some))
    n_before = search.n_far
    x = course.settled(course.pushed(held, some), some, n_before)
    return Displacement((x - start).movedim(-1, 0), t, n_before, search.n_far)


def _limit(member: Between, samples: Samples, pair: Pair, shapes: Tensor, start: Tensor) -> AccelerationLimit:
    """Of the accelerations between shapes that follow each other, as the caller sees them, turned into the frame.

    At a key-frame at which the course goes on, either side has half of the room: it is not to be bounced off.
    """
    t = samples.t
    n = len(t) + 1
    given = torch.cat([samples.x_a[:1], shapes, samples.x_b[:1]])
    bent = n**2 * (given[2:] - 2 * given[1:-1] + given[:-2])
    placed = trees.picked(pair, samples.which)
    own = (member.frame.bring(shapes + bent, placed, t) - start).nan_to_num()
    each = torch.eye(n + 1).to(t)
    second = n**2 * (each[2:] - 2 * each[1:-1] + each[:-2])[:, 1:-1]
    ends = [i for i, beside in ((0, samples.before), (-1, samples.after)) if beside is not None]
    rows = torch.cat([own, *(own[i][None] for i in ends)])
    second = torch.cat([second, *(2 * n**2 * each[1:-1, 1:-1][i][None] for i in ends)])
    area = member.frame.weights / member.frame.weights.sum()
    most = max(ROOM * float(own.norm(dim=-1).max()), LEAST_LIMIT)
    return AccelerationLimit(rows.movedim(-1, 0).contiguous(), second, splines(t).values, area, most)


class _Course:
    """Shapes between two key-frames."""

    def __init__(
        self,
        member: Between,
        samples: Samples,
        pair: Pair,
        start: Tensor,
        limit: AccelerationLimit,
        search: ContactSearch,
    ) -> None:
        self.member, self.samples, self.pair, self.start = member, samples, pair, start
        self.limit, self.search = limit, search

    def pushed(self, held: Contacts, some: Tensor) -> "_Found":
        """All shapes with a displacement that frees some of them; what leaves the fewest crossings is kept.

        Args:
            held: Of all shapes.
            some: Those that are to be free. *Shape:* ``(S,)``.
        """
        search, start = self.search, self.start
        rows = start[some].movedim(-1, 0).contiguous()
        solver = Coupled(self.member, self.samples.rows(some), self.pair, rows, self.limit)
        at, functions = start.new_zeros(3, solver.basis.shape[1], start.shape[1]), splines(self.samples.t).values
        found: list[_Found] = []
        for _ in range(ROUNDS[search.is_tolerant]):
            own = held.rows(some)
            at = solver.fine(solver.modal(at, own), own, search.near(REGION), FINE_STEPS)
            here = _Found(start + (functions @ at).movedim(0, -1), held, search.n_left, search.n_far)
            held = self.looked(here, self.watched(some))
            found.append(here._replace(held=held, n_left=search.n_left, n_far=search.n_far))
            if not bool(search.n_left[some].any()):
                break
        return min(found, key=_left)

    def watched(self, some: Tensor) -> list[int]:
        """Those of some shapes that hold something, or are beside such ones. *Shape:* ``(S,)``."""
        return [i for i in some.tolist() if self.search.watched[i] is not None]

    def looked(self, found: "_Found", some: Sequence[int]) -> Contacts:
        """What is held after another search in some shapes."""
        fresh = self.search(found.x, some)
        return found.held if fresh is None else fresh.of_all(found.held.samples).beside(found.held)

    def settled(self, found: "_Found", own: Tensor, n_before: Tensor) -> Tensor:
        """Some shapes brought to rest, each on its own, and all as near to that as their accelerations allow.

        Those between follow along a cubic spline; what passes through itself there comes to rest on its own, too. What
        leaves the fewest crossings is kept; the search counts them. At last, shapes that are no better for it are put
        back, as far as their neighbours in time allow: what cannot be freed need not be crumpled.

        Args:
            found: Where to start.
            own: The shapes that come to rest on their own. *Shape:* ``(S,)``.
            n_before: Pairs that cross without contact. *Shape:* ``(T,)``.

        Returns:
            *Shape:* ``(T, V, 3)``.
        """
        search, weights, tried = self.search, torch.ones_like(self.samples.t), []
        # What holds nothing is near to its neighbours in time: some of these shapes lead the others.
        leading = (found.held.weights[own] > 0).any(1)
        leading[::LEADING] = True
        back = torch.zeros_like(n_before, dtype=torch.bool)
        for k in range(1, SETTLINGS + 1):
            x = self.at_rest(found, own[leading] if k == 1 else own, weights, back)
            search.count(x, self.watched(own) if k < LEAST_SETTLINGS else None)
            found = _Found(x, found.held, search.n_left, search.n_far)
            if k >= LEAST_SETTLINGS:
                tried.append(found)
                if not bool(search.n_left.any()):
                    break
                own = torch.nonzero((search.n_left > 0).index_fill(0, own, True)).flatten()
                weights = torch.where(search.n_left > 0, INSISTENCE * weights, weights)
                if k + 1 == SETTLINGS:
                    back = (search.n_far > 0) & (search.n_far >= n_before)
                    weights = torch.where(back, INSISTENCE, weights)
            if k < SETTLINGS:
                found = found._replace(held=self.looked(found, own[search.n_far[own] > 0].tolist()))
        best = min(tried, key=_left)
        search.n_left, search.n_far = best.n_left, best.n_far
        return best.x

    def at_rest(self, found: "_Found", own: Tensor, weights: Tensor, back: Tensor) -> Tensor:
        """All shapes after some have taken steps of their own. *Shape:* ``(T, V, 3)``.

        Args:
            found: Where these start.
            own: Which. *Shape:* ``(S,)``.
            weights: How much each counts where not all can be had. *Shape:* ``(T,)``.
            back: Those that are to be where they were without contact. *Shape:* ``(T,)``.
        """
        samples, t = self.samples.rows(own), self.samples.t
        rest = settled(
            self.member, samples, self.pair, found.x[own], found.held.rows(own), SETTLING_STEPS, SETTLING_PRODUCTS
        )
        moved = (rest - self.start[own]).movedim(-1, 0)
        if len(own) < len(t):
            moved = through(t[own], t) @ moved
        moved = torch.where(back[:, None], 0, moved)
        return self.start + self.limit.nearest(moved, weights).movedim(0, -1)


class _Found(NamedTuple):
    """Shapes that were pushed apart, what is held in them, and what is left."""

    x: Tensor
    """*Shape:* ``(T, V, 3)``."""
    held: Contacts
    """Of all of them."""
    n_left: Tensor
    """*Shape:* ``(T,)``."""
    n_far: Tensor
    """*Shape:* ``(T,)``."""


def _left(found: _Found) -> tuple[int, int]:
    return int(found.n_far.sum()), int(found.n_left.sum())
