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
bent = wp.types.vector(length=10, dtype=real)
"""A hinge: gradients of the angle in the edge and in both tips, and the stiffness."""

TINY = wp.constant(real(1.4916681462400413e-154))  # vectors.tiny of float64
TINIEST = wp.constant(real(2.2250738585072014e-308))
FLAT = wp.constant(real(COLLAPSED))
TURN = wp.constant(real(6.283185307179586))
HALF = wp.constant(real(0.5))
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
def wrapped(angle: real):
    return angle - TURN * wp.floor(angle / TURN + HALF)


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
def angle_of(e: vec3, a: vec3, b: vec3, n1: vec3, n2: vec3):
    return wp.atan2(-length_of(e) * wp.dot(n1, b), wp.dot(n1, n2))


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
