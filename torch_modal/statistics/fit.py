"""The shape of a set's variation that meets a few observed points."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import recorded
from torch_modal.backends.torch.fine_steps import conjugate_gradients
from torch_modal.geometry.rigid import RigidMotion, best_fit
from torch_modal.geometry.triangle_frames import Sides, edge_means
from torch_modal.statistics.observations import Observations, Pulls
from torch_modal.statistics.patches import bounded
from torch_modal.statistics.variation import Variation

# Standard deviation of observed points, in sizes of the shape, beside local weights of a standard deviation of one.
NOISE = 0.01

# Gauss-Newton steps for the weights, the part of the cost that ends them, and Newton steps that follow, with products.
MOST_STEPS, TOLERANCE, LAST_STEPS, PRODUCTS = 30, 1e-6, 2, 20

# Of a step: how often it is shortened at most. Larger noises that come first, with a few steps of each.
TRIALS, COARSE_NOISE, FEW_STEPS, ROBUST_ROUNDS = 8, (10.0, 3.0), 5, 8

# Of all pulls together, and of one at most, at a size of 100.
STIFFNESS, LARGEST_STIFFNESS = 2000.0, 100.0

# Newton steps and products of the first round, and of each of the next, with weights found anew.
FIRST_ROUND, NEXT_ROUND, N_ROUNDS = (6, 40), (4, 40), 3

# By so many sizes, on average, points may be missed more than by a given shape.
SLACK = 1e-3

# Points extend over more or less than the same vertices of the key-frames by this factor only in other units.
UNITS = 8.0

# Rows of the Jacobian that are made at a time.
CHUNK = 32


class Fitted(NamedTuple):
    """A shape that meets observations."""

    shape: Tensor
    """In the pose of the observations. *Shape:* ``(V, 3)``."""
    weights: Tensor
    """Of the given shapes at each vertex; they add up to one. *Shape:* ``(K, V)``."""
    misses: Tensor
    """Distance of each observed point from its place. *Shape:* ``(n,)``."""
    trust: Tensor
    """How much each observation counts in the end: less than one for outliers. *Shape:* ``(n,)``."""


class Fit:
    r"""Local weights and the rigid motion of least cost, then elastic steps of all vertices.

    The cost of factors ``z`` of the weights' fields is that of their logarithmic posterior density,
    :math:`\sum_i |x_i(z) - p_i|^2 / s^2 + |z|^2`.

    Args:
        variation: The given shapes and how they vary.
        to: The observations.
        about: The weights that are most likely. *Shape:* ``(K,)``.
    """

    def __init__(self, variation: Variation, to: Observations, about: Tensor) -> None:
        self.variation, self.to, self.about = variation, to, about
        self.noise = NOISE * variation.size
        self.influence = _influence(variation, to)

    def shape(self, factors: Tensor) -> Tensor:
        """*Shape:* ``(K, n) -> (V, 3)``."""
        return self.variation.assembled(self.variation.local(factors, self.about))

    def cost(self, factors: Tensor, to: Observations, noise: float | None = None) -> Tensor:
        """*Shape:* ``(K, n) -> ()``."""
        noise = self.noise if noise is None else noise
        seen = to.seen(self.shape(factors))
        off = _pose(seen, to).apply(seen) - to.points
        return (to.weights * off.square().sum(-1)).sum() / noise**2 + factors.square().sum()

    @torch.no_grad()
    def solved(self, robust: bool) -> tuple[Tensor, Tensor]:
        """Factors of least cost, and the weights of the observations. *Shape:* ``(K, n), (n,)``."""
        to, factors = self.to, self.about.new_zeros(len(self.about), len(self.variation.fields))
        for noise in COARSE_NOISE:
            # Far from the points there are other minima, which a more certain prior does not have.
            factors = self.descended(factors, to, noise * self.noise, FEW_STEPS)
        for _ in range(ROBUST_ROUNDS if robust else 0):
            seen = to.seen(self.shape(factors))
            to = _trusted(self.variation, self.to, (_pose(seen, to).apply(seen) - to.points).norm(dim=-1))
            factors = self.descended(factors, to, self.noise, FEW_STEPS)
        factors = self.descended(factors, to, self.noise, MOST_STEPS)
        for _ in range(LAST_STEPS):
            slope = torch.func.grad(self.cost)(factors, to).flatten()
            tried = factors - self.newton(factors, to, 0.5 * slope).view_as(factors)
            if not self.cost(tried, to) <= self.cost(factors, to):  # where the Hessian is indefinite
                break
            factors = tried
        return factors, to.weights

    def descended(self, factors: Tensor, to: Observations, noise: float, n_steps: int) -> Tensor:
        """Steps of Levenberg and Marquardt's method."""
        cost, damping = self.cost(factors, to, noise), 0.0
        for _ in range(n_steps):
            matrix, downhill = self._system(factors, to, noise)
            for _ in range(TRIALS):
                eye = torch.eye(len(matrix)).to(matrix)
                tried = factors + torch.linalg.solve_ex(matrix + damping * eye, downhill).result.view_as(factors)
                value = self.cost(tried, to, noise)
                if value < cost:
                    break
                damping = max(10 * damping, 1.0)
            else:
                break
            damping = damping / 10 if damping > 1 else 0.0
            ended = cost - value < TOLERANCE * cost
            factors, cost = tried, value
            if ended:
                break
        return factors

    def normal(self, factors: Tensor, to: Observations) -> tuple[Tensor, Tensor]:
        """The Jacobian of the places, and they. *Shape:* ``(3n, K n_fields), (n, 3)``."""
        own, y = self.variation, self.variation.bending(self.variation.local(factors, self.about))
        slopes = _slopes(own, y)
        fields = own.coordinates.spread(own.fields)
        deviations = own.deviations  # centred over the shapes, as the weights are
        rows = []
        moves = own.coordinates.size * torch.eye(3, 6).to(y)[..., None]
        beyond = own.coordinates.carries(self.to.vertices).to(y)
        for first, second, carried in zip(*(part.split(CHUNK) for part in (*self.influence, beyond)), strict=True):
            at_faces = first[:, None, None] * slopes[0] + second[:, None, None] * slopes[1]
            at = torch.cat([at_faces, carried[:, None, None] * moves], -1)  # (n, 3, 6, E)
            parts = [(at * deviation).sum(2) @ fields.mT for deviation in deviations]
            rows.append(torch.stack(parts, 2).flatten(2))
        return torch.cat(rows).flatten(0, 1), to.seen(self.shape(factors))

    def _system(self, factors: Tensor, to: Observations, noise: float) -> tuple[Tensor, Tensor]:
        """Gauss-Newton's matrix with the rigid motion eliminated, and half the gradient."""
        jacobian, seen = self.normal(factors, to)
        pose = _pose(seen, to)
        off = pose.inverse().apply(to.points) - seen
        arms = seen - (to.weights @ seen) / to.weights.sum()
        eye = torch.eye(3).to(seen)
        turns = torch.linalg.cross(eye.expand(len(arms), 3, 3), arms[:, None].expand(-1, 3, -1)).mT
        rigid = torch.cat([turns, eye.expand(len(arms), 3, 3)], -1).flatten(0, 1)
        root = (to.weights.sqrt() / noise).repeat_interleave(3)[:, None]
        q = torch.linalg.qr(root * rigid)[0]
        rows = root * jacobian
        rows = rows - q @ (q.mT @ rows)
        matrix = rows.mT @ rows
        matrix.diagonal().add_(1)
        return matrix, rows.mT @ (root[:, 0] * off.flatten()) - factors.flatten()

    def curvature(self, factors: Tensor, to: Observations) -> Callable[[Tensor], Tensor]:
        """Products with half the Hessian of the cost. *Shape:* ``(K n,) -> (K n,)``."""
        with torch.enable_grad():
            own = factors.detach().requires_grad_()
            slope = torch.autograd.grad(0.5 * self.cost(own, to), own, create_graph=True)[0].flatten()
        return lambda x: torch.autograd.grad(slope, own, x, retain_graph=True)[0].flatten()

    def newton(self, factors: Tensor, to: Observations, right: Tensor) -> Tensor:
        """The inverse of half the Hessian, times a vector, by conjugate gradients. *Shape:* ``(K n,)``."""
        matrix = self._system(factors, to, self.noise)[0]
        matrix.diagonal().add_(len(matrix) * torch.finfo(matrix.dtype).eps * matrix.diagonal().max())  # its rounding
        factor = torch.linalg.cholesky_ex(matrix).L

        def precondition(x: Tensor) -> Tensor:
            return torch.cholesky_solve(x[:, None], factor)[:, 0]

        return conjugate_gradients(self.curvature(factors, to), precondition, torch.dot, right, PRODUCTS)


