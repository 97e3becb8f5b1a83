r"""Contact along a trajectory of shapes: parts that pass through each other are pushed apart, alike at all times.

Shapes that are pushed apart one by one jump where a contact begins and ends. Here one displacement serves all times of
an interval between two key-frames. It vanishes at both, and is the one of

.. math:: \min_d \sum_i E_i(x_i + d_i) \quad \text{such that no vertex is accelerated too much}

with the contact term in the energies. First it is looked for in the modes (``contact/together.py``). Then the
alternating direction method of multipliers (Boyd et al. 2011) has two turns: each shape takes a step of its own to
where it is at rest, and all are brought to what is nearest to that, and to what was amiss before, among what may be
accelerated (``contact/acceleration.py``). Where nothing is in the way, shapes are at rest then.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.backends.torch.alignment import Pair
from torch_modal.contact.acceleration import AccelerationLimit
from torch_modal.contact.active import Pull, settled
from torch_modal.contact.search import Contacts, ContactSearch
from torch_modal.contact.splines import through
from torch_modal.contact.together import together
from torch_modal.inbetween.between import Between
from torch_modal.inbetween.samples import Samples

ROOM = 1.27
"""A vertex may be accelerated so many times as much as the one that is most without contact."""
LEAST_LIMIT = 30.0
"""That is never less than this, at a diagonal of 100: a straight trajectory must bend, too."""
LOOKED_AT = 8
SEARCHED = 16
""":func:`push_apart` has it."""
BESIDE = 0.125
FADE = 0.0625
"""Over how much of the time a displacement is faded out beside a shape that it makes worse, at first."""
AROUND = 2
"""Neighbours in time of shapes with contacts, in which the same vertices are watched."""
ROUNDS = 4, 8
"""How often shapes take a step of their own, at least and at most."""
LEADING = 4
"""Of the shapes that hold nothing, one of so many takes steps at first, and the others come along with it."""
PRODUCTS = 20
"""Iterations of conjugate gradients in such a step."""
PULL = 40.0
"""Stiffness of the pull to shapes of bounded acceleration, by area; a contact has 3,000."""


class Displacement(NamedTuple):
    """The displacement that separates the shapes between two key-frames, at all times."""

    field: Tensor | None
    """At the times of the shapes, in the frame; None where nothing passes through anything. *Shape:* ``(3, T, V)``."""
    times: Tensor
    """*Shape:* ``(T,)``."""
    n_before: Tensor
    """Pairs of triangles of parts that went through each other, in those that were looked at. *Shape:* ``(T,)``."""
    n_crossing: Tensor
    """Those that are left. *Shape:* ``(T,)``, int64."""

    def apply(self, member: Between, samples: Samples, shapes: Tensor) -> tuple[Tensor, Tensor]:
        """Push shapes apart, at any times; between those of the field, along a cubic spline.

        A shape that would have more pairs of triangles that go through each other stays as it is. The gradient reaches
        shapes and times; the field is a constant.

        Args:
            member: In-betweens of the pair of key-frames.
            samples: Of that pair, with the times of the shapes.
            shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.

        Returns:
            The shapes, and the pairs that are left in each, *shape* ``(T,)``.
        """
        if self.field is None:
            return shapes, torch.zeros_like(samples.t, dtype=torch.int64)
        frame, t = member.frame, samples.t
        pair = member.placed(samples)
        placed = trees.picked(pair, samples.which)
        moved, own = self.field, frame.bring(shapes, placed, t)
        n_crossing = self.n_crossing
        if torch.equal(t, self.times) and not t.requires_grad:
            found = own + moved.movedim(0, -1)
        else:
            found = own + (through(self.times, t) @ moved).movedim(0, -1)
            search = _search(member, samples, pair)
            search.count(own)
            before = search.n_far
            search.count(found)
            better = search.n_far <= before
            n_crossing = torch.where(better, search.n_far, before)
            found = torch.where(better[:, None, None], found, own)
        return frame.restore(found, placed, t), n_crossing


@torch.no_grad()
def push_apart(member: Between, samples: Samples, shapes: Tensor) -> Displacement:
    """Find the displacement that separates parts of shapes between two key-frames.

    A few of many shapes are looked at first: where parts go through each other in none of these, there is nothing to
    do. What is found pushes about :data:`SEARCHED` of the shapes apart, and the others along with them; all are looked
    at as they relax.

    Args:
        member: In-betweens of the pair.
        samples: Of one pair of key-frames, with the times of the shapes, which are even.
        shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.
    """
    frame, t = member.frame, samples.t
    pair = member.placed(samples)
    start = frame.bring(shapes, trees.picked(pair, samples.which), t)
    search = _search(member, samples, pair)
    every = -(-len(t) // LOOKED_AT)
    few = range(every - 1, len(t), every)
    first = next(search.crossing(start, few), None)
    if first is None:
        return Displacement(None, t, search.n_far, search.n_far)
    stride = max(1, (len(t) + 1) // SEARCHED)
    # The first and the last hardly cost energy, and would be bent by what is done to the next.
    chosen = {0, *range(stride - 1, len(t), stride), len(t) - 1}
    if search.has_crossed:
        # What a key-frame has comes out beside it.
        chosen |= set(torch.nonzero((t < BESIDE) | (t > 1 - BESIDE)).flatten().tolist())
    some = torch.tensor(sorted(chosen), device=start.device)
    active = search(start, sorted(chosen - {i for i in few if i < first}))
    if active is None or not bool(search.n_far.any()):
        return Displacement(None, t, search.n_far, search.n_far)
    active = active.of_all(torch.arange(len(t), device=start.device))
    search.watch(active, AROUND)
    search.count(start, search.beside(some))
    moved = together(member, samples, pair, start, active, some)
    limit = _limit(member, samples, pair, shapes)
    x = _at_rest(member, samples, pair, start, start + moved, active, some, search, limit)
    search.count(start)
    n_before = search.n_far
    field = _never_worse(start, (x - start).movedim(-1, 0), search, limit)
    return Displacement(field, t, n_before, n_before if field is None else search.n_far)


def _search(member: Between, samples: Samples, pair: Pair) -> ContactSearch:
    """A search in the shapes of a trajectory, with no tolerated crossings."""
    return ContactSearch(
        member.mesh, pair.first, pair.second, samples.which, samples.t, member.crossing_pairs, is_tolerant=False
    )


def _never_worse(start: Tensor, field: Tensor, search: ContactSearch, limit: AccelerationLimit) -> Tensor | None:
    """The displacement, faded out around shapes in which it makes more pairs go through each other.

    Where that makes others worse, it is faded out around these, too, and where it does not help, twice as far: at last,
    nothing is moved. What is left is kept below the limit of the accelerations.

    Args:
        start: Without contact. *Shape:* ``(T, V, 3)``.
        field: The displacement. *Shape:* ``(3, T, V)``.
        search: Has counted the pairs of ``start``, and counts those of the result.
        limit: Of the displacement.

    Returns:
        *Shape:* ``(3, T, V)``; None where nothing is left.
    """
    t, n_before, found, reach = search.t, search.n_far, field, FADE
    bad = torch.zeros_like(n_before, dtype=torch.bool)
    while True:
        search.count(start + found.movedim(0, -1))
        worse = search.n_far > n_before
        if not bool(worse.any()):
            return found
        if reach > 1:
            return None
        if not bool((worse & ~bad).any()):
            reach = 2 * reach
        bad = bad | worse
        distance = ((t[:, None] - t[bad]).abs().amin(1) / reach).clamp_max(1)
        found, _ = limit.nearest(field * (distance**2 * (3 - 2 * distance))[:, None])


def _limit(member: Between, samples: Samples, pair: Pair, shapes: Tensor) -> AccelerationLimit:
    """Of the accelerations between shapes that follow each other, as the caller sees them.

    At a key-frame at which the trajectory goes on, either side has half of the room: it is not to be bounced off.
    """
    t = samples.t
    n = len(t) + 1
    given = torch.cat([samples.x_a[:1], shapes, samples.x_b[:1]])
    own = n**2 * (given[2:] - 2 * given[1:-1] + given[:-2]).nan_to_num() * member.frame.scale
    each = torch.eye(n + 1).to(t)
    second = n**2 * (each[2:] - 2 * each[1:-1] + each[:-2])[:, 1:-1]
    ends = [i for i, beside in ((0, samples.before), (-1, samples.after)) if beside is not None]
    rows = torch.cat([own, *(own[i][None] for i in ends)])
    second = torch.cat([second, *(2 * n**2 * each[1:-1, 1:-1][i][None] for i in ends)])
    placed = trees.picked(pair, samples.which)
    turns = placed.placed.rotation.mT @ member.frame.motion(placed, t).rotation
    most = max(ROOM * float(own.norm(dim=-1).max()), LEAST_LIMIT)
    return AccelerationLimit(rows.movedim(-1, 0).contiguous(), second, turns, most)


def _at_rest(
    member: Between,
    samples: Samples,
    pair: Pair,
    start: Tensor,
    x: Tensor,
    active: Contacts,
    every: Tensor,
    search: ContactSearch,
    limit: AccelerationLimit,
) -> Tensor:
    """Relaxed shapes with their active contacts, as far as accelerations allow.

    Some take steps, and the others follow along a cubic spline; what passes through itself there takes steps, too.
    What leaves the fewest crossings is kept.

    Args:
        member: In-betweens of the pair of key-frames.
        samples: Of that pair, with the times of the shapes.
        pair: The key-frames in the frame.
        start: Without contact. *Shape:* ``(T, V, 3)``.
        x: Where they begin. *Shape:* ``(T, V, 3)``.
        active: Of all shapes.
        every: Those that take steps. *Shape:* ``(S,)``.
        search: Finds what crosses.
        limit: Of the displacement from ``start``.
    """
    t, n_least, all_times = samples.t, ROUNDS[0], torch.arange(len(samples.t), device=samples.t.device)
    best: tuple[int, Tensor] | None = None
    # Where each shape would rest alone, what it was kept from in all rounds, and the vertices that ever were.
    alone, dual, stiffness = x, torch.zeros_like(x), torch.zeros_like(x[0, :, 0])
    # Shapes without contacts are close to their neighbours in time: some of these shapes lead the others at first.
    leading = search.is_watched(every)
    searched = every[leading]
    leading[::LEADING] = True
    for k in range(1, ROUNDS[1] + 1):
        if k % 2:  # one step changes few of the contacts
            fresh = search(x, searched.tolist())
            active = active if fresh is None else fresh.of_all(active.samples).beside(active)
        # Those whose rest is known, and those that take a step to it now.
        known = every[leading] if k < n_least else every
        own = known if k <= n_least else every[search.is_watched(every)]
        pull = Pull((x - dual)[own], stiffness)
        rest = settled(member, samples.rows(own), pair, alone[own], active.rows(own), pull, PRODUCTS)
        alone = alone.index_copy(0, own, rest)
        wanted = (alone + dual - start)[known].movedim(-1, 0)
        moved, kept = limit.nearest(wanted if len(known) == len(t) else through(t[known], t) @ wanted)
        x = start + moved.movedim(0, -1)
        alone, dual = x.index_copy(0, known, alone[known]), dual.index_add(0, known, (alone - x)[known])
        stiffness[kept] = PULL * search.areas[0][kept]
        if k >= n_least or k % 2 == 0:
            among = every if k < n_least else all_times
            search.count(x, among.tolist() if k == n_least else among[search.is_watched(among)].tolist())
        if k >= n_least:
            n_left = int(search.n_far.sum())
            if best is None or n_left < best[0]:
                best = n_left, x
            if not n_left:
                break
            every = torch.nonzero((search.n_far > 0).index_fill(0, every, True)).flatten()
        searched = every[search.n_far[every] > 0]
    assert best is not None
    return best[1]
