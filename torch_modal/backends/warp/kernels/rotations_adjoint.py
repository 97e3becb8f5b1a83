"""Adjoints of :mod:`torch_modal.backends.warp.kernels.rotations`: from sides of rotated triangles to shapes.

A part ``exp(t log R)`` of a rotation turns by ``J(t theta) (t dtheta + theta dt)`` where ``R = exp(theta)`` turns by
``J(theta) dtheta``, with the left Jacobian ``J`` of the rotations (Chirikjian 2012, section 10.6).
"""

import warp as wp

from torch_modal.backends.warp.kernels.elements import place, real, vec3, vec4
from torch_modal.backends.warp.kernels.rotations import (
    SMALL,
    Triangle,
    about,
    half_turn,
    quaternion,
    sinc,
    triangle,
    turned,
)

TWO = wp.constant(real(2.0))
NO_LENGTH = wp.constant(real(1e-70))


@wp.func
def inverse(q: vec4):
    return vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def sinc_of(q: vec4, half: vec3):
    """Of the length of ``half``, about which the quaternion turns by twice that."""
    squared = wp.dot(half, half)
    if squared < SMALL:
        return sinc(squared)
    return wp.dot(vec3(q[1], q[2], q[3]), half) / squared


@wp.func
def reached(turn: vec4, half: vec3, part: vec4, t: real, torque: vec3):
    """The torque on a rotation by twice ``half``, from that on its part ``t``."""
    own = t * half
    squared = wp.dot(own, own)
    scale = sinc_of(part, own)
    along = scale * part[0]
    remainder = real(2.0) / real(3.0) - squared * (
        real(2.0) / real(15.0) - squared * (real(4.0) / real(315.0) - squared * (real(2.0) / real(2835.0)))
    )
    if squared >= SMALL:
        remainder = (real(1.0) - along) / squared
    found = along * torque + (remainder * wp.dot(own, torque)) * own - (scale * scale) * wp.cross(own, torque)
    squared = wp.dot(half, half)
    remainder = real(1.0) / real(3.0) + squared * (
        real(1.0) / real(45.0) + squared * (real(2.0) / real(945.0) + squared * (real(1.0) / real(4725.0)))
    )
    along = real(1.0) - squared * remainder
    if squared >= SMALL:
        along = turn[0] / sinc_of(turn, half)
        remainder = (real(1.0) - along) / squared
    return t * (along * found + (remainder * wp.dot(half, found)) * half + wp.cross(half, found))


@wp.func
def from_triangle(t: Triangle, torque: vec3, to_length: real, to_along: real, to_height: real):
    """Gradients of the two sides from the first corner, from those of a triangle's frame and size."""
    per_length = real(0.0)
    if t.length > NO_LENGTH:
        per_length = real(1.0) / t.length
    lift = wp.dot(torque, t.e1) / t.height
    swing = wp.dot(torque, t.normal) + t.height * to_along - t.along * to_height
    sink = wp.dot(torque, t.e2) + t.along * lift
    first = to_length * t.e1 + (per_length * swing) * t.e2 - (per_length * sink) * t.normal
    second = to_along * t.e1 + to_height * t.e2 + lift * t.normal
    return first, second


@wp.kernel(enable_backward=False)
def from_turned(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    time: wp.array(dtype=real),
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array(dtype=wp.vec3i),
    signs: wp.array(dtype=vec3),
    sign: wp.array(dtype=real),
    n: int,
    n_edges: int,
    to_total: wp.array(dtype=vec4),
    to_first: wp.array(dtype=vec3),
    to_second: wp.array(dtype=vec3),
    to_time: wp.array(dtype=real),
    threads: int,
):
    """Adjoint of ``rotations.part_turned``: adds the gradients of both shapes and the times."""
    i = wp.tid()
    s = i // threads
    v = s * n
    edge = s * n_edges
    t = time[s]
    to_t = real(0.0)
    for k in range(i - s * threads, faces.shape[0], threads):
        f = faces[place(k, 0)]
        p = place(v, f[0])
        q = place(v, f[1])
        r = place(v, f[2])
        a = triangle(first[p], first[q], first[r])
        b = triangle(second[p], second[q], second[r])
        turn = sign[place(s * faces.shape[0], k)] * quaternion(a, b)
        half = half_turn(turn)
        part = about(t * half)
        x = a.length + t * (b.length - a.length)
        y = a.along + t * (b.along - a.along)
        z = a.height + t * (b.height - a.height)
        one = turned(part, x * a.e1)
        two = turned(part, y * a.e1 + z * a.e2)
        # From the edges: of the sides ``one``, ``two - one`` and ``-two``, and of the area.
        of = sides[place(k, 0)]
        g = signs[place(k, 0)]
        e1 = to_total[place(edge, of[0])]
        e2 = to_total[place(edge, of[1])]
        e3 = to_total[place(edge, of[2])]
        across = g[1] * vec3(e2[0], e2[1], e2[2])
        by_one = g[0] * vec3(e1[0], e1[1], e1[2]) - across
        by_two = across - g[2] * vec3(e3[0], e3[1], e3[2])
        to_area = wp.dot(by_one, one) + wp.dot(by_two, two) + e1[3] + e2[3] + e3[3]
        area = a.length * a.height + b.length * b.height
        to_one = area * by_one
        to_two = area * by_two
        torque = wp.cross(one, to_one) + wp.cross(two, to_two)
        back = inverse(part)
        flat_one = turned(back, to_one)
        flat_two = turned(back, to_two)
        to_x = wp.dot(a.e1, flat_one)
        to_y = wp.dot(a.e1, flat_two)
        to_z = wp.dot(a.e2, flat_two)
        to_t += TWO * wp.dot(torque, half)
        to_t += (b.length - a.length) * to_x + (b.along - a.along) * to_y + (b.height - a.height) * to_z
        whole = reached(turn, half, part, t, torque)
        u, w = from_triangle(
            a,
            turned(back, torque) - turned(inverse(turn), whole),
            to_x - t * to_x + to_area * a.height,
            to_y - t * to_y,
            to_z - t * to_z + to_area * a.length,
        )
        wp.atomic_add(to_first, p, -(u + w))
        wp.atomic_add(to_first, q, u)
        wp.atomic_add(to_first, r, w)
        u, w = from_triangle(b, whole, t * to_x + to_area * b.height, t * to_y, t * to_z + to_area * b.length)
        wp.atomic_add(to_second, p, -(u + w))
        wp.atomic_add(to_second, q, u)
        wp.atomic_add(to_second, r, w)
    wp.atomic_add(to_time, s, to_t)
