"""Discrete-shell energy of Eq. 5: edge lengths, dihedral angles and enclosed volume."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.geometry import connectivity
from torch_modal.geometry.vectors import cross, inverse, norm, pick, tiny

# Eq. 5 divides by rest lengths, rest areas and the rest volume. Edges and hinges without a size have no say, needles
# and flat bodies a bounded one; everywhere else the weights are the paper's.
MIN_RELATIVE_LENGTH = 1e-6  # of the mean edge length
MAX_BENDING_RATIO = 1e3  # of l^2 / A; an equilateral hinge has 1.15
MIN_RELATIVE_VOLUME = 1e-6  # of (surface area)^(3/2); a sphere has 0.094

# Altitude of a triangle over its edge below which the triangle has no normal worth the name.
COLLAPSED = 1e-6


class Measures(NamedTuple):
    """What Eq. 5 measures on a shape."""

    length: Tensor
    """Edge lengths. *Shape:* ``(..., E)``."""
    angle: Tensor
    """Signed dihedral angles in radians, 0 where flat. *Shape:* ``(..., H)``."""
    volume: Tensor
    """Signed volume enclosed with the centroid. *Shape:* ``(...,)``."""


class Stiffness(NamedTuple):
    """Factors of the three terms of Eq. 5: numbers, or one for each sample."""

    alpha: float | Tensor
    beta: float | Tensor
    gamma: float | Tensor


class Rest(NamedTuple):
    """A rest shape as Eq. 5 sees it: its measures and the weight of each of them."""

    measures: Measures
    weights: Measures


def per_sample(values: Iterable[float | Tensor], like: Tensor) -> tuple[Tensor, ...]:
    """Numbers or tensors as one value for each sample: each of the shape of ``like``, ``(B,)``."""
    return tuple(torch.as_tensor(value, dtype=like.dtype, device=like.device).expand_as(like) for value in values)


def length_gradient(edge: Tensor) -> Tensor:
    """Gradient of an edge's length, 0 where there is no length. *Shape:* ``(3, ...) -> (3, ...)``."""
    squared = (edge * edge).sum(0)
    return edge * inverse(squared.sqrt(), squared <= tiny(edge))


def dihedral_angle(spokes: Tensor) -> Tensor:
    """Signed angle between the normals of the two triangles of a hinge, 0 where flat, in ``(-pi, pi]``.

    With the edge ``e``, ``n1 = e x a`` and ``n2 = b x e``, the sine is ``(n1 x n2).e/|e| = -|e| n1.b`` and the cosine
    ``n1.n2``, both up to the factor ``|n1||n2|``.

    Args:
        spokes: ``e = x_j - x_i``, ``a = x_k - x_i`` and ``b = x_l - x_i`` of a row of
            :func:`~torch_modal.geometry.connectivity.hinges`, components second. *Shape:* ``(3, 3, ...)``.
    """
    e, a, b = spokes
    n1 = cross(e, a)
    n2 = cross(b, e)
    sine = -norm(e) * (n1 * b).sum(0)
    cosine = (n1 * n2).sum(0)
    # atan2(0, 0) has a NaN gradient; a hinge with a collapsed triangle is flat by convention.
    flat = _collapsed(e, n1) | _collapsed(e, n2)
    return torch.atan2(torch.where(flat, 0, sine), torch.where(flat, 1, cosine))


def dihedral_gradient(spokes: Tensor) -> Tensor:
    """Gradient of :func:`dihedral_angle` in closed form: ``-|e| n / |n|^2`` at either tip, the edge by balance.

    ``torch.func`` gives the same through the angle itself, at ten times the cost (docs/how-it-works.md).

    Args:
        spokes: As above. *Shape:* ``(3, 3, ...)``.

    Returns:
        Zero where a triangle is collapsed. *Shape:* ``(3, 3, ...)``.
    """
    e, a, b = spokes
    n1 = cross(e, a)
    n2 = cross(b, e)
    flat = _collapsed(e, n1) | _collapsed(e, n2)
    length = norm(e)
    to_a = n1 * (-length * inverse((n1 * n1).sum(0), flat))
    to_b = n2 * (-length * inverse((n2 * n2).sum(0), flat))
    to_e = -((a * e).sum(0) * to_a + (b * e).sum(0) * to_b) * inverse((e * e).sum(0), flat)
    return torch.stack([to_e, to_a, to_b])


