"""The shape of a set's variation that meets a few observed points."""

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import recorded
from torch_modal.backends.torch.fine_steps import FurtherDerivatives, conjugate_gradients
from torch_modal.geometry.rigid import RigidMotion, best_fit
from torch_modal.geometry.triangle_frames import Sides, edge_means
from torch_modal.solve.fitting import levenberg_marquardt
from torch_modal.statistics.variation import Variation, bounded

# Standard deviation of observed points, in sizes of the shape, beside local weights of a standard deviation of one; and
# larger ones that come first, relative to it: far from the points there are other minima, which a more certain prior
# does not have.
NOISE, COARSE_NOISE = 0.01, (10.0, 3.0)

# Gauss-Newton steps for the weights, with coarse noise or changing weights and at last, and the part of the cost that
# ends them; rounds of weights of the observations; Newton steps that follow, and products in each.
FEW_STEPS, MOST_STEPS, TOLERANCE, ROBUST_ROUNDS, LAST_STEPS, PRODUCTS = 5, 30, 1e-6, 8, 2, 20

# Stiffness of all pulls together, and of one at most, at a size of 100.
STIFFNESS, LARGEST_STIFFNESS = 2000.0, 100.0

# Newton steps and products of the first elastic round, and of each of the next, with weights computed anew.
FIRST_ROUND, NEXT_ROUND, N_ROUNDS = (6, 40), (4, 40), 3

# Mean distance, in sizes, by which the result may be farther from the points than a given shape.
SLACK = 1e-3

# Points that extend over more or less than the same vertices of the key-frames by this factor are in other units.
UNITS = 8.0

# Rows of the Jacobian that are computed together.
CHUNK = 32


class Observations(NamedTuple):
    """Points with the vertices that should be there."""

    points: Tensor
    """*Shape:* ``(n, 3)``."""
    vertices: Tensor
    """*Shape:* ``(n,)``."""
    weights: Tensor
    """Weight of each observation. *Shape:* ``(n,)``."""

    def pose(self, x: Tensor) -> RigidMotion:
        """Rigid motion of a shape on to the points. *Shape:* ``(V, 3)``."""
        return best_fit(x[self.vertices], self.points, self.weights)

    def missed(self, x: Tensor) -> Tensor:
        """Distances of the points from their vertices. *Shape:* ``(V, 3) -> (n,)``."""
        return (x[self.vertices] - self.points).norm(dim=-1)


class Pulls:
    """``stiffness sum_i weights_i |x_i - p_i|^2`` of one shape, as an energy beside that of the terms.

    Args:
        to: The observations.
        stiffness: Per squared length.
    """

    def __init__(self, to: Observations, stiffness: float) -> None:
        self.to, self.factors = to, stiffness * to.weights

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(1, V, 3) -> (1,)``."""
        return (self.factors * (x[0, self.to.vertices] - self.to.points).square().sum(-1)).sum()[None]

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(1, V, 3)``."""

        def spread(at_vertices: Tensor) -> Tensor:  # from the observed vertices to all, doubled
            values = 2 * self.factors[:, None] * at_vertices
            return x.new_zeros(x.shape[1], values.shape[1]).index_add(0, self.to.vertices, values)[None]

        diagonal = spread(x.new_tensor([1, 0, 0, 1, 0, 1]).expand(len(self.factors), 6))
        gradient = spread(x[0, self.to.vertices] - self.to.points)
        return FurtherDerivatives(self.value(x), gradient, diagonal, lambda f: spread(f[0, self.to.vertices]))


class Fitted(NamedTuple):
    """A shape that meets observations."""

    shape: Tensor
    """In the pose of the observations. *Shape:* ``(V, 3)``."""
    weights: Tensor
    """Weights of the given shapes at each vertex, with sum one. *Shape:* ``(K, V)``."""
    misses: Tensor
    """Distance of each observed point from its place. *Shape:* ``(n,)``."""
    trust: Tensor
    """Final weight of each observation: less than one for outliers. *Shape:* ``(n,)``."""


