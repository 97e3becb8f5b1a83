"""The shapes of a set's variation that meet a few observed points."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torch_modal.autograd import is_transformed
from torch_modal.contact.active import Pull
from torch_modal.keyframes.arrays import broadcast_leading, check_tensor, require_units
from torch_modal.statistics.local_weights import NOISE, LocalWeights, Observations
from torch_modal.statistics.variation import Variation, bound_weights

# Stiffness of all springs together, and of one at most, at a size of 100, for exact points. Like the precision of the
# points, it falls with the square of their standard deviation.
STIFFNESS, LARGEST_STIFFNESS = 2000.0, 100.0

# Products in the Newton steps of the first elastic round, and of each of the next, with weights computed anew.
FIRST_ROUND, NEXT_ROUND, N_ROUNDS = 6 * [40], 4 * [40], 3

# Mean distance, in sizes, by which the result may be farther from the points than a given shape.
DISTANCE_SLACK = 1e-3


class Fitted(NamedTuple):
    """A shape that meets observations."""

    shape: Tensor
    """In the pose of the observations. *Shape:* ``(V, 3)``."""
    weights: Tensor
    """Weights of the given shapes at each vertex, with sum one. *Shape:* ``(K, V)``."""
    misses: Tensor
    """Distance of each point from its place; a constant where the weight is zero, NaN of NaN. *Shape:* ``(n,)``."""
    trust: Tensor
    """Final weight of each point: the given one, less for outliers. *Shape:* ``(n,)``."""


def point_springs(to: Observations, stiffness: float, n_vertices: int) -> Pull:
    """``stiffness sum_i weights_i |x_i - p_i|^2`` of vertices, but for a constant where points share one."""
    vertices = to.corners[:, 0]
    weights = to.weights.new_zeros(n_vertices).index_add(0, vertices, stiffness * to.weights)
    weighted = stiffness * to.weights[:, None] * to.points
    sums = weighted.new_zeros(n_vertices, 3).index_add(0, vertices, weighted)
    return Pull((sums / weights.clamp_min(torch.finfo(weights.dtype).tiny)[:, None])[None], weights)


def fit(
    variation: Variation,
    points: Tensor,
    vertices: Tensor,
    near: int | Tensor | None = None,
    robust: bool = False,
    weights: Tensor | None = None,
    noise: float | None = None,
) -> Fitted:
    """The shapes that meet observed points; see :meth:`torch_modal.ShapeSpace.fit`.

    Raises:
        ValueError: Points, vertices or weights do not fit, or the points are in other units.
        RuntimeError: The points are within a transform of ``torch.func``, or have a tangent.
    """
    if torch.is_inference_mode_enabled():  # weights are found by gradients
        with torch.inference_mode(False), torch.no_grad():
            near = near.clone() if isinstance(near, Tensor) else near
            points, vertices = (torch.as_tensor(x).clone() for x in (points, vertices))
            return fit(variation, points, vertices, near, robust, weights, noise)
    points = torch.as_tensor(points)
    if is_transformed(points):
        raise RuntimeError("fits have no forward mode, and no transforms of torch.func: take torch.autograd.grad")
    noise = float(noise or 0)
    if not 0 <= noise < torch.inf:
        raise ValueError(f"noise is a standard deviation, zero or more, in the units of the points; got {noise}")
    k, v = variation.shapes.shape[:2]
    about, (every, vertices, trust) = _check_near(near, k), _check_points(points, vertices, weights, v)
    lead, n, fits = every.shape[:-2], len(vertices), []
    for one, counts in zip(every.reshape(-1, n, 3), trust.reshape(-1, n), strict=True):
        to = Observations.at_vertices(one.to("cpu", torch.float64), vertices, counts)
        fits.append(_fit_one(variation, to, about, robust, noise))
    if not fits:
        return Fitted(*(points.new_zeros(*lead, *shape) for shape in ((v, 3), (k, v), (n,), (n,))))
    return Fitted(*(torch.stack(field).view(*lead, *field[0].shape).to(points) for field in zip(*fits, strict=True)))


def _fit_one(variation: Variation, every: Observations, about: Tensor, robust: bool, noise: float) -> Fitted:
    """The shape that meets one set of points: of the weights of least cost, then after elastic steps of all vertices.

    The steps are constants of the graph. Where a given shape is nearer to the points, it is the result.
    """
    observed = every.weights > 0
    to = Observations(*(column[observed] for column in every))
    same = "the same vertices of the key-frames"
    require_units("the points", to.points.detach(), same, variation.shapes[:, to.corners[:, 0]])
    local = LocalWeights(variation, to, about, noise)
    factors, to = local.solve(robust)
    weights = local.weights(factors)
    assembled = variation.assemble(weights)
    pose = to.pose(assembled)
    with torch.no_grad():
        stiffness = min(LARGEST_STIFFNESS, STIFFNESS / len(to.points)) * (NOISE * variation.size / local.noise) ** 2
        there = to._replace(points=variation.scale * pose.inverse().apply(to.points))
        springs = point_springs(there, stiffness, len(assembled))
        mixed = bound_weights(weights)
        x = variation.relax(assembled, mixed, FIRST_ROUND, springs)
        for _ in range(N_ROUNDS):
            mixed = variation.mixtures.weights(x)
            x = variation.relax(x, mixed, NEXT_ROUND, springs)
        step = x - assembled
        missed = [to.distances_after_fit(shape) for shape in variation.shapes]
        *errors, error = ((to.weights * each.square()).sum() for each in (*missed, to.distances(pose.apply(x))))
        least, k = torch.stack(errors).min(0)
    if error > least + to.weights.sum() * (DISTANCE_SLACK * variation.size) ** 2:
        shape = to.pose(variation.shapes[k]).apply(variation.shapes[k])
        mixed = one_hot(k, len(errors)).to(x)[:, None].expand_as(mixed)
    else:
        shape = pose.apply(assembled + step)
    misses, trust = every.distances(shape).detach(), torch.zeros_like(every.weights)
    misses[observed], trust[observed] = to.distances(shape), to.weights
    return Fitted(shape, mixed, misses, trust)


def _check_points(
    points: Tensor, vertices: Tensor, weights: Tensor | None, n_vertices: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Points of all sets, with vertices and weights on the CPU; raises for what does not fit.

    *Shape:* ``(..., n, 3), (n,), (..., n)``.
    """
    check_tensor("points", points, "...", "n", 3)
    numbers = torch.as_tensor(vertices).cpu()
    n = points.shape[-2]
    fits = numbers.shape == (n,) and numbers.dtype in (torch.int32, torch.int64)
    if not fits or not bool(((numbers >= 0) & (numbers < n_vertices)).all()):
        raise ValueError(f"vertices hold an index from 0 to {n_vertices - 1} for each of {n} points; got {numbers}")
    trust = torch.as_tensor(torch.ones(n) if weights is None else weights).detach().cpu().double()
    check_tensor("weights", trust, "...", n)
    lead = (*broadcast_leading(points=points.shape[:-2], weights=trust.shape[:-1]), n)
    if not bool(((trust >= 0) & trust.isfinite()).all()):
        raise ValueError(f"weights are finite and none below zero; got {float(trust.min())} to {float(trust.max())}")
    points, trust = points.expand(*lead, 3), trust.expand(lead).clone()
    seen = trust > 0
    if not bool(points.detach()[seen.to(points.device)].isfinite().all()):
        raise ValueError("points hold numbers that are not finite; give those that were not observed a weight of zero")
    fewest = min((len(numbers[row].unique()) for row in seen.view(-1, n)), default=3)
    if fewest < 3:
        raise ValueError(f"a pose follows from three vertices or more with weights above zero; a set has {fewest}")
    return points, numbers.long(), trust


def _check_near(near: int | Tensor | None, n: int) -> Tensor:
    """Weights of n shapes; raises unless they add up to one. *Shape:* ``(n,)``, float64."""
    if near is None:
        return torch.full((n,), 1 / n, dtype=torch.float64)
    if isinstance(near, int) and -n <= near < n:
        return torch.eye(n, dtype=torch.float64)[near]
    weights = torch.as_tensor(near).detach().to("cpu", torch.float64)
    if weights.shape != (n,) or not bool(((weights >= 0).all()) & ((weights.sum() - 1).abs() < 1e-5)):
        raise ValueError(f"near is one of {n} key-frames, or {n} weights that add up to one; got {near}")
    return weights
