"""Local weights of a set's shapes, and the rigid motion, that bring them closest to a few observed points."""

import math
from typing import NamedTuple

import torch
from scipy.optimize import least_squares
from torch import Tensor

from torch_modal.elastic.implicit import minimiser_of
from torch_modal.elastic.steps import conjugate_gradients
from torch_modal.geometry.rigid import RigidMotion, best_fit, centroid, infinitesimal_motions
from torch_modal.statistics.variation import Variation

# Standard deviation, in sizes of the shape, of exact points from shapes of local weights, which have one of one: no
# mixture is quite the pose that was seen. Noise of the points adds to it. Larger ones come first, relative to it: far
# from the points there are other minima, which a more certain prior does not have.
NOISE, COARSE_NOISE = 0.01, (10.0, 3.0)

# Levenberg-Marquardt steps for the weights, with coarse noise or changing weights and at last, and the relative change
# of the cost that ends them; rounds of weights of the observations; products with the Hessian for the gradient.
FEW_STEPS, MOST_STEPS, TOLERANCE, ROBUST_ROUNDS, PRODUCTS = 5, 30, 1e-12, 8, 20

# Rows of the Jacobian that are computed together.
ROWS_AT_ONCE = 32


class Observations(NamedTuple):
    """Points with their places on the surface, and weights. *Shape:* ``(n, 3), (n, m), (n, m), (n,)``."""

    points: Tensor
    corners: Tensor
    """The vertices between which each place is."""
    shares: Tensor
    """Barycentric coordinates."""
    weights: Tensor

    @classmethod
    def at_vertices(cls, points: Tensor, vertices: Tensor, weights: Tensor) -> "Observations":
        """Points of vertices. *Shape:* ``(n, 3), (n,), (n,)``."""
        return cls(points, vertices[:, None], torch.ones_like(weights)[:, None], weights)

    def seen(self, x: Tensor) -> Tensor:
        """The places on a shape. *Shape:* ``(V, 3) -> (n, 3)``."""
        return (self.shares[..., None] * x[self.corners]).sum(1)

    def pose(self, x: Tensor) -> RigidMotion:
        """Rigid motion of a shape on to the points. *Shape:* ``(V, 3)``."""
        return best_fit(self.seen(x), self.points, self.weights)

    def distances(self, x: Tensor) -> Tensor:
        """Distances of the points from their places. *Shape:* ``(V, 3) -> (n,)``."""
        return (self.seen(x) - self.points).norm(dim=-1)

    def distances_after_fit(self, x: Tensor) -> Tensor:
        """Distances after the best rigid motion. *Shape:* ``(V, 3) -> (n,)``."""
        return self.distances(self.pose(x).apply(x))