class _Followed(torch.autograd.Function):
    """Factors of least cost, with their derivatives in the observed points by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, factors: Tensor, points: Tensor, given: Fit, to: Observations) -> Tensor:
        ctx.given, ctx.to = given, to
        ctx.save_for_backward(factors, points)
        return factors.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if recorded(grad):
            raise RuntimeError(
                "fits have first derivatives only: second ones would lack the elastic steps, which are constants of "
                "the graph; take the gradient without create_graph"
            )
        factors, points = ctx.saved_tensors
        turned = ctx.given.newton(factors, ctx.to, grad.flatten()).view_as(factors)
        with torch.enable_grad():
            own, to_points = factors.detach().requires_grad_(), points.detach().requires_grad_()
            cost = 0.5 * ctx.given.cost(own, ctx.to._replace(points=to_points))
            slope = torch.autograd.grad(cost, own, create_graph=True)[0]
            return None, -torch.autograd.grad(slope, to_points, turned)[0], None, None


def followed(given: Fit, factors: Tensor, to: Observations) -> Tensor:
    """Factors of least cost, with their derivatives in the observed points. *Shape:* ``(K, n)``."""
    known: Tensor = _Followed.apply(factors, to.points, given, to._replace(points=to.points.detach()))
    return known


def fit(variation: Variation, to: Observations, about: Tensor, robust: bool = False) -> Fitted:
    """The shape that meets observations, differentiable in their points.

    Args:
        variation: The given shapes and how they vary.
        to: The observations.
        about: The weights that are most likely. *Shape:* ``(K,)``.
        robust: Whether outliers are to be ignored.

    Raises:
        ValueError: The points are in other units than the shapes.
    """
    _check_units(variation, to)
    given = Fit(variation, to._replace(points=to.points.detach()), about)
    factors, trust = given.solved(robust)
    to = to._replace(weights=trust)
    if torch.is_grad_enabled() and to.points.requires_grad:
        factors = followed(given, factors, to)
    return _finished(variation, to, variation.local(factors, about))


def _check_units(variation: Variation, to: Observations) -> None:
    """Refuse points in units other than those of the key-frames.

    Raises:
        ValueError: They extend far less, or far more, than the same vertices of all key-frames.
    """
    seen = torch.cat([to.points.detach()[None], variation.shapes[:, to.vertices]])
    # By medians, which a few outliers do not change.
    extent, *known = (seen - seen.median(1, keepdim=True).values).norm(dim=-1).median(1).values.tolist()
    if not min(known) / UNITS <= extent <= max(known) * UNITS:
        raise ValueError(
            f"the points extend over {extent:.3g} around their middle, the same vertices of the key-frames over "
            f"{min(known):.3g} to {max(known):.3g}: they are in other units; scale them to those of the key-frames"
        )


def _finished(variation: Variation, to: Observations, weights: Tensor) -> Fitted:
    """Elastic steps of all vertices, in rounds with weights found anew; the best given shape, where that is nearer.

    The steps are constants of the graph: gradients are those of the weights and of the rigid motion.
    """
    assembled = variation.assembled(weights)
    pose = _pose(to.seen(assembled), to)
    with torch.no_grad():
        stiffness = min(LARGEST_STIFFNESS, STIFFNESS / len(to.points))
        pulls = Pulls(to._replace(points=variation.scale * pose.inverse().apply(to.points)), stiffness)
        own = bounded(weights)
        x = variation.relaxed(assembled, own, *FIRST_ROUND, pulls)
        for _ in range(N_ROUNDS):
            own = variation.mixtures.weights(x)
            x = variation.relaxed(x, own, *NEXT_ROUND, pulls)
        step = x - assembled
        moved = [_pose(to.seen(shape), to).apply(shape) for shape in variation.shapes]
        *errors, error = [float((to.weights * _missed(y, to).square()).sum()) for y in (*moved, pose.apply(x))]
        k = min(range(len(errors)), key=lambda k: errors[k])
        better = error <= errors[k] + float(to.weights.sum()) * (SLACK * variation.size) ** 2
    if better:
        shape = pose.apply(assembled + step)
    else:
        shape, own = (
            _pose(to.seen(moved[k]), to).apply(moved[k]),
            torch.eye(len(moved)).to(x)[k, :, None].expand_as(own),
        )
    return Fitted(shape, own, _missed(shape, to), to.weights)


def _missed(x: Tensor, to: Observations) -> Tensor:
    return (to.seen(x) - to.points).norm(dim=-1)


def _trusted(variation: Variation, to: Observations, missed: Tensor) -> Observations:
    """The observations with less weight for those that are missed by more than most (Geman and McClure)."""
    usual = (3 * missed.median()).clamp_min(NOISE * variation.size)
    return to._replace(weights=to.weights / (1 + (missed / usual) ** 2) ** 2)


def _pose(seen: Tensor, to: Observations) -> RigidMotion:
    """The rigid motion on to the observations. *Shape:* ``(n, 3)``."""
    return best_fit(seen, to.points, to.weights)


def _influence(own: Variation, to: Observations) -> tuple[Tensor, Tensor]:
    """What each observed place receives from the sides of each triangle, but for loose pieces' rotations.

    *Shape:* ``(n, F)`` each.
    """
    n, v = len(to.points), len(own.coordinates.mean)
    parts = to.weights.new_zeros(n, v).scatter(1, to.vertices[:, None], 1)
    reconstruction = own.coordinates.reconstruction
    for piece, anchors in reconstruction.loose:
        # A loose piece goes where the vertices go that it follows.
        parts[:, anchors] += parts[:, piece].sum(1, keepdim=True) / len(anchors)
    sides = [parts.new_zeros(1, n, len(own.faces)).requires_grad_() for _ in range(2)]
    with torch.enable_grad():
        weights, signs = reconstruction.weights, reconstruction.signs
        edges = edge_means(Sides(*sides), weights, reconstruction.sides, signs, len(reconstruction.edges))
        found = reconstruction.poisson(edges, parts.new_zeros(1, n, v))
        first, second = torch.autograd.grad((found[0] * parts).sum(), sides)
    return first[0], second[0]


def _slopes(own: Variation, y: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the sides in the coordinates of their triangle. *Shape:* ``(3, 6, F)`` each."""
    # Each side is that of its triangle alone. By columns, forward mode would take five times as long.
    with torch.enable_grad():
        leaf = y.detach().requires_grad_()
        ends = torch.cat(own.coordinates.sides(leaf[None]))[:, 0]
        rows = [torch.autograd.grad(row.sum(), leaf, retain_graph=True)[0] for row in ends]
    found = torch.stack(rows)[..., : len(own.faces)]
    return found[:3], found[3:]
