"""Dihedral angles, the second term of Eq. 5."""

from functools import cache, reduce
from typing import no_type_check

import torch
from torch import Tensor

from torch_modal.elastic.term import KernelFunctions, Mesh, PeriodicTerm, Term, periodic, wrap_angle
from torch_modal.geometry.vectors import cross, inverse, norm, tiny

# Eq. 5 divides by rest areas: l^2 / A has this bound, for needles; an equilateral hinge has 1.15.
MAX_BENDING_RATIO = 1e3

# Altitude of a triangle over its edge below which its normal is rounding.
COLLAPSED = 1e-6

# Altitude of a triangle over its longest side at which fullness() is a half, in the modal solve and for the steps of
# all vertices; an equilateral one has 0.87.
NEEDLE, NEEDLE_OF_STEPS = 0.2, 0.3

# Fullness at rest below which a hinge is softened even if it has as much where steps start.
LEAST_FULLNESS = 1e-3


class SquaredBend(Term):
    r"""Dihedral angles: :math:`\beta \sum_h (\theta_h - \bar\theta_h)^2 \bar l_h^2 / \bar A_h`, the second of Eq. 5.

    Differences are wrapped: the energy has a kink where an angle differs by half a turn.
    """

    def elements(self, mesh: Mesh) -> Tensor:
        """All hinges."""
        return mesh.hinges

    def measure(self, edge_vectors: Tensor, hinges: tuple[Tensor, ...] | None = None) -> Tensor:
        """Signed angle between the normals of the two triangles of a hinge, 0 where flat, in ``(-pi, pi]``.

        With the edge ``e``, ``n1 = e x a`` and ``n2 = b x e``, the sine is ``(n1 x n2).e/|e| = -|e| n1.b`` and the
        cosine ``n1.n2``, both up to the factor ``|n1||n2|``.

        Args:
            edge_vectors: ``e = x_j - x_i``, ``a = x_k - x_i`` and ``b = x_l - x_i`` of a row of
                :attr:`~torch_modal.geometry.connectivity.Connectivity.hinges`, components second. *Shape:* ``(3, 3,
                ...)``.
            hinges: Their :func:`normals`, if known.
        """
        n1, n2, flat, length = normals(edge_vectors) if hinges is None else hinges
        sine = -length * (n1 * edge_vectors[2]).sum(0)
        cosine = (n1 * n2).sum(0)
        # atan2(0, 0) has a NaN gradient; a hinge with a collapsed triangle is flat by convention.
        return torch.atan2(torch.where(flat, 0, sine), torch.where(flat, 1, cosine))

    measures = measure

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """Square of the edge over the area of both triangles."""
        n1, n2, flat, _ = normals(edge_vectors)
        squared, area = (edge_vectors[0] * edge_vectors[0]).sum(0), 0.5 * (norm(n1) + norm(n2))
        floored = torch.maximum(area, squared / MAX_BENDING_RATIO)
        return squared * inverse(floored, flat)

    def difference(self, measures: Tensor, rest: Tensor) -> Tensor:
        """The short way round."""
        return wrap_angle(measures - rest)

    def linearise(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Angles, and their gradients in closed form: ``-|e| n / |n|^2`` at either tip, the edge by balance.

        They are zero where a triangle is collapsed. By ``torch.func``, an in-between in torch takes 1.2 to 1.4 times as
        long.
        """
        e, a, b = edge_vectors
        n1, n2, flat, length = hinges = normals(edge_vectors)
        to_a = n1 * (-length * inverse((n1 * n1).sum(0), flat))
        to_b = n2 * (-length * inverse((n2 * n2).sum(0), flat))
        to_e = -((a * e).sum(0) * to_a + (b * e).sum(0) * to_b) * inverse((e * e).sum(0), flat)
        return self.measure(edge_vectors, hinges), torch.stack([to_e, to_a, to_b])


class Bend(PeriodicTerm, SquaredBend):
    r"""Dihedral angles: :math:`\beta \sum_h f(\theta_h - \bar\theta_h) \bar l_h^2 / \bar A_h`, smooth at half a turn.

    :class:`~torch_modal.elastic.term.PeriodicTerm` has the function ``f``, which is the square of Eq. 5 below a radian.
    """

    def softening(self, start: Tensor, rest: Tensor, weights: Tensor | None) -> Tensor:
        """Less stiffness at needles: their gradient has no bound, and minimisers would turn their normals over.

        The factor is :func:`fullness`, or its ratio to the fullness of the rest shapes.
        """
        if weights is None:
            return fullness(start, NEEDLE)
        usual = (weights[..., None] * fullness(rest, NEEDLE_OF_STEPS)).sum(1).clamp_min(LEAST_FULLNESS)
        ratio = (fullness(start, NEEDLE_OF_STEPS) / usual).clamp_max(1)
        return ratio * ratio * (3 - 2 * ratio)

    def kernel_functions(self, n: int) -> KernelFunctions | None:
        """Functions of hinges; of a class that inherits from this one, its own."""
        return kernel_functions() if type(self) is Bend else super().kernel_functions(n)


def normals(edge_vectors: Tensor) -> tuple[Tensor, ...]:
    """Normals of both triangles of a hinge, where one has none, and the edge's length. *Shape:* ``(3, 3, ...)``."""
    e, a, b = edge_vectors
    n1, n2 = cross(e, a), cross(b, e)
    return n1, n2, is_collapsed(e, n1) | is_collapsed(e, n2), norm(e)


def fullness(edge_vectors: Tensor, needle: float) -> Tensor:
    """0 to 1 by how far both triangles of a hinge are from needles. *Shape:* ``(3, 3, ..., H) -> (..., H)``."""
    e, both = edge_vectors[0].unsqueeze(1), edge_vectors[1:].transpose(0, 1)  # (3, 1, ..., H), (3, 2, ..., H)
    normal = cross(e.expand_as(both), both)
    longest = reduce(torch.maximum, [(x * x).sum(0) for x in (e, both, both - e)])
    squared = (normal * normal).sum(0)
    return (squared * inverse(squared + (needle * longest).square(), longest <= 0)).prod(0)


def is_collapsed(edge: Tensor, normal: Tensor) -> Tensor:
    """True for triangles without an altitude on this edge. *Shape:* ``(3, ...), (3, ...) -> (...)``."""
    bound = max(COLLAPSED, 100 * torch.finfo(edge.dtype).eps)
    base = (edge * edge).sum(0)
    return (normal * normal).sum(0) <= (bound * base) ** 2 + tiny(edge)


@cache
@no_type_check
def kernel_functions() -> KernelFunctions:
    """Hinges as above, by cosine and sine of the angle, for kernels."""
    import warp as wp

    real, vec2, vec3, mat33 = wp.float64, wp.vec2d, wp.vec3d, wp.mat33d
    flatness, ratio = wp.constant(real(COLLAPSED)), wp.constant(real(MAX_BENDING_RATIO))
    tiny_square, tiniest = wp.constant(real(tiny(torch.empty(0, dtype=torch.float64)))), wp.constant(real(2.0**-1022))

    @wp.struct
    class Hinge:
        n1: vec3
        n2: vec3
        length: real
        per_both: real
        """One over the lengths of both normals."""
        per1: real
        """One over the square of a normal."""
        per2: real
        flat: bool

    @wp.func
    def hinge_of(x: mat33):
        h = Hinge()
        e = x[0]
        h.n1 = wp.cross(e, x[1])
        h.n2 = wp.cross(x[2], e)
        base = wp.dot(e, e)
        square1 = wp.dot(h.n1, h.n1)
        square2 = wp.dot(h.n2, h.n2)
        h.length = wp.sqrt(wp.max(base, tiny_square))
        h.per_both = real(1.0) / wp.sqrt(wp.max(square1 * square2, tiniest))
        h.per1 = h.per_both * h.per_both * square2
        h.per2 = h.per_both * h.per_both * square1
        bound = flatness * base
        h.flat = wp.min(square1, square2) <= bound * bound + tiny_square
        return h

    @wp.func
    def phase(h: Hinge, x: mat33):
        return h.per_both * vec2(wp.dot(h.n1, h.n2), -h.length * wp.dot(h.n1, x[2]))

    @wp.func
    def measure(x: mat33):
        h = hinge_of(x)
        result = vec2(real(1.0), real(0.0))
        if not h.flat:
            result = phase(h, x)
        return result

    @wp.func
    def linearise(x: mat33):
        h = hinge_of(x)
        result = vec2(real(1.0), real(0.0))
        gradient = mat33()
        if not h.flat:
            result = phase(h, x)
            e = x[0]
            to_a = (-h.length * h.per1) * h.n1
            to_b = (-h.length * h.per2) * h.n2
            per = real(1.0) / h.length
            to_e = (-per * per) * (wp.dot(x[1], e) * to_a + wp.dot(x[2], e) * to_b)
            gradient = wp.matrix_from_rows(to_e, to_a, to_b)
        return result, gradient

    @wp.func
    def hessian_product(x: mat33, d: mat33):
        """By hand: ``wp.grad`` of the gradient takes twice the time, a tenth of a backward pass."""
        h = hinge_of(x)
        result = mat33()
        if not h.flat:
            two = real(2.0)
            e = x[0]
            per = real(1.0) / (h.length * h.length)
            part_a = per * wp.dot(x[1], e)
            part_b = per * wp.dot(x[2], e)
            to_part_a = per * h.length * h.per1 * wp.dot(d[0], h.n1)
            to_part_b = per * h.length * h.per2 * wp.dot(d[0], h.n2)
            to_a = d[1] - part_a * d[0]
            to_b = d[2] - part_b * d[0]
            along_a = h.per1 * wp.dot(h.n1, to_a)
            along_b = h.per2 * wp.dot(h.n2, to_b)
            to_n1 = (-h.length * h.per1) * (to_a - (two * along_a) * h.n1)
            to_n2 = (-h.length * h.per2) * (to_b - (two * along_b) * h.n2)
            to_e = wp.cross(x[1], to_n1) + wp.cross(to_n2, x[2]) - ((along_a + along_b) / h.length) * e
            to_e += to_part_a * (x[1] - (two * part_a) * e) + to_part_b * (x[2] - (two * part_b) * e)
            result = wp.matrix_from_rows(to_e, wp.cross(to_n1, e) + to_part_a * e, wp.cross(e, to_n2) + to_part_b * e)
        return result

    @wp.func_grad(measure)
    def measure_adjoint(x: mat33, to_phase: vec2):
        q, g = linearise(x)
        wp.adjoint[x] += (q[0] * to_phase[1] - q[1] * to_phase[0]) * g

    @wp.func_grad(linearise)
    def linearise_adjoint(x: mat33, to_phase: vec2, to_gradient: mat33):
        q, g = linearise(x)
        along = q[0] * to_phase[1] - q[1] * to_phase[0]
        wp.adjoint[x] += hessian_product(x, to_gradient) + along * g

    @wp.func
    def weight(x: mat33, q: vec2, mean: real):
        e = x[0]  # without hinge_of(), whose adjoint would be computed, too
        n1 = wp.cross(e, x[1])
        n2 = wp.cross(x[2], e)
        base = wp.dot(e, e)
        square1 = wp.dot(n1, n1)
        square2 = wp.dot(n2, n2)
        bound = flatness * base
        result = real(0.0)
        if wp.min(square1, square2) > bound * bound + tiny_square:
            result = wp.min(real(2.0) * base / (wp.sqrt(square1) + wp.sqrt(square2)), ratio)
        return result

    @wp.func
    def fullness_of(e: vec3, tip: vec3, altitude: real):
        longest = wp.max(wp.dot(e, e), wp.max(wp.dot(tip, tip), wp.dot(tip - e, tip - e)))
        normal = wp.cross(e, tip)
        square = wp.dot(normal, normal)
        whole = square + altitude * longest * longest
        result = real(0.0)
        if whole > real(0.0):
            result = square / whole
        return result

    @wp.func_grad(fullness_of)
    def fullness_adjoint(e: vec3, tip: vec3, altitude: real, received: real):
        """By hand: few hinges are softened, and nothing is computed of the others."""
        side = tip - e
        longest = wp.max(wp.dot(e, e), wp.max(wp.dot(tip, tip), wp.dot(side, side)))
        normal = wp.cross(e, tip)
        square = wp.dot(normal, normal)
        whole = square + altitude * longest * longest
        if received != real(0.0) and whole > real(0.0):
            factor = real(2.0) * received * altitude * longest / (whole * whole)
            to_normal = (factor * longest) * normal
            to_longest = -real(2.0) * factor * square
            to_e = wp.cross(tip, to_normal)
            to_tip = wp.cross(to_normal, e)
            if wp.dot(e, e) >= longest:
                to_e += to_longest * e
            elif wp.dot(tip, tip) >= longest:
                to_tip += to_longest * tip
            else:
                to_tip += to_longest * side
                to_e -= to_longest * side
            wp.adjoint[e] += to_e
            wp.adjoint[tip] += to_tip

    @wp.func
    def fullness(x: mat33, altitude: real):
        return fullness_of(x[0], x[1], altitude) * fullness_of(x[0], x[2], altitude)

    values = measure, linearise
    return KernelFunctions("bend", 3, periodic(), *values, weight=weight, fullness=fullness)
