r"""Separation of parts that pass through each other, in one shape or in all shapes of a trajectory.

The displacement :math:`d` is zero where nothing has to be done, and is the one of

.. math:: \min_d \sum_i E_i(x_i + d_i) \quad \text{such that no vertex is accelerated too much}

with the contact term in the energies. The alternating direction method of multipliers (Boyd et al. 2011) alternates
two steps: each shape takes a Newton step of all vertices with its active contacts, and all are brought to the nearest
displacement within the bound on accelerations. A shape alone has no such bound, and takes the Newton steps only.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_modal.contact.acceleration import AccelerationLimit
from torch_modal.contact.active import GAP, ContactEnergy, Contacts, ContactSearch, Pull
from torch_modal.elastic.steps import ExtraEnergies

LOOKED_AT = 8
"""Number of shapes that are tested first: without intersections there, nothing is done."""
SOLVED = 16
"""Number of shapes that take steps; the others follow along a cubic spline."""
BESIDE = 0.125
"""Duration next to a key-frame that intersects itself, in which all shapes take steps."""
AROUND = 2
"""Neighbours in time of shapes with contacts, in which the same vertices are watched."""
SEPARATION_ROUNDS = 4, 12
"""Least and largest number of rounds."""
WIDER = 0.075
"""Growth of the gap of a shape alone in each further round: edges of long triangles cross before a vertex is inside."""
PULL = 40.0
"""Stiffness of the pull to the bounded displacement, by area; a contact has 3,000."""
MOST_MOVED = 3.0
"""Largest displacement of a vertex of a shape alone, times the depth of its contacts."""
GROWTH, MOST_WEIGHT = 3.0, 1e5
"""Growth of the weight that keeps a worse shape where it was, and the weight from which it does not move at all."""


def separate(
    start: Tensor,
    relax: Callable[[Tensor, Tensor, ExtraEnergies], Tensor],
    search: ContactSearch,
    limit: AccelerationLimit | None = None,
    in_modes: Callable[[Tensor, ContactEnergy, Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Separate the parts of T shapes that pass through each other; the shapes as they are, where none do.

    No shape has more far pairs than before. Of one shape, no vertex is moved by more than :data:`MOST_MOVED` times the
    depth of its contacts, and the steps with the contacts that were found are recorded for gradients.

    Args:
        start: The shapes in the frame, with a diagonal of 100. *Shape:* ``(T, V, 3)``.
        relax: Takes a Newton step of all vertices of some of the shapes, from the shapes, their indices and further
            energies. *Shape:* ``(S, V, 3), (S,) -> (S, V, 3)``.
        search: Search for contacts between the known shapes.
        limit: Of shapes at even times between two ends, which have no displacement; None for one shape alone.
        in_modes: First displacement of some of the shapes, from their indices, contacts and second differences in time.
            *Shape:* ``(S,), (N, S) -> (S, V, 3)``.

    Returns:
        The shapes, and the number of far pairs of triangles that are left in each. *Shape:* ``(T, V, 3), (T,)``.
    """
    n, areas = len(start), search.areas
    every = torch.arange(n, device=start.device)
    stride = -(-n // LOOKED_AT)
    if not bool(search.count(start[stride - 1 :: stride]).any()):
        return start, torch.zeros_like(every)
    active, n_before = search(start, every)
    if not len(active.shapes):
        return start, n_before
    search.watch(active, AROUND)
    chosen = every if limit is None else _choose_shapes(limit.times, search)
    x = start
    if limit is not None and in_modes is not None:
        spline = spline_weights(limit.times[chosen], limit.times)
        bend = (limit.differences[:n] @ spline.double()).to(start)
        first = in_modes(chosen, ContactEnergy(active.rows(chosen), areas, start), bend)
        x = start + torch.tensordot(spline, first, 1)
    n_far, best, n_best = n_before, start, n_before
    most = MOST_MOVED * search.depth(start[0]) if limit is None else math.inf
    # Shapes that relax on their own, what the bound took from them so far, and springs of the vertices it limits.
    alone, dual, springs = x, torch.zeros_like(x), torch.zeros_like(x[0, :, 0])
    for k in range(1, SEPARATION_ROUNDS[1] + 1):
        # In a trajectory, wider gaps where it cannot be separated would disturb neighbouring shapes.
        gap = GAP if limit is not None else GAP + WIDER * max(0, k - SEPARATION_ROUNDS[0])
        energies = _energies(active.rows(chosen), Pull((x - dual)[chosen].detach(), springs), areas, gap)
        alone = x.index_copy(0, chosen, relax(alone[chosen], chosen, energies))
        if limit is None:
            x = alone
        else:
            wanted = (alone + dual - start)[chosen]
            if len(chosen) < n:
                wanted = torch.tensordot(spline_weights(limit.times[chosen], limit.times), wanted, 1)
            field, limited = limit.nearest(wanted)
            x = start + field
            dual = dual.index_add(0, chosen, (alone - x)[chosen])
            springs[limited] = PULL * areas[limited]
        some = torch.unique(torch.cat([active.shapes, torch.nonzero(n_far).flatten()]))
        some = every if k == SEPARATION_ROUNDS[0] else some
        contacts, counts = search(x, some)
        active, n_far = contacts.with_former(active), n_far.index_copy(0, some, counts)
        if k < SEPARATION_ROUNDS[0]:
            continue
        moved, n_left = float((x - start).detach().norm(dim=-1).max()), int(n_far.sum())
        if moved <= most and n_left <= int(n_best.sum()) and n_left < int(n_before.sum()):
            best, n_best = x, n_far
        if not bool(n_far.any()):
            break
        chosen = torch.unique(torch.cat([chosen, torch.nonzero(n_far).flatten()]))
    if limit is None or best is start:
        return best, n_best
    return _never_worse(start, best - start, search, limit, n_before)


def _choose_shapes(t: Tensor, search: ContactSearch) -> Tensor:
    """Shapes of a trajectory that take steps. *Shape:* ``(T,) -> (S,)``."""
    # End frames are always solved: they are cheap, and neighbours would bend them.
    stride = max(1, (len(t) + 1) // SOLVED)
    chosen = torch.zeros(len(t), dtype=torch.bool, device=t.device)
    chosen[stride - 1 :: stride] = chosen[0] = chosen[-1] = True
    if len(search.search.known_pairs):
        chosen |= (t < BESIDE) | (t > 1 - BESIDE)
    return torch.nonzero(chosen).flatten()


def _energies(active: Contacts, pull: Pull, areas: Tensor, gap: float = GAP) -> ExtraEnergies:
    """Further energies of the shapes that take steps, of which a slice is relaxed at a time."""

    def extra(samples: slice, like: Tensor) -> Sequence[ContactEnergy | Pull]:
        some = torch.arange(len(pull.to), device=like.device)[samples]
        springs = [Pull(pull.to[samples].to(like), pull.weights.to(like))] if bool(pull.weights.any()) else []
        return [ContactEnergy(active.rows(some), areas, like, gap), *springs]

    return extra


def _never_worse(
    start: Tensor, field: Tensor, search: ContactSearch, limit: AccelerationLimit, n_before: Tensor
) -> tuple[Tensor, Tensor]:
    """Shapes and their far pairs, with less and less of the displacement at the times where it adds some."""
    # The others keep as much of it as the bound allows: if it faded out next to them, they would become worse.
    kept, weights = field, torch.ones_like(field[:, 0, 0])
    while True:
        n_far = search.count(start + kept)
        worse = n_far > n_before
        if not bool(worse.any()):
            return start + kept, n_far
        weights = torch.where(worse, GROWTH * weights, weights)
        kept, _ = limit.nearest(field * (weights == 1)[:, None, None], weights)
        kept = kept * (weights < MOST_WEIGHT)[:, None, None]


def spline_weights(times: Tensor, t: Tensor) -> Tensor:
    """Weights of a cubic spline through values at given times, and zero at 0 and 1. *Shape:* ``(T,), (B,) -> (B, T)``.

    Their first derivative in ``t`` comes as a gradient.
    """
    from scipy.interpolate import CubicSpline  # 0.1 s, only where it is needed

    knots = torch.cat([times.new_zeros(1), times.detach(), times.new_ones(1)]).double().cpu().numpy()
    at = t.detach().double().cpu().numpy()
    spline = CubicSpline(knots, torch.eye(len(knots)).numpy(), bc_type="natural")
    values, slopes = (torch.from_numpy(f(at)[:, 1:-1]).to(t) for f in (spline, spline.derivative()))
    return values + slopes * (t - t.detach())[:, None] if t.requires_grad else values
