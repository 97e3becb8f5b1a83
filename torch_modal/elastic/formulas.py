r"""The formulas of Eq. 5, each once: torch evaluates them as they stand, and kernels are made from the same text.

Elements are given by the vectors ``x`` from their first vertex to the others; a hinge has its edge first, then tips.
:mod:`torch_modal.elastic.bind` has the names.
"""

from __future__ import annotations

from torch_modal.elastic.bind import (
    Five,
    Flag,
    Measure,
    Number,
    Pair,
    Scalar,
    Six,
    Triple,
    Vector,
    Vectors,
    above_rounding,
    absolute,
    atan2,
    cos,
    cross,
    dot,
    five,
    inverse,
    maximum,
    minimum,
    pair,
    real,
    root,
    rows,
    sin,
    six,
    sqrt,
    triple,
    underflows,
    vanishes,
    where,
)

MIN_RELATIVE_LENGTH = 1e-6
"""Eq. 5 divides by rest lengths: edges without one, as a part of the mean, have no weight."""
STRAIN_OF_TENSION = 1e-3
"""Strain over which the tension of an edge sets in."""
MAX_BENDING_RATIO = 1e3
"""Eq. 5 divides by rest areas: l^2 / A has this bound, for needles; an equilateral hinge has 1.15."""
COLLAPSED = 1e-6
"""Altitude of a triangle over its edge below which its normal is rounding."""
LEAST_FULLNESS = 1e-3
"""Fullness at rest below which a hinge is softened even if it has as much where steps start."""
MIN_RELATIVE_VOLUME = 1e-6
"""Eq. 5 divides by the rest volume: its bound for flat bodies, as a part of (surface area)^(3/2); a sphere: 0.094."""
LARGEST_STRAIN = 4.0
"""Strain of an edge from which on its distortion is linear: of edges that have no length at rest it means nothing."""
LARGEST_WEIGHT = 8.0
"""Bound on the weight l^2 / A of a hinge with a needle in a distortion; an equilateral hinge has 1.15."""
RIDGE = 1e-6
"""Added to blocks of a Hessian, relative to their trace: a vertex in a flat fan has no stiffness along its normal."""
ZERO, ONE, TWO, HALF, THIRD, SIXTH = 0.0, 1.0, 2.0, 1 / 2, 1 / 3, 1 / 6


def unit_weight(x: Vectors, measure: Measure, mean: Scalar) -> Scalar:
    """One, for terms without weights, whose measure is a number or an angle."""
    return real(1.0)


# ------------------------------------------------------------------------------------------------------------ edges
def length(e: Vector) -> Scalar:
    """``|e|``."""
    return root(dot(e, e))


def edge_length(x: Vectors) -> Scalar:
    """Length of an edge."""
    return length(x[0])


def linearised_length(x: Vectors) -> tuple[Scalar, Vectors]:
    """:func:`edge_length` and its gradient ``e / |e|``, 0 where there is no length."""
    measure = length(x[0])
    return measure, rows(inverse(measure, vanishes(dot(x[0], x[0]))) * x[0])


def length_weight(x: Vectors, measure: Scalar, mean: Scalar) -> Scalar:
    """One over the rest length."""
    return inverse(measure, measure <= MIN_RELATIVE_LENGTH * mean)


def tension(measure: Scalar, slope: Scalar, curvature: Scalar) -> Scalar:
    """Transverse stiffness of a stretched string, slope over length; smoothly near zero under compression."""
    width = STRAIN_OF_TENSION * curvature * measure
    return HALF * (slope + root(slope * slope + width * width)) / measure


def bounded_stretch(measure: Scalar, rest: Scalar) -> Scalar:
    """``(l - l_rest)^2 / l_rest``, linear from :data:`LARGEST_STRAIN` on."""
    off = absolute(measure - rest)
    return off * minimum(off / rest, LARGEST_STRAIN)


# ----------------------------------------------------------------------------------------------------------- hinges
def is_flat(e: Vector, n1: Vector, n2: Vector) -> Flag:
    """True for hinges of which a triangle has no altitude on the edge, so that the angle is 0 by convention."""
    base = dot(e, e)
    bound = above_rounding(COLLAPSED, base) * base
    return vanishes(minimum(dot(n1, n1), dot(n2, n2)) - bound * bound)


