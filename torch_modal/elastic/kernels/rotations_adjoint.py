"""Adjoints of kernels of rotations and poses: from sides of rotated triangles, and from rotations, to shapes.

A part ``exp(t log R)`` of a rotation turns by ``J(t theta) (t dtheta + theta dt)`` where ``R = exp(theta)`` turns by
``J(theta) dtheta``, with the left Jacobian ``J`` of the rotations (Chirikjian 2012, section 10.6).
"""

import warp as wp

from torch_modal.elastic.kernels.elements import HALF, TINIEST, place, real, vec3, vec4
from torch_modal.elastic.kernels.procrustes import half_of
from torch_modal.elastic.kernels.rotations import (
    HEIGHT,
    PER_HEIGHT,
    SMALL,
    FaceTables,
    Triangle,
    about,
    at_sides,
    half_turn,
    quaternion,
    sinc_near,
    trajectory_edges,
    triangle_of,
    turned,
)

NO_LENGTH = wp.constant(real(1e-70))
EPSILON = wp.constant(real(64 * 2.0**-52))


@wp.func
def inverse(q: vec4):
    return vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def sinc_of(q: vec4, half: vec3):
    """Of the length of ``half``, about which the quaternion turns by twice that."""
    squared = wp.dot(half, half)
    if squared < SMALL:
        return sinc_near(squared)
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
    surface: FaceTables,
    shapes: wp.array(dtype=vec3),
    weights: wp.array(dtype=wp.vec2d),
    sign: wp.array(dtype=real),
    shares: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    to_pulls: wp.array(dtype=vec3),
    to_shapes: wp.array(dtype=vec3),
    to_weights: wp.array(dtype=wp.vec2d),
    threads: int,
):
    """Adjoint of ``rotations.part_turned``: adds the gradients of both shapes and the weights."""
    i = wp.tid()
    s = i // threads
    v = 2 * s * surface.n_vertices
    at = s * surface.n_vertices
    u = weights[s][0]
    t = weights[s][1]
    to_w = wp.vec2d()
    for k in range(i - s * threads, surface.faces.shape[0], threads):
        a = triangle_of(surface, shapes, v, k)
        b = triangle_of(surface, shapes, v + surface.n_vertices, k)
        turn = sign[place(s * surface.faces.shape[0], k)] * quaternion(a, b)
        half = half_turn(turn)
        part = about(t * half)
        x = u * a.xx + t * b.xx
        y = u * a.xy + t * b.xy
        z = u * a.yy + t * b.yy
        one = turned(part, x * a.e1 + y * a.e2)
        two = HALF * one + HEIGHT * turned(part, y * a.e1 + z * a.e2)
        # Of the sides ``one``, ``two - one`` and ``-two``.
        f = surface.faces[place(k, 0)]
        to_p = to_pulls[place(at, f[0])]
        to_q = to_pulls[place(at, f[1])]
        to_r = to_pulls[place(at, f[2])]
        pull = wp.cw_mul(shares[place(k, 0)], at_sides(surface, stiffness, k))
        across = pull[1] * (to_r - to_q)
        to_one = pull[0] * (to_q - to_p) - across
        to_two = across - pull[2] * (to_p - to_r)
        torque = wp.cross(one, to_one) + wp.cross(two, to_two)
        back = inverse(part)
        flat_one = turned(back, to_one + HALF * to_two)
        flat_two = HEIGHT * turned(back, to_two)
        to_x = wp.dot(a.e1, flat_one)
        to_y = wp.dot(a.e2, flat_one) + wp.dot(a.e1, flat_two)
        to_z = wp.dot(a.e2, flat_two)
        to_w += wp.vec2d(
            a.xx * to_x + a.xy * to_y + a.yy * to_z,
            b.xx * to_x + b.xy * to_y + b.yy * to_z + real(2.0) * wp.dot(torque, half),
        )
        whole = reached(turn, half, part, t, torque)
        own = turned(back, torque) - turned(inverse(turn), whole)
        one, two = from_triangle(a, own, u * to_x, u * to_y, u * to_z)
        wp.atomic_add(to_shapes, place(v, f[0]), -(one + two))
        wp.atomic_add(to_shapes, place(v, f[1]), one)
        wp.atomic_add(to_shapes, place(v, f[2]), two)
        one, two = from_triangle(b, whole, t * to_x, t * to_y, t * to_z)
        other = v + surface.n_vertices
        wp.atomic_add(to_shapes, place(other, f[0]), -(one + two))
        wp.atomic_add(to_shapes, place(other, f[1]), one)
        wp.atomic_add(to_shapes, place(other, f[2]), two)
    wp.atomic_add(to_weights, s, to_w)