class Fit:
    r"""Local weights and the rigid motion of least cost.

    The cost of factors ``z`` of the weights' fields is that of their logarithmic posterior density,
    :math:`\sum_i |x_i(z) - p_i|^2 / s^2 + |z|^2`.

    Args:
        variation: The given shapes and how they vary.
        to: The observations.
        about: The most likely weights. *Shape:* ``(K,)``.
    """

    def __init__(self, variation: Variation, to: Observations, about: Tensor) -> None:
        self.variation, self.to, self.about = variation, to, about
        self.noise = NOISE * variation.size
        self.influence = self._influence()

    def shape(self, factors: Tensor) -> Tensor:
        """*Shape:* ``(K n,) -> (V, 3)``."""
        return self.variation.assembled(self.weights(factors))

    def weights(self, factors: Tensor) -> Tensor:
        """Local weights. *Shape:* ``(K n,) -> (K, V)``."""
        return self.variation.local(factors.view(len(self.about), -1), self.about)

    def cost(self, factors: Tensor, to: Observations, noise: float) -> Tensor:
        """*Shape:* ``(K n,) -> ()``."""
        x = self.shape(factors)
        missed = to.missed(to.pose(x).apply(x)).square()
        return (to.weights * missed).sum() / noise**2 + factors.square().sum()

    @torch.no_grad()
    def solved(self, robust: bool) -> tuple[Tensor, Tensor]:
        """Factors of least cost, and the weights of the observations. *Shape:* ``(K n,), (n,)``."""
        to, factors = self.to, self.about.new_zeros(len(self.about) * len(self.variation.fields))

        def descended(noise: float, n_steps: int) -> Tensor:
            cost, linearise = partial(self.cost, to=to, noise=noise), partial(self.linearised, to=to, noise=noise)
            return levenberg_marquardt(factors, cost, linearise, n_steps, TOLERANCE)

        for noise in COARSE_NOISE:
            factors = descended(noise * self.noise, FEW_STEPS)
        for _ in range(ROBUST_ROUNDS if robust else 0):
            # Observations that are missed by more than most have less weight (Geman and McClure).
            x = self.shape(factors)
            missed = to.missed(to.pose(x).apply(x))
            usual = (3 * missed.median()).clamp_min(self.noise)
            to = to._replace(weights=self.to.weights / (1 + (missed / usual) ** 2) ** 2)
            factors = descended(self.noise, FEW_STEPS)
        factors = descended(self.noise, MOST_STEPS)
        for _ in range(LAST_STEPS):
            slope = torch.func.grad(self.cost)(factors, to, self.noise)
            tried = factors - self.newton(factors, to, 0.5 * slope)
            if not self.cost(tried, to, self.noise) <= self.cost(factors, to, self.noise):  # an indefinite Hessian
                break
            factors = tried
        return factors, to.weights

    def linearised(self, factors: Tensor, to: Observations, noise: float) -> tuple[Tensor, Tensor]:
        """Gauss-Newton matrix without the rigid motion, and half the negative gradient. *Shape:* ``(K n,)``."""
        seen = self.shape(factors)[to.vertices]
        off = best_fit(seen, to.points, to.weights).inverse().apply(to.points) - seen
        arms = seen - (to.weights @ seen) / to.weights.sum()
        eye = torch.eye(3).to(seen).expand(len(arms), 3, 3)
        turns = torch.linalg.cross(eye, arms[:, None].expand(-1, 3, -1)).mT
        rigid = torch.cat([turns, eye], -1).flatten(0, 1)
        root = (to.weights.sqrt() / noise).repeat_interleave(3)[:, None]
        q = torch.linalg.qr(root * rigid)[0]
        rows = root * self.jacobian(factors)
        rows = rows - q @ (q.mT @ rows)
        matrix = rows.mT @ rows
        matrix.diagonal().add_(1)
        return matrix, rows.mT @ (root[:, 0] * off.flatten()) - factors

    def jacobian(self, factors: Tensor) -> Tensor:
        """Derivatives of the observed vertices, without loose pieces' rotations. *Shape:* ``(K n,) -> (3m, K n)``."""
        own = self.variation
        bending = own.bending(self.weights(factors))
        # Each side depends on its triangle alone. By columns, forward mode would take five times as long.
        with torch.enable_grad():
            leaf = bending.detach().requires_grad_()
            ends = torch.cat(own.coordinates.sides(leaf[None]))[:, 0]
            slopes = torch.stack([torch.autograd.grad(row.sum(), leaf, retain_graph=True)[0] for row in ends])
        one, other = slopes[..., : len(own.faces)].split(3)  # (3, 6, F) each
        fields = own.coordinates.spread(own.fields)
        moves = own.coordinates.size * torch.eye(3, 6).to(bending)[..., None]
        carries = own.coordinates.carries(self.to.vertices).to(bending)
        rows = []
        for first, second, carried in zip(*(part.split(CHUNK) for part in (*self.influence, carries)), strict=True):
            at_faces = first[:, None, None] * one + second[:, None, None] * other
            at = torch.cat([at_faces, carried[:, None, None] * moves], -1)  # (n, 3, 6, E)
            parts = [(at * deviation).sum(2) @ fields.mT for deviation in own.deviations]
            rows.append(torch.stack(parts, 2).flatten(2))
        return torch.cat(rows).flatten(0, 1)

    def newton(self, factors: Tensor, to: Observations, right: Tensor) -> Tensor:
        """Inverse of half the Hessian, times a vector, by conjugate gradients. *Shape:* ``(K n,)``."""
        matrix = self.linearised(factors, to, self.noise)[0]
        matrix.diagonal().add_(len(matrix) * torch.finfo(matrix.dtype).eps * matrix.diagonal().max())  # its rounding
        factor = torch.linalg.cholesky_ex(matrix).L
        with torch.enable_grad():
            own = factors.detach().requires_grad_()
            slope = torch.autograd.grad(0.5 * self.cost(own, to, self.noise), own, create_graph=True)[0]

        def precondition(x: Tensor) -> Tensor:
            return torch.cholesky_solve(x[:, None], factor)[:, 0]

        def curvature(x: Tensor) -> Tensor:
            return torch.autograd.grad(slope, own, x, retain_graph=True)[0]

        return conjugate_gradients(curvature, precondition, torch.dot, right, PRODUCTS)

    def _influence(self) -> tuple[Tensor, Tensor]:
        """Part of both sides of each triangle in each observed place. *Shape:* ``(n, F)`` each."""
        own, to = self.variation, self.to
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