def hinge_phase(x: Vectors) -> Pair:
    """Cosine and sine of the signed dihedral angle: ``n1.n2`` and ``-|e| n1.b``, over the lengths of both normals."""
    e = x[0]
    n1 = cross(e, x[1])
    n2 = cross(x[2], e)
    flat = is_flat(e, n1, n2)
    per = inverse(sqrt(where(flat, ONE, dot(n1, n1) * dot(n2, n2))), flat)
    return pair(where(flat, ONE, per * dot(n1, n2)), -length(e) * per * dot(n1, x[2]))


def linearised_phase(x: Vectors) -> tuple[Pair, Vectors]:
    """:func:`hinge_phase`, and the gradient of the angle: ``-|e| n / |n|^2`` at either tip, the edge by balance."""
    e = x[0]
    n1 = cross(e, x[1])
    n2 = cross(x[2], e)
    flat = is_flat(e, n1, n2)
    squared1 = dot(n1, n1)
    squared2 = dot(n2, n2)
    size = length(e)
    per = inverse(sqrt(where(flat, ONE, squared1 * squared2)), flat)
    to_a = (-size * per * per * squared2) * n1
    to_b = (-size * per * per * squared1) * n2
    per_size = inverse(size, flat)
    to_e = (-per_size * per_size) * (dot(x[1], e) * to_a + dot(x[2], e) * to_b)
    return pair(where(flat, ONE, per * dot(n1, n2)), -size * per * dot(n1, x[2])), rows(to_e, to_a, to_b)


def hinge_angle(x: Vectors) -> Scalar:
    """Signed dihedral angle, in ``(-pi, pi]``."""
    q = hinge_phase(x)
    return atan2(q[1], q[0])


def angle_hessian_product(x: Vectors, d: Vectors) -> Vectors:
    """Hessian of the dihedral angle times a displacement of the edge vectors."""
    e = x[0]
    a = x[1]
    b = x[2]
    n1 = cross(e, a)
    n2 = cross(b, e)
    flat = is_flat(e, n1, n2)
    squared1 = dot(n1, n1)
    squared2 = dot(n2, n2)
    size = length(e)
    per = inverse(size * size, flat)
    per_both = inverse(sqrt(where(flat, ONE, squared1 * squared2)), flat)
    per1 = per_both * per_both * squared2
    per2 = per_both * per_both * squared1
    part_a = per * dot(a, e)
    part_b = per * dot(b, e)
    to_part_a = per * size * per1 * dot(d[0], n1)
    to_part_b = per * size * per2 * dot(d[0], n2)
    to_a = d[1] - part_a * d[0]
    to_b = d[2] - part_b * d[0]
    along_a = per1 * dot(n1, to_a)
    along_b = per2 * dot(n2, to_b)
    to_n1 = (-size * per1) * (to_a - (TWO * along_a) * n1)
    to_n2 = (-size * per2) * (to_b - (TWO * along_b) * n2)
    of_length = cross(a, to_n1) + cross(to_n2, b) - ((along_a + along_b) * size * per) * e
    of_parts = to_part_a * (a - (TWO * part_a) * e) + to_part_b * (b - (TWO * part_b) * e)
    return rows(of_length + of_parts, cross(to_n1, e) + to_part_a * e, cross(e, to_n2) + to_part_b * e)


def hinge_weight(x: Vectors, measure: Measure, mean: Scalar) -> Scalar:
    """Square of the edge over the area of both triangles, at rest."""
    e = x[0]
    n1 = cross(e, x[1])
    n2 = cross(x[2], e)
    squared = dot(e, e)
    area = maximum(HALF * (length(n1) + length(n2)), squared / MAX_BENDING_RATIO)
    return squared * inverse(area, is_flat(e, n1, n2))


def bounded_hinge_weight(x: Vectors) -> Scalar:
    """:func:`hinge_weight`, at most :data:`LARGEST_WEIGHT`."""
    return minimum(hinge_weight(x, real(1.0), real(1.0)), LARGEST_WEIGHT)


