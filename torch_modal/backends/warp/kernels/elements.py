"""Types and functions of one edge, hinge or vertex, shared by all kernels."""

import warp as wp

from torch_modal.energy.bend import COLLAPSED

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
symmetric = wp.types.vector(length=6, dtype=real)
"""Entries ``xx, xy, xz, yy, yz, zz`` of a symmetric matrix."""
stretched = wp.types.vector(length=5, dtype=real)
"""An edge: unit vector, stiffness across it, and how much more along it."""
moments = wp.types.vector(length=7, dtype=real)
"""Rest angles of a hinge: doubled weight, ``cos, sin`` of one, and the four moments of the differences from it."""
bent = wp.types.vector(length=10, dtype=real)
"""A hinge: gradients of the angle in the edge and in both tips, and the stiffness."""

TINY = wp.constant(real(1.4916681462400413e-154))  # vectors.tiny of float64
TINIEST = wp.constant(real(2.2250738585072014e-308))
FLAT = wp.constant(real(COLLAPSED))
HALF = wp.constant(real(0.5))
THIRD = wp.constant(real(1 / 3))
LARGEST = wp.constant(0x7FFFFFFF)


@wp.func
def place(start: int, i: int):
    """Index of the i-th element of a row. The mask shows Warp that it is not negative (it would count from the end)."""
    return (start + i) & LARGEST


@wp.func
def length_of(e: vec3):
    return wp.sqrt(wp.max(wp.dot(e, e), TINY))


@wp.func
def is_flat(e: vec3, n: vec3):
    bound = FLAT * wp.dot(e, e)
    return wp.dot(n, n) <= bound * bound + TINY


@wp.func
def squared(g: vec3):
    return symmetric(g[0] * g[0], g[0] * g[1], g[0] * g[2], g[1] * g[1], g[1] * g[2], g[2] * g[2])


@wp.func
def applied(m: symmetric, g: vec3):
    return vec3(
        m[0] * g[0] + m[1] * g[1] + m[2] * g[2],
        m[1] * g[0] + m[3] * g[1] + m[4] * g[2],
        m[2] * g[0] + m[4] * g[1] + m[5] * g[2],
    )


@wp.func
def phase_of(e: vec3, b: vec3, n1: vec3, n2: vec3):
    """Cosine and sine of the dihedral angle."""
    scale = real(1.0) / wp.sqrt(wp.dot(n1, n1) * wp.dot(n2, n2))
    return wp.vec2d(scale * wp.dot(n1, n2), -scale * length_of(e) * wp.dot(n1, b))


@wp.func
def turn_between(p: wp.vec2d, q: wp.vec2d):
    """``1 - cos`` and ``sin`` of the angle from the one phase to the other."""
    d = q - p
    return wp.vec2d(HALF * wp.dot(d, d), p[0] * q[1] - p[1] * q[0])


@wp.func
def doubled(d: wp.vec2d):
    """The same of twice the angle."""
    return wp.vec2d(real(2.0) * d[1] * d[1], real(2.0) * d[1] * (real(1.0) - d[0]))


@wp.func
def bend_energy(p: wp.vec2d, w: moments):
    """Twice the energy of a hinge: :class:`torch_modal.energy.term.PeriodicTerm`."""
    d = turn_between(wp.vec2d(w[1], w[2]), p)
    e = doubled(d)
    first = w[3] * (real(1.0) - d[0]) - w[4] * d[1]
    second = w[5] * (real(1.0) - e[0]) - w[6] * e[1]
    return w[0] * (d[0] * (real(2.0) + d[0] * THIRD) + real(8.0) * THIRD * first - HALF * THIRD * second)


@wp.func
def bend_slope(p: wp.vec2d, w: moments):
    """First derivative of the energy in the angle."""
    d = turn_between(wp.vec2d(w[1], w[2]), p)
    e = doubled(d)
    first = w[3] * d[1] + w[4] * (real(1.0) - d[0])
    second = w[5] * e[1] + w[6] * (real(1.0) - e[0])
    return w[0] * (d[1] * (real(1.0) + THIRD * d[0]) - real(4.0) * THIRD * first + HALF * THIRD * second)


@wp.func
def bend_beyond(p: wp.vec2d, w: moments):
    """Second derivative beyond that of the square."""
    d = turn_between(wp.vec2d(w[1], w[2]), p)
    e = doubled(d)
    first = w[3] * (real(1.0) - d[0]) - w[4] * d[1]
    second = w[5] * (real(1.0) - e[0]) - w[6] * e[1]
    return w[0] * THIRD * (second - real(2.0) * d[0] * d[0] - real(4.0) * first)


@wp.func
def corner(x: wp.array(dtype=vec3), centre: vec3, at: int, v: int):
    found = centre
    if v >= 0:
        found = x[place(at, v)]
    return found


@wp.func
def middle_of(
    x: wp.array(dtype=vec3), centre: wp.array(dtype=vec3), capped_faces: wp.array(dtype=wp.vec3i), sample: int, at: int
):
    """The origin of volumes: the centre; any vertex where the surface is closed."""
    found = x[place(at, capped_faces[0][0])]
    if centre:
        found = centre[sample]
    return found
