"""Adjoints of :mod:`torch_modal.backends.warp.kernels.rotations`: from sides of rotated triangles to shapes.

A part ``exp(t log R)`` of a rotation turns by ``J(t theta) (t dtheta + theta dt)`` where ``R = exp(theta)`` turns by
``J(theta) dtheta``, with the left Jacobian ``J`` of the rotations (Chirikjian 2012, section 10.6).
"""

import warp as wp

from torch_modal.backends.warp.kernels.elements import HALF, place, real, vec3, vec4
from torch_modal.backends.warp.kernels.rotations import (
    HEIGHT,
    PER_HEIGHT,
    SMALL,
    Triangle,
    about,
    doubled_area,
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
def from_triangle(t: Triangle, torque: vec3, to_xx: real, to_xy: real, to_yy: real):
    """Gradients of the two sides from the first corner, from those of a triangle's frame and stretch.

    With the frame ``Q`` and the stretch ``U``, the columns ``Q U`` change by ``dQ U + Q dU``. In the plane, what is
    antisymmetric of the change over the trace of ``U`` is the rotation; across it, the change is a rotation of ``U``.
    """
    x = wp.dot(torque, t.e1)
    y = wp.dot(torque, t.e2)
    mean = HALF * to_xy
    spin = real(0.0)
    if t.xx + t.yy > NO_LENGTH:
        spin = wp.dot(torque, t.normal) + to_xx * t.xy - to_yy * t.xy + mean * (t.yy - t.xx)
        spin = spin / (t.xx + t.yy)
    lift = real(0.0)
    if not t.flat:
        lift = real(1.0) / (t.xx * t.yy - t.xy * t.xy)
    one = to_xx * t.e1 + (mean + spin) * t.e2 - (lift * (t.yy * y + t.xy * x)) * t.normal
    other = (mean - spin) * t.e1 + to_yy * t.e2 + (lift * (t.xy * y + t.xx * x)) * t.normal
    other = PER_HEIGHT * other
    return one - HALF * other, other


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
        x = a.xx + t * (b.xx - a.xx)
        y = a.xy + t * (b.xy - a.xy)
        z = a.yy + t * (b.yy - a.yy)
        one = turned(part, x * a.e1 + y * a.e2)
        two = HALF * one + HEIGHT * turned(part, y * a.e1 + z * a.e2)
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
        area = doubled_area(a.xx, a.xy, a.yy) + doubled_area(b.xx, b.xy, b.yy)
        to_one = area * by_one
        to_two = area * by_two
        torque = wp.cross(one, to_one) + wp.cross(two, to_two)
        back = inverse(part)
        flat_one = turned(back, to_one + HALF * to_two)
        flat_two = HEIGHT * turned(back, to_two)
        to_x = wp.dot(a.e1, flat_one)
        to_y = wp.dot(a.e2, flat_one) + wp.dot(a.e1, flat_two)
        to_z = wp.dot(a.e2, flat_two)
        to_t += TWO * wp.dot(torque, half)
        to_t += (b.xx - a.xx) * to_x + (b.xy - a.xy) * to_y + (b.yy - a.yy) * to_z
        to_area = HEIGHT * to_area
        whole = reached(turn, half, part, t, torque)
        u, w = from_triangle(
            a,
            turned(back, torque) - turned(inverse(turn), whole),
            to_x - t * to_x + to_area * a.yy,
            to_y - t * to_y - TWO * to_area * a.xy,
            to_z - t * to_z + to_area * a.xx,
        )
        wp.atomic_add(to_first, p, -(u + w))
        wp.atomic_add(to_first, q, u)
        wp.atomic_add(to_first, r, w)
        to_xy = t * to_y - TWO * to_area * b.xy
        u, w = from_triangle(b, whole, t * to_x + to_area * b.yy, to_xy, t * to_z + to_area * b.xx)
        wp.atomic_add(to_second, p, -(u + w))
        wp.atomic_add(to_second, q, u)
        wp.atomic_add(to_second, r, w)
    wp.atomic_add(to_time, s, to_t)