class LocalWeights:
    r"""Local weights and the rigid motion of least cost.

    The cost of factors ``z`` of the weights' fields is their negative logarithmic posterior density,
    :math:`\sum_i |x_i(z) - p_i|^2 / s^2 + |z|^2`. The most likely weights are ``about``, *shape* ``(K,)``.
    """

    def __init__(self, variation: Variation, to: Observations, about: Tensor, noise: float = 0.0) -> None:
        self.variation, self.about, self.noise = variation, about, math.hypot(NOISE * variation.size, noise)
        self.points, self.to = to.points, to._replace(points=to.points.detach())
        self.influence = self._influence()

    def shape(self, factors: Tensor) -> Tensor:
        """*Shape:* ``(K n,) -> (V, 3)``."""
        return self.variation.assemble(self.weights(factors))

    def weights(self, factors: Tensor) -> Tensor:
        """Local weights, which add up to one at each vertex. *Shape:* ``(K n,) -> (K, V)``."""
        rows = factors.view(len(self.about), -1)
        return self.about[:, None] + (rows - rows.mean(0)) @ self.variation.fields

    def solve(self, robust: bool) -> tuple[Tensor, Observations]:
        """Factors of least cost as a function of the points, ``(K n,)``, and the observations with their weights."""
        to, factors = self.to, self.about.new_zeros(len(self.about) * len(self.variation.fields))
        with torch.no_grad():
            for noise in COARSE_NOISE:
                factors = self._descend(factors, to, noise * self.noise, FEW_STEPS)
            for _ in range(ROBUST_ROUNDS if robust else 0):
                # Observations that are missed by more than most have less weight (Geman and McClure).
                missed = self.to.weights.sqrt() * to.distances_after_fit(self.shape(factors))
                usual = (3 * missed.median()).clamp_min(self.noise)
                to = to._replace(weights=self.to.weights / (1 + (missed / usual) ** 2) ** 2)
                factors = self._descend(factors, to, self.noise, FEW_STEPS)
            factors = self._descend(factors, to, self.noise, MOST_STEPS)
        to = to._replace(points=self.points)
        if torch.is_grad_enabled() and self.points.requires_grad:
            factors = minimiser_of(self.points, factors, lambda grad: self._pull_back(factors.detach(), to, grad))
        return factors, to

    @torch.no_grad()
    def _pull_back(self, factors: Tensor, to: Observations, grad: Tensor) -> Tensor:
        """Gradient in the points, from the gradient in the factors. *Shape:* ``(K n,) -> (m, 3)``."""
        leaf, places = (x.detach().requires_grad_() for x in (factors, to.points))
        slopes = self.slopes(leaf.detach(), to._replace(points=places.detach()), self.noise)
        matrix = slopes.mT @ slopes
        matrix.diagonal().add_(len(matrix) * torch.finfo(matrix.dtype).eps * matrix.diagonal().max())  # its rounding
        factor = torch.linalg.cholesky_ex(matrix).L
        with torch.enable_grad():
            cost = 0.5 * self.residuals(leaf, to._replace(points=places), self.noise).square().sum()
            (slope,) = torch.autograd.grad(cost, leaf, create_graph=True)
        adjoint = conjugate_gradients(
            lambda x: torch.autograd.grad(slope, leaf, x, retain_graph=True)[0],
            lambda x: torch.cholesky_solve(x[:, None], factor)[:, 0],
            torch.dot,
            grad,
            PRODUCTS,
        )
        return -torch.autograd.grad(slope, places, adjoint)[0]

    def _descend(self, factors: Tensor, to: Observations, noise: float, n_steps: int) -> Tensor:
        """Take steps of Levenberg and Marquardt. *Shape:* ``(K n,) -> (K n,)``."""
        solution = least_squares(
            lambda z: self.residuals(torch.from_numpy(z), to, noise).numpy(),
            factors.numpy(),
            lambda z: self.slopes(torch.from_numpy(z), to, noise).numpy(),
            method="lm",
            ftol=TOLERANCE,
            max_nfev=n_steps,
        )
        return torch.from_numpy(solution.x)

    def residuals(self, factors: Tensor, to: Observations, noise: float) -> Tensor:
        """Numbers whose squares add up to the cost. *Shape:* ``(K n,) -> (3m + K n,)``."""
        seen = to.seen(self.shape(factors))
        off = seen - best_fit(seen, to.points, to.weights).inverse().apply(to.points)
        return torch.cat([((to.weights.sqrt() / noise)[:, None] * off).flatten(), factors])

    def slopes(self, factors: Tensor, to: Observations, noise: float) -> Tensor:
        """Their derivatives, without the rigid motion. *Shape:* ``(K n,) -> (3m + K n, K n)``."""
        seen = to.seen(self.shape(factors))
        rigid = infinitesimal_motions(seen - centroid(seen, to.weights)).flatten(1).mT
        root = (to.weights.sqrt() / noise).repeat_interleave(3)[:, None]
        q = torch.linalg.qr(root * rigid)[0]
        rows = root * self.jacobian(factors)
        return torch.cat([rows - q @ (q.mT @ rows), torch.eye(len(factors)).to(rows)])

    def jacobian(self, factors: Tensor) -> Tensor:
        """Derivatives of the observed vertices, without loose pieces' rotations. *Shape:* ``(K n,) -> (3m, K n)``."""
        variation = self.variation
        bending = variation.bending(self.weights(factors))
        one, other = variation.coordinates.slopes(bending[None])
        fields = variation.coordinates.spread(variation.fields)
        moves = variation.coordinates.size * torch.eye(3, 6).to(bending)[..., None]
        carries = ((variation.coordinates.centres[:, self.to.corners] * self.to.shares).sum(-1).mT > 0).to(bending)
        rows = []
        for first, second, carried in zip(
            *(column.split(ROWS_AT_ONCE) for column in (*self.influence, carries)), strict=True
        ):
            at_faces = first[:, None, None] * one + second[:, None, None] * other
            at = torch.cat([at_faces, carried[:, None, None] * moves], -1)  # (n, 3, 6, E)
            parts = [(at * deviation).sum(2) @ fields.mT for deviation in variation.deviations]
            rows.append(torch.stack(parts, 2).flatten(2))
        return torch.cat(rows).flatten(0, 1)

    def _influence(self) -> tuple[Tensor, Tensor]:
        """Part of both sides of each triangle in each observed place. *Shape:* ``(n, F)`` each."""
        variation, to = self.variation, self.to
        n, v = len(to.points), len(variation.coordinates.mean)
        parts = to.weights.new_zeros(n, v).scatter_add(1, to.corners, to.shares)
        reconstruction = variation.coordinates.reconstruction
        for piece, anchors in reconstruction.loose:
            # A loose piece goes where the vertices go that it follows.
            parts[:, anchors] += parts[:, piece].sum(1, keepdim=True) / len(anchors)
        first, second = (parts.new_zeros(1, n, len(variation.faces)).requires_grad_() for _ in range(2))
        with torch.enable_grad():
            response = reconstruction.fit((first, second), parts.new_zeros(n, v, 1))
            of_first, of_second = torch.autograd.grad((response[..., 0] * parts).sum(), (first, second))
        return of_first[0], of_second[0]