def length_hessian(edge: Tensor) -> Tensor:
    """Hessian of an edge's length, 0 where there is no length. *Shape:* ``(3, ...) -> (3, 3, ...)``."""
    squared = (edge * edge).sum(0)
    per_length = inverse(squared.sqrt(), squared <= tiny(edge))
    unit = edge * per_length
    eye = torch.eye(3, dtype=edge.dtype, device=edge.device).reshape(3, 3, *[1] * (edge.dim() - 1))
    return (eye - unit[:, None] * unit) * per_length


def dihedral_hessian(spokes: Tensor) -> Tensor:
    r"""Hessian of :func:`dihedral_angle` in closed form, as its blocks between different vertices.

    Each triangle of the hinge has a part of its own, made of the edge ``e``, its unit normal ``n``, its altitude ``h``
    and ``w = n x e``: with :math:`S = (n w^T + w n^T)\, |e| / |n_1|^2` and :math:`U = e n^T / (|e| |n_1|)`, a tip
    whose foot divides the edge at ``r`` has the blocks ``S`` with itself and ``U - r S`` with ``j``. The edge's own,
    between ``e`` and ``e``, is :math:`(r^2 + h^2 / 2 |e|^2) S - r (U + U^T)`. The two tips have none. What is left
    follows because translations change nothing.

    Args:
        spokes: As above. *Shape:* ``(3, 3, ...)``.

    Returns:
        The blocks of the vertices ``ij, ki, kj, li, lj`` (:func:`~torch_modal.geometry.connectivity.hinges`), indexed
        by row, then column; zero where a triangle is collapsed. *Shape:* ``(5, 3, 3, ...)``.
    """
    e, a, b = spokes
    n1, n2 = cross(e, a), cross(b, e)
    flat = _collapsed(e, n1) | _collapsed(e, n2)
    length = norm(e)
    per_length = inverse(length, flat)
    own = e.new_zeros(())
    blocks = []
    for normal, tip, w in ((n1, a, cross(n1, e)), (n2, b, cross(e, n2))):
        area = (normal * normal).sum(0)
        per_area = inverse(area, flat)
        # n and w are not of length one here: their factors are in front.
        half = (normal * (length * per_area * per_area))[:, None] * w
        s = half + half.transpose(0, 1)
        u = e[:, None] * (normal * (per_length * per_area))
        r = (tip * e).sum(0) * per_length * per_length
        across = u - r * s
        own = own + (r * r + 0.5 * area * per_length**4) * s - r * (u + u.transpose(0, 1)) + across
        blocks += [-s - across, across]
    return torch.stack([-own, *blocks])


def _collapsed(edge: Tensor, normal: Tensor) -> Tensor:
    """Whether a triangle on this edge has no altitude. *Shape:* ``(3, ...), (3, ...) -> (...)``."""
    bound = max(COLLAPSED, 100 * torch.finfo(edge.dtype).eps)
    base = (edge * edge).sum(0)
    return (normal * normal).sum(0) <= (bound * base) ** 2 + tiny(edge)


