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
moments = wp.types.vector(length=5, dtype=real)
"""Rest angles of a hinge: doubled weight, weighted means of ``cos, sin`` of the angles and of twice the angles."""
bent = wp.types.vector(length=10, dtype=real)
"""A hinge: gradients of the angle in the edge and in both tips, and the stiffness."""

TINY = wp.constant(real(1.4916681462400413e-154))  # vectors.tiny of float64
TINIEST = wp.constant(real(2.2250738585072014e-308))
FLAT = wp.constant(real(COLLAPSED))
HALF = wp.constant(real(0.5))
FIRST = wp.constant(real(8 / 3))  # of torch_modal.energy.term.PeriodicTerm
SECOND = wp.constant(real(1 / 6))
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
def doubled(p: wp.vec2d):
    return wp.vec2d(p[0] * p[0] - p[1] * p[1], real(2.0) * p[0] * p[1])


@wp.func
def bend_energy(p: wp.vec2d, w: moments):
    """Twice the energy of a hinge: :class:`torch_modal.energy.term.PeriodicTerm`."""
    q = doubled(p)
    return w[0] * (real(2.5) - FIRST * (w[1] * p[0] + w[2] * p[1]) + SECOND * (w[3] * q[0] + w[4] * q[1]))


@wp.func
def bend_slope(p: wp.vec2d, w: moments):
    """First derivative of the energy in the angle."""
    q = doubled(p)
    return w[0] * (HALF * FIRST * (w[1] * p[1] - w[2] * p[0]) - SECOND * (w[3] * q[1] - w[4] * q[0]))


@wp.func
def bend_curvature(p: wp.vec2d, w: moments):
    """Second derivative."""
    q = doubled(p)
    return w[0] * (HALF * FIRST * (w[1] * p[0] + w[2] * p[1]) - real(2.0) * SECOND * (w[3] * q[0] + w[4] * q[1]))


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