# --------------------------------------------------------------------------------------------------------------- poses
@wp.func
def torque_of(m: wp.mat33d):
    """Torque on a small turn before a matrix, from the gradient of the product times the transpose of the product."""
    return vec3(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])


@wp.func
def to_covariance(covariance: wp.mat33d, rotation: wp.mat33d, torque: vec3):
    """Adjoint of ``procrustes.best_rotation``, with the floor of rigid.best_rotation."""
    p = covariance @ wp.transpose(rotation)
    trace = wp.trace(p)
    floor = EPSILON * wp.abs(trace)
    if wp.abs(trace) <= TINIEST:
        floor = real(1.0)
    hessian = (trace + floor) * wp.identity(n=3, dtype=real) - HALF * (p + wp.transpose(p))
    return wp.skew(wp.inverse(hessian) @ torque) @ rotation


@wp.kernel(enable_backward=False)
def mean_pose(
    to_reference: wp.array(dtype=wp.mat33d),
    among: wp.array(dtype=wp.mat33d),
    weights: wp.array(dtype=wp.vec2d),
    turns: wp.array(dtype=wp.mat33d),
    pose: wp.array(dtype=wp.mat33d),
    to_turns: wp.array(dtype=wp.mat33d),
    to_pose: wp.array(dtype=wp.mat33d),
    to_covariances: wp.array(dtype=wp.mat33d),
    to_among: wp.array(dtype=wp.mat33d),
    to_weights: wp.array(dtype=wp.vec2d),
):
    """Adjoint of ``procrustes.mean_pose``."""
    s = wp.tid()
    w = weights[s]
    a = to_reference[2 * s]
    first = turns[2 * s]
    second = turns[2 * s + 1]
    onto = wp.transpose(first) @ second
    back = wp.transpose(onto)
    b = to_reference[2 * s + 1] @ back
    # A rotation changes by a small turn about fixed axes, and receives a torque.
    torque = torque_of(to_pose[s] @ wp.transpose(pose[s]))
    half = half_of(back)
    whole = about(half)
    from_part = reached(whole, half, about(w[1] * half), w[1], torque)
    from_second = torque_of(to_turns[2 * s + 1] @ wp.transpose(second))
    to_first = torque_of(to_turns[2 * s] @ wp.transpose(first)) + from_second - wp.transpose(pose[s]) @ torque
    to_onto = wp.transpose(first) @ from_second - onto @ from_part
    to_sum = to_covariance(w[0] * a + w[1] * b, first, to_first)
    to_onto -= w[1] * torque_of(wp.transpose(b) @ to_sum)
    to_covariances[2 * s] = w[0] * to_sum
    to_covariances[2 * s + 1] = w[1] * to_sum @ onto
    to_among[4 * s + 1] = to_covariance(among[4 * s + 1], onto, to_onto)
    to_weights[s] = wp.vec2d(wp.ddot(to_sum, a), wp.ddot(to_sum, b) + real(2.0) * wp.dot(torque, half))


# Generated, which repeats the work on a triangle first: what `add_sides` adds is done once more, in scratch memory.
trajectory_edges = wp.kernel(trajectory_edges.func, module=__name__, enable_backward=True)