class _FactorsOfPoints(torch.autograd.Function):
    """Factors of least cost, with their derivatives in the observed points by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, factors: Tensor, points: Tensor, given: Fit, to: Observations) -> Tensor:
        ctx.given, ctx.to = given, to._replace(points=points.detach())
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
        turned = ctx.given.newton(factors, ctx.to, grad)
        with torch.enable_grad():
            own, to_points = factors.detach().requires_grad_(), points.detach().requires_grad_()
            cost = 0.5 * ctx.given.cost(own, ctx.to._replace(points=to_points), ctx.given.noise)
            slope = torch.autograd.grad(cost, own, create_graph=True)[0]
            return None, -torch.autograd.grad(slope, to_points, turned)[0], None, None


def factors_of_points(factors: Tensor, points: Tensor, given: Fit, to: Observations) -> Tensor:
    """Factors of least cost as a function of the observed points. *Shape:* ``(K n,), (m, 3) -> (K n,)``."""
    found: Tensor = _FactorsOfPoints.apply(factors, points, given, to)
    return found


def fit(variation: Variation, to: Observations, about: Tensor, robust: bool = False) -> Fitted:
    """The shape that meets observations, differentiable in their points.

    The weights of least cost are followed by elastic steps of all vertices, in rounds with weights computed anew. The
    steps are constants of the graph: gradients are those of the weights and of the rigid motion. Where a given shape is
    nearer to the points, it is the result.

    Args:
        variation: The given shapes and how they vary.
        to: The observations.
        about: The most likely weights. *Shape:* ``(K,)``.
        robust: Ignore outliers.

    Raises:
        ValueError: The points are in other units than the shapes.
    """
    _check_units(variation, to)
    given = Fit(variation, to._replace(points=to.points.detach()), about)
    factors, trust = given.solved(robust)
    to = to._replace(weights=trust)
    if torch.is_grad_enabled() and to.points.requires_grad:
        factors = factors_of_points(factors, to.points, given, to)
    weights = given.weights(factors)
    assembled = variation.assembled(weights)
    pose = to.pose(assembled)
    with torch.no_grad():
        stiffness = min(LARGEST_STIFFNESS, STIFFNESS / len(to.points))
        pulls = Pulls(to._replace(points=variation.scale * pose.inverse().apply(to.points)), stiffness)
        own = bounded(weights)
        x = variation.relaxed(assembled, own, *FIRST_ROUND, pulls)
        for _ in range(N_ROUNDS):
            own = variation.mixtures.weights(x)
            x = variation.relaxed(x, own, *NEXT_ROUND, pulls)
        step = x - assembled
        moved = [to.pose(shape).apply(shape) for shape in variation.shapes]
        *errors, error = [float((to.weights * to.missed(y).square()).sum()) for y in (*moved, pose.apply(x))]
        k = min(range(len(errors)), key=lambda k: errors[k])
        is_given = error > errors[k] + float(to.weights.sum()) * (SLACK * variation.size) ** 2
    if is_given:
        shape = to.pose(moved[k]).apply(moved[k])
        own = torch.eye(len(moved)).to(x)[k, :, None].expand_as(own)
    else:
        shape = pose.apply(assembled + step)
    return Fitted(shape, own, to.missed(shape), to.weights)


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


def checked_observations(points: Tensor, vertices: Tensor, n_vertices: int) -> Tensor:
    """The vertices on the CPU.

    Raises:
        ValueError: Points or vertices that do not fit.
    """
    if points.dim() < 2 or points.shape[-1] != 3 or points.shape[-2] < 3 or not points.is_floating_point():
        raise ValueError(
            f"points are floating-point of the shape (..., n, 3), with n of 3 or more; got {tuple(points.shape)} of "
            f"{points.dtype}"
        )
    if not bool(points.detach().isfinite().all()):
        raise ValueError("points hold numbers that are not finite; leave out those that were not observed")
    numbers = torch.as_tensor(vertices).cpu()
    if numbers.shape != points.shape[-2:-1] or numbers.is_floating_point() or numbers.dtype == torch.bool:
        raise ValueError(
            f"vertices hold one vertex index for each of {points.shape[-2]} points; got {tuple(numbers.shape)} of "
            f"{numbers.dtype}"
        )
    if len(numbers.unique()) < 3:
        raise ValueError(f"a pose follows from three vertices or more; got {len(numbers.unique())}")
    if not bool(((numbers >= 0) & (numbers < n_vertices)).all()):
        raise ValueError(f"vertices lie in 0 to {n_vertices - 1}; got {int(numbers.min())} to {int(numbers.max())}")
    return numbers.long()


def checked_weights(near: int | Tensor | None, n: int) -> Tensor:
    """Weights of n shapes that add up to one. *Shape:* ``(n,)``, float64.

    Raises:
        ValueError: They do not, or there is no such shape.
    """
    if near is None:
        return torch.full((n,), 1 / n, dtype=torch.float64)
    if isinstance(near, int):
        if not -n <= near < n:
            raise ValueError(f"near is one of {n} key-frames; got {near}")
        return torch.eye(n, dtype=torch.float64)[near]
    weights = torch.as_tensor(near).detach().to("cpu", torch.float64)
    if weights.shape != (n,) or not bool(((weights >= 0).all()) & ((weights.sum() - 1).abs() < 1e-5)):
        raise ValueError(f"near holds {n} weights, none below zero, that add up to one; got {near}")
    return weights
