"""Bounded stretching and bending of shapes against two others, on some of the edges and their hinges."""

import warp as wp

from torch_modal.backends.torch.distortion import LARGEST_STRAIN, LARGEST_WEIGHT
from torch_modal.backends.warp.kernels.elements import (
    is_flat,
    length_of,
    phase_of,
    place,
    real,
    turn_between,
    vec3,
    vec4,
)

WEIGHT = wp.constant(real(LARGEST_WEIGHT))
STRAIN = wp.constant(real(LARGEST_STRAIN))


@wp.func
def measured(x: wp.array(dtype=vec3), at: int, q: wp.vec4i):
    """Length, cosine and sine of the dihedral angle, and its weight ``l^2 / A``; 0 without a hinge."""
    origin = x[place(at, q[0])]
    e = x[place(at, q[1])] - origin
    found = vec4(length_of(e), real(1.0), real(0.0), real(0.0))
    if q[2] >= 0:
        a = x[place(at, q[2])] - origin
        b = x[place(at, q[3])] - origin
        n1 = wp.cross(e, a)
        n2 = wp.cross(b, e)
        if not (is_flat(e, n1) or is_flat(e, n2)):
            phase = phase_of(e, b, n1, n2)
            found[1] = phase[0]
            found[2] = phase[1]
            weight = real(2.0) * wp.dot(e, e) / (wp.length(n1) + wp.length(n2))
            found[3] = wp.min(weight, WEIGHT)
    return found


@wp.func
def cost(found: vec4, rest: vec4, stretching: real, bending: real):
    off = wp.abs(found[0] - rest[0])
    turn = turn_between(wp.vec2d(rest[1], rest[2]), wp.vec2d(found[1], found[2]))[0]
    bend = turn * (real(2.0) + turn / real(3.0))
    return stretching * off * wp.min(off / rest[0], STRAIN) + bending * rest[3] * bend


@wp.kernel(enable_backward=False)
def distortion(
    x: wp.array(dtype=vec3),
    n_shapes: int,
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    which: wp.array(dtype=wp.int32),
    t: wp.array(dtype=real),
    record: wp.array(dtype=wp.vec4i),
    edge: wp.array(dtype=wp.int32),
    hinge: wp.array(dtype=wp.int32),
    alpha: wp.array(dtype=real),
    beta: wp.array(dtype=real),
    n_alpha: int,
    n_beta: int,
    n: int,
    out: wp.array(dtype=real),
    threads: int,
):
    """The shapes of a sample lie ``t.shape[0] * n`` entries from each other; edges and hinges have separate sums."""
    i = wp.tid()
    s = i // threads
    samples = t.shape[0]
    end = which[s] * n
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        one = measured(first, end, q)
        other = measured(second, end, q)
        stretching = alpha[place(s * n_alpha, edge[place(k, 0)] % n_alpha)]
        bending = real(0.0)
        if q[2] >= 0:
            bending = beta[place(s * n_beta, hinge[place(k, 0)] % n_beta)]
        for j in range(n_shapes):
            found = measured(x, (j * samples + s) * n, q)
            pull = t[s]
            stretched = (real(1.0) - pull) * cost(found, one, stretching, real(0.0))
            stretched += pull * cost(found, other, stretching, real(0.0))
            bent = (real(1.0) - pull) * cost(found, one, real(0.0), bending)
            bent += pull * cost(found, other, real(0.0), bending)
            wp.atomic_add(out, place(2 * s, 2 * j * samples), stretched)
            wp.atomic_add(out, place(2 * s + 1, 2 * j * samples), bent)
