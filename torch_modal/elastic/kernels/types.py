"""Types of kernels, and functions of vectors."""

import warp as wp

real = wp.float64
vec2 = wp.vec2d
vec3 = wp.vec3d
vec4 = wp.vec4d
vec5, vec6 = (wp.types.vector(length=n, dtype=real) for n in (5, 6))
symmetric = wp.types.vector(length=6, dtype=real)
"""Entries ``xx, xy, xz, yy, yz, zz`` of a symmetric matrix."""

TINY = wp.constant(real(1.4916681462400413e-154))  # vectors.tiny of float64
TINIEST = wp.constant(real(2.2250738585072014e-308))
HALF = wp.constant(real(0.5))
LARGEST = wp.constant(0x7FFFFFFF)


@wp.func
def place(start: int, i: int):
    """Index of the i-th element of a row. The mask shows Warp that it is not negative (it would count from the end)."""
    return (start + i) & LARGEST


@wp.func
def vanishes(squared: real):
    return squared <= TINY


@wp.func
def underflows(x: real):
    return x <= TINIEST


@wp.func
def root(x: real):
    return wp.sqrt(wp.max(x, TINY))


@wp.func
def inverse(x: real, zero: bool):
    result = real(0.0)
    if not zero:
        result = real(1.0) / x
    return result


@wp.func
def above_rounding(number: real, x: real):
    return number


@wp.func
def block(along: real, g: vec3, across: real):
    """``along * g gᵀ + across`` times the identity."""
    h = along * g
    return symmetric(
        h[0] * g[0] + across, h[0] * g[1], h[0] * g[2], h[1] * g[1] + across, h[1] * g[2], h[2] * g[2] + across
    )


@wp.func
def multiply(m: symmetric, g: vec3):
    return vec3(
        m[0] * g[0] + m[1] * g[1] + m[2] * g[2],
        m[1] * g[0] + m[3] * g[1] + m[4] * g[2],
        m[2] * g[0] + m[4] * g[1] + m[5] * g[2],
    )