def longest_side(e: Vector, tip: Vector) -> Scalar:
    """Square of the longest side of a triangle."""
    side = tip - e
    return maximum(dot(e, e), maximum(dot(tip, tip), dot(side, side)))


def triangle_fullness(e: Vector, tip: Vector, altitude: Number) -> Scalar:
    """0 to 1 by how far a triangle is from a needle; a half at this squared altitude over the longest side."""
    longest = longest_side(e, tip)
    normal = cross(e, tip)
    squared = dot(normal, normal)
    return squared * inverse(squared + altitude * longest * longest, longest <= ZERO)


def hinge_fullness(x: Vectors, altitude: Number) -> Scalar:
    """:func:`triangle_fullness` of both triangles, multiplied."""
    return triangle_fullness(x[0], x[1], altitude) * triangle_fullness(x[0], x[2], altitude)


def softness(at_start: Scalar, usual: Scalar) -> Scalar:
    """Part of its stiffness that a hinge keeps, from fullness where steps start and the mean of the rest shapes."""
    ratio = minimum(at_start / maximum(usual, LEAST_FULLNESS), ONE)
    return ratio * ratio * (real(3.0) - TWO * ratio)


# ---------------------------------------------------------------------------------------------------------- volumes
def tetrahedron(x: Vectors) -> Scalar:
    """Signed volume."""
    return SIXTH * dot(x[0], cross(x[1], x[2]))


def linearised_tetrahedron(x: Vectors) -> tuple[Scalar, Vectors]:
    """:func:`tetrahedron` and its gradient, sixths of cross products."""
    to_p = SIXTH * cross(x[1], x[2])
    return dot(x[0], to_p), rows(to_p, SIXTH * cross(x[2], x[0]), SIXTH * cross(x[0], x[1]))


def triangle_area(p: Vector, q: Vector) -> Scalar:
    """Half of the cross product's length."""
    return HALF * length(cross(p, q))


def volume_weight(volume: Scalar, area: Scalar) -> Scalar:
    """One over the square of the rest volume, of a surface of this area."""
    size = maximum(absolute(volume), MIN_RELATIVE_VOLUME * area * sqrt(area))
    return ONE / (size * size)


def sum_of_total(x: Vectors) -> Scalar:
    """A total as one element for kernels: its vector consists of the sum of the measures and, of a volume, an area."""
    return x[0][0]


def linearised_sum_of_total(x: Vectors) -> tuple[Scalar, Vectors]:
    """:func:`sum_of_total` and its gradient, for kernels alone."""
    return x[0][0], rows(triple(real(1.0), real(0.0), real(0.0)))  # type: ignore[arg-type]  # a vector there


def weight_of_volume(x: Vectors, volume: Scalar, mean: Scalar) -> Scalar:
    """:func:`volume_weight` of such an element."""
    return volume_weight(volume, x[0][1])


# ---------------------------------------------------------------------------- the square, of the sums over rest shapes
def square_moments(q: Scalar, w: Scalar) -> Triple:
    """Summands of the sums over rest shapes."""
    return triple(w, w * q, w * q * q)


def square_record(m: Triple, factor: Number) -> Pair:
    """Weight and value of the parabola that sums of parabolas are; without a weight there is no minimum."""
    return pair(factor * maximum(m[0], ZERO), m[1] * inverse(m[0], m[0] <= ZERO))


def square_left(m: Triple, factor: Number, to: Pair) -> Scalar:
    """Energy that remains at the minimum."""
    return factor * where(m[0] > ZERO, m[2] - m[1] * to[1], ZERO)


def square_energy(q: Scalar, to: Pair) -> Scalar:
    """``w (q - v)^2``."""
    return to[0] * (q - to[1]) * (q - to[1])


def square_slope(q: Scalar, to: Pair) -> Scalar:
    """Derivative of :func:`square_energy`."""
    return TWO * to[0] * (q - to[1])


# ----------------------------------------------------------------------------------------------------------- angles
def phase(angle: Scalar) -> Pair:
    """Cosine and sine."""
    return pair(cos(angle), sin(angle))