def enclosed_volume(rows: Tensor, faces: Tensor) -> Tensor:
    """Signed volume between a surface and the origin. *Shape:* ``(3, ..., V), (F, 3) -> (...)``."""
    a, b, c = (pick(rows, corner) for corner in faces.unbind(1))
    return (a * cross(b, c)).sum((0, -1)) / 6


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in ``[-pi, pi)``, with derivative one."""
    return angle - 2 * math.pi * torch.floor(angle.detach() / (2 * math.pi) + 0.5)


class ShellEnergy(nn.Module):
    r"""Discrete-shell energy between a shape and a rest shape (Eq. 5 of the paper).

    .. math::
        d(\bar x, x) = \alpha \sum_e \frac{(\bar l_e - l_e)^2}{\bar l_e}
            + \beta \sum_e (\bar\theta_e - \theta_e)^2 \frac{\bar l_e^2}{\bar A_e}
            + \gamma \frac{(\bar v - v)^2}{\bar v^2}

    Angle differences are wrapped. The volume is taken relative to the centroid, so that the energy of an open surface
    does not change with a translation either. The three terms scale differently with size: the defaults are meant
    for shapes with a bounding-box diagonal of about 100.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        alpha: Stretching stiffness.
        beta: Bending stiffness.
        gamma: Volume stiffness.

    The stiffnesses are attributes and may be replaced by tensors, of a gradient or of one value per sample.
    """

    faces: Tensor
    edges: Tensor
    hinges: Tensor
    used: Tensor

    def __init__(
        self,
        faces: Tensor,
        alpha: float | Tensor = 500.0,
        beta: float | Tensor = 10.0,
        gamma: float | Tensor = 1000.0,
    ) -> None:
        super().__init__()
        faces_array = torch.as_tensor(faces).detach().cpu().long().numpy()
        edges, _ = connectivity.unique_edges(faces_array)
        self.register_buffer("faces", torch.from_numpy(faces_array.copy()))
        self.register_buffer("edges", torch.from_numpy(edges))
        self.register_buffer("hinges", torch.from_numpy(connectivity.hinges(faces_array)))
        self.register_buffer("used", torch.from_numpy(edges).unique())
        self.alpha, self.beta, self.gamma = alpha, beta, gamma

    @property
    def stiffness(self) -> Stiffness:
        """The three stiffnesses."""
        return Stiffness(self.alpha, self.beta, self.gamma)

    # Inside, components come first: elementwise operations then run over long contiguous rows.

    def edge_vectors(self, rows: Tensor) -> Tensor:
        """``x_j - x_i`` of all edges. *Shape:* ``(3, ..., V) -> (3, ..., E)``."""
        return pick(rows, self.edges[:, 1]) - pick(rows, self.edges[:, 0])

    def hinge_spokes(self, rows: Tensor) -> Tensor:
        """The three vectors that :func:`dihedral_angle` takes. *Shape:* ``(3, ..., V) -> (3, 3, ..., H)``."""
        origin, *ends = (pick(rows, corner) for corner in self.hinges.unbind(1))
        return torch.stack([end - origin for end in ends])

    def volume(self, rows: Tensor) -> Tensor:
        """Signed volume between the surface and its centroid. *Shape:* ``(3, ..., V) -> (...)``."""
        return enclosed_volume(rows - pick(rows, self.used).mean(-1, keepdim=True), self.faces)

    def volume_gradient(self, rows: Tensor) -> Tensor:
        """Gradient of :meth:`volume`. *Shape:* ``(3, ..., V) -> (3, ..., V)``."""
        rows = rows - pick(rows, self.used).mean(-1, keepdim=True)
        a, b, c = (pick(rows, corner) for corner in self.faces.unbind(1))
        parts = [cross(*pair) for pair in ((b, c), (c, a), (a, b))]
        out = torch.zeros_like(rows).index_add(-1, self.faces.T.flatten(), torch.cat(parts, -1)) / 6
        mean = out.sum(-1, keepdim=True) / len(self.used)  # the centroid moves along; zero on a closed surface
        return out.index_add(-1, self.used, -mean.expand(*mean.shape[:-1], len(self.used)).contiguous())

    def measure(self, x: Tensor) -> Measures:
        """Lengths, angles and volume of a shape.

        Args:
            x: Vertex positions. *Shape:* ``(..., V, 3)``.
        """
        return self.measure_rows(x.movedim(-1, 0).contiguous())

    def measure_rows(self, rows: Tensor) -> Measures:
        """Lengths, angles and volume of a shape, components first. *Shape:* ``(3, ..., V)``."""
        return Measures(norm(self.edge_vectors(rows)), dihedral_angle(self.hinge_spokes(rows)), self.volume(rows))

    def rest(self, x_rest: Tensor, stiffness: Stiffness | None = None) -> Rest:
        """Measures and weights of a rest shape: what stays the same while the shape moves.

        Args:
            x_rest: Vertex positions. *Shape:* ``(..., V, 3)``.
            stiffness: Other stiffnesses than the module's own.
        """
        rows = x_rest.movedim(-1, 0).contiguous()
        spokes = self.hinge_spokes(rows)
        measures = Measures(norm(self.edge_vectors(rows)), dihedral_angle(spokes), self.volume(rows))
        e, a, b = spokes
        n1, n2 = cross(e, a), cross(b, e)
        hinge_area = 0.5 * (norm(n1) + norm(n2))
        squared = (e * e).sum(0)
        shortest = MIN_RELATIVE_LENGTH * measures.length.mean(-1, keepdim=True)
        p, q, r = (pick(rows, corner) for corner in self.faces.unbind(1))
        surface = 0.5 * norm(cross(q - p, r - p)).sum(-1)
        volume_floor = MIN_RELATIVE_VOLUME * surface**1.5
        alpha, beta, gamma = stiffness or self.stiffness
        alpha, beta = (s[..., None] if isinstance(s, Tensor) else s for s in (alpha, beta))
        pointlike = measures.length <= shortest
        nameless = _collapsed(e, n1) | _collapsed(e, n2)
        weights = Measures(
            alpha * inverse(measures.length, pointlike),
            beta * squared * inverse(torch.maximum(hinge_area, squared / MAX_BENDING_RATIO), nameless),
            gamma / torch.maximum(measures.volume.abs(), volume_floor) ** 2,
        )
        return Rest(measures, weights)

    @staticmethod
    def differences(measures: Measures, rest: Rest) -> Measures:
        """Measures minus the rest shape's, angles wrapped."""
        length, angle, volume = rest.measures
        return Measures(measures.length - length, wrap_angle(measures.angle - angle), measures.volume - volume)

    def residuals(self, x: Tensor, x_rest: Tensor) -> Tensor:
        """The terms of Eq. 5 whose squares sum to the energy: E stretching, H bending, one volume.

        Args:
            x: Vertex positions. *Shape:* ``(..., V, 3)``.
            x_rest: Rest positions, broadcast against ``x``. *Shape:* ``(..., V, 3)``.

        Returns:
            *Shape:* ``(..., E + H + 1)``.
        """
        rest = self.rest(x_rest)
        parts = [
            weight.sqrt() * difference
            for weight, difference in zip(rest.weights, self.differences(self.measure(x), rest), strict=True)
        ]
        lead = torch.broadcast_shapes(parts[0].shape[:-1], parts[1].shape[:-1])
        return torch.cat([parts[0].expand(*lead, -1), parts[1].expand(*lead, -1), parts[2].expand(lead)[..., None]], -1)

    def forward(self, x: Tensor, x_rest: Tensor) -> Tensor:
        """Energy of Eq. 5.

        Args:
            x: Vertex positions. *Shape:* ``(..., V, 3)``.
            x_rest: Rest positions, broadcast against ``x``. *Shape:* ``(..., V, 3)``.

        Returns:
            *Shape:* ``(...,)``.
        """
        return self.energy(self.measure(x), self.rest(x_rest))

    def energy(self, measures: Measures, rest: Rest) -> Tensor:
        """Energy of a shape that was measured against a rest shape that was. *Shape:* ``(...,)``."""
        length, angle, volume = self.differences(measures, rest)
        weights = rest.weights
        return (weights.length * length**2).sum(-1) + (weights.angle * angle**2).sum(-1) + weights.volume * volume**2