# --------------------------------------------------------------- the periodic function (term.PeriodicTerm), of a phase
def periodic_moments(q: Pair, w: Scalar) -> Five:
    """Weight, and the first two trigonometric moments."""
    return five(w, w * q[0], w * q[1], w * (q[0] * q[0] - q[1] * q[1]), TWO * w * q[0] * q[1])


def periodic_record(m: Five, factor: Number) -> Six:
    """Weight; cosine and sine of the mean; sums of the phases along it, of twice the angles along and across."""
    some = m[0] > ZERO
    x = where(some, m[1], ZERO)
    y = where(some, m[2], ZERO)
    squared = x * x + y * y
    none = underflows(squared)
    per = inverse(sqrt(where(none, ONE, squared)), none)
    c = where(none, ONE, per * x)
    s = where(none, ZERO, per * y)
    c2 = c * c - s * s
    s2 = TWO * c * s
    x2 = where(some, m[3], ZERO)
    y2 = where(some, m[4], ZERO)
    once = factor * (c * x + s * y)
    along = factor * (c2 * x2 + s2 * y2)
    across = factor * (c2 * y2 - s2 * x2)
    return six(factor * where(some, m[0], ZERO), c, s, once, along, across)


def periodic_left(m: Five, factor: Number, to: Six) -> Scalar:
    """Energy that remains at the mean."""
    return real(2.5) * to[0] - THIRD * (real(8.0) * to[3] - HALF * to[4])


# Written out three times: the adjoint of a kernel's function that calls another computes that one once more.
def periodic_energy(q: Pair, to: Six) -> Scalar:
    """``8/3 once (1 - cos) - 1/6 along (1 - cos 2) + 1/6 across sin 2``, of the angle relative to the mean."""
    x = q[0] - to[1]
    y = q[1] - to[2]
    v = HALF * (x * x + y * y)
    s = to[1] * q[1] - to[2] * q[0]
    return THIRD * (real(8.0) * to[3] * v - s * (to[4] * s - to[5] * (ONE - v)))


def periodic_slope(q: Pair, to: Six) -> Scalar:
    """Derivative of :func:`periodic_energy` in the angle."""
    x = q[0] - to[1]
    y = q[1] - to[2]
    cosine = ONE - HALF * (x * x + y * y)
    s = to[1] * q[1] - to[2] * q[0]
    return THIRD * (real(8.0) * to[3] * s - TWO * s * (to[4] * cosine + to[5] * s) + to[5])


def periodic_curvature(q: Pair, to: Six) -> Scalar:
    """Second derivative of :func:`periodic_energy`."""
    x = q[0] - to[1]
    y = q[1] - to[2]
    cosine = ONE - HALF * (x * x + y * y)
    s = to[1] * q[1] - to[2] * q[0]
    return THIRD * (real(8.0) * to[3] * cosine - TWO * (to[4] * (ONE - TWO * s * s) + TWO * to[5] * s * cosine))


def periodic_square(difference: Scalar) -> Scalar:
    """The function of :class:`~torch_modal.elastic.term.PeriodicTerm`, of an angle's difference from one rest angle."""
    half = sin(HALF * difference)
    versine = TWO * half * half
    return versine * (TWO + THIRD * versine)


# ------------------------------------------------------------------------------------------------ linear systems
def quotient(a: Scalar, b: Scalar) -> Scalar:
    """``a / b``, and 0 where ``b`` is not positive: a system that is solved exactly has no residual."""
    positive = b > ZERO
    return where(positive, a / where(positive, b, ONE), ZERO)


def symmetric_inverse(m: Six) -> Six:
    """Inverse by cofactors, with :data:`RIDGE`; of a vertex that no face uses, which has no stiffness, of the ridge."""
    whole = m[0] + m[3] + m[5]
    trace = where(whole > ZERO, whole, ONE)
    a = m[0] / trace + RIDGE
    d = m[3] / trace + RIDGE
    f = m[5] / trace + RIDGE
    b = m[1] / trace
    c = m[2] / trace
    e = m[4] / trace
    aa = d * f - e * e
    bb = c * e - b * f
    cc = b * e - c * d
    per = ONE / ((a * aa + b * bb + c * cc) * trace)
    return six(per * aa, per * bb, per * cc, per * (a * f - c * c), per * (b * c - a * e), per * (a * d - b * b))
