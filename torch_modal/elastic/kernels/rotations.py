"""Triangles that turn between two shapes, or along a trajectory."""

from math import factorial

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.types import HALF, TINIEST, TINY, place, real, vec3, vec4
from torch_modal.geometry import rotations, triangle_frames

packed_rotation = wp.types.matrix(shape=(4, 3), dtype=real)
"""Axes of the frame of a triangle in the first shape, and the entries of its stretch in two shapes."""
packed_trajectory = wp.types.matrix(shape=(10, 3), dtype=real)
"""The frame and the stretch of a ``Trajectory``; turn and growth of its step, of its first and of its last part."""

length_of = for_kernels(formulas.length)
FLAT = wp.constant(real(triangle_frames.FLAT))
HEIGHT = wp.constant(real(triangle_frames.HEIGHT))
PER_HEIGHT = wp.constant(real(1 / triangle_frames.HEIGHT))
SMALL = wp.constant(real(rotations.SMALL))

ten, five = wp.types.vector(length=10, dtype=real), wp.types.vector(length=5, dtype=real)
SINC = wp.constant(ten(*[(-1) ** k / factorial(2 * k + 1) for k in range(10)]))
COSINE = wp.constant(ten(*[(-1) ** k / factorial(2 * k) for k in range(10)]))
ARC = wp.constant(five(*[(-1) ** k / (2 * k + 1) for k in range(5)]))


@wp.func
def half_rotation(q: vec4):
    """Axis times half the angle: rotations.arc. The axis of a triangle that is a point is zero, of either sign."""
    axis = vec3(q[1], q[2], q[3])
    sine = wp.dot(axis, axis)
    if sine < SMALL * q[0] * q[0] and (q[0] > real(0.0) or sine == real(0.0)):
        per = real(1.0) / q[0]
        t = sine * per * per
        factor = ARC[4]
        for k in range(4):
            factor = factor * t + ARC[3 - k]
        return (factor * per) * axis
    root = wp.sqrt(wp.max(sine, TINIEST))
    return (wp.atan2(root, q[0]) / root) * axis


@wp.func_grad(half_rotation)
def half_rotation_adjoint(q: vec4, to_half: vec3):
    """Closed form for a unit quaternion: neither the series nor the arc is differentiated."""
    axis = vec3(q[1], q[2], q[3])
    square = wp.max(wp.dot(axis, axis), TINIEST)
    scale = wp.where(square > TINIEST, wp.dot(half_rotation(q), axis) / square, real(1.0))
    along = wp.dot(axis, to_half)
    to_axis = scale * to_half + ((q[0] - scale) / square * along) * axis
    wp.adjoint[q] += vec4(-along, to_axis[0], to_axis[1], to_axis[2])


@wp.func
def about(half: vec3):
    """The rotation about an axis by twice its length."""
    z = wp.dot(half, half)
    if z < real(1.0):
        sinc = SINC[9]
        cosine = COSINE[9]
        for k in range(9):
            sinc = sinc * z + SINC[8 - k]
            cosine = cosine * z + COSINE[8 - k]
        return wp.quatd(sinc * half, cosine)
    angle = wp.sqrt(z)
    return wp.quatd((wp.sin(angle) / angle) * half, wp.cos(angle))


@wp.func
def quaternion(r: wp.mat33d):
    """rotations.quaternion."""
    x = vec3(r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    m = r + wp.transpose(r)
    w = real(1.0) + wp.trace(r)
    products = wp.matrix_from_rows(
        vec4(w, x[0], x[1], x[2]),
        vec4(x[0], real(2.0) - w + m[0, 0], m[0, 1], m[0, 2]),
        vec4(x[1], m[0, 1], real(2.0) - w + m[1, 1], m[1, 2]),
        vec4(x[2], m[0, 2], m[1, 2], real(2.0) - w + m[2, 2]),
    )
    best = int(0)  # noqa: RUF046, UP018 - a variable of Warp's, no constant
    for i in range(1, 4):
        if products[i, i] > products[best, best]:
            best = i
    return (HALF / wp.sqrt(products[best, best])) * products[best]


@wp.func
def corners(faces: wp.array[wp.vec3i], x: wp.array[vec3], at: int, k: int):
    f = faces[place(k, 0)]
    return wp.matrix_from_rows(x[place(at, f[0])], x[place(at, f[1])], x[place(at, f[2])])


@wp.func
def triangle(at: wp.mat33d):
    """triangle_frames.frames: the axes, and the entries ``xx, xy, yy`` of the stretch."""
    one = at[1] - at[0]
    other = PER_HEIGHT * (at[2] - at[0] - HALF * one)
    xx = wp.dot(one, one)
    xy = wp.dot(one, other)
    yy = wp.dot(other, other)
    total = wp.max(xx + yy, TINY)
    up = wp.cross(one, other)
    lift = wp.max(length_of(up), FLAT * total)
    normal = (real(1.0) / lift) * up
    per = real(1.0) / wp.sqrt(total + real(2.0) * lift)
    stretch = per * vec3(xx + lift, xy, yy + lift)
    per = wp.where(xx + yy > TINY, per, real(0.0))
    e1 = per * (one + wp.cross(other, normal))
    return wp.matrix_from_rows(e1, per * (other + wp.cross(normal, one)), normal), stretch


@wp.func_grad(triangle)
def triangle_adjoint(at: wp.mat33d, to_axes: wp.mat33d, to_u: vec3):
    """Gradients of a triangle's corners, by the torque on its axes.

    With the axes ``Q`` and the stretch ``U``, the columns ``Q U`` change by ``dQ U + Q dU``. In the plane, what is
    antisymmetric of the change over the trace of ``U`` is the rotation; across it, the change is a rotation of ``U``.
    """
    axes, u = triangle(at)
    torque = wp.cross(axes[0], to_axes[0]) + wp.cross(axes[1], to_axes[1]) + wp.cross(axes[2], to_axes[2])
    along = axes @ torque
    mean = HALF * to_u[1]
    area = u[0] * u[2] - u[1] * u[1]
    spin = (along[2] + (to_u[0] - to_u[2]) * u[1] + mean * (u[2] - u[0])) / (u[0] + u[2])
    flat = area <= FLAT * (u[0] * u[0] + real(2.0) * u[1] * u[1] + u[2] * u[2])
    lift = wp.where(flat, real(0.0), real(1.0) / area)
    one = vec3(to_u[0], mean + spin, -lift * (u[2] * along[1] + u[1] * along[0])) @ axes
    other = PER_HEIGHT * vec3(mean - spin, to_u[2], lift * (u[1] * along[1] + u[0] * along[0])) @ axes
    one -= HALF * other
    wp.adjoint[at] += wp.matrix_from_rows(-one - other, one, other)


@wp.func
def doubled_area(stretch: vec3):
    return HEIGHT * (stretch[0] * stretch[2] - stretch[1] * stretch[1])


@wp.func
def sides(e1: vec3, e2: vec3, stretch: vec3):
    first = stretch[0] * e1 + stretch[1] * e2
    second = HALF * first + HEIGHT * (stretch[1] * e1 + stretch[2] * e2)
    return wp.matrix_from_rows(first, second - first, -second)


@wp.kernel(enable_backward=False)
def turns(
    faces: wp.array[wp.vec3i], n_vertices: int, x: wp.array[vec3], quaternions: wp.array[vec4], areas: wp.array[real],
    packed: wp.array[packed_rotation], threads: int,
):  # fmt: skip
    """Quaternions between the frames of two shapes, twice both areas, and inputs of :func:`right_hand_side`."""
    i = wp.tid()
    s = i // threads
    v = 2 * s * n_vertices
    for k in range(i - s * threads, faces.shape[0], threads):
        a, here = triangle(corners(faces, x, v, k))
        b, there = triangle(corners(faces, x, v + n_vertices, k))
        at = place(s * faces.shape[0], k)
        quaternions[at] = quaternion(wp.transpose(b) @ a)
        areas[at] = doubled_area(here) + doubled_area(there)
        packed[at] = wp.matrix_from_rows(a[0], a[1], here, there)


@wp.kernel(enable_backward=False)
def sign_votes(
    order: wp.array[wp.int32], parents: wp.array[wp.int32], pieces: wp.array[wp.int32], n_pieces: int,
    quaternions: wp.array[vec4], areas: wp.array[real], sign: wp.array[real], vote: wp.array[real],
):  # fmt: skip
    """Signs passed down the tree, parents before children; then each piece votes. One thread for a sample."""
    s = wp.tid()
    n = order.shape[0]
    for j in range(n):
        k = order[place(j, 0)]
        at = place(s * n, k)
        above = place(s * n, parents[place(k, 0)])
        sign_here = wp.where(wp.dot(quaternions[at], quaternions[above]) < real(0.0), -sign[above], sign[above])
        sign[at] = sign_here
        p = place(s * n_pieces, pieces[place(k, 0)])
        wp.atomic_add(vote, p, areas[at] * sign_here * quaternions[at][0])
    for k in range(n):
        if vote[place(s * n_pieces, pieces[place(k, 0)])] < real(0.0):
            sign[place(s * n, k)] = -sign[place(s * n, k)]


@wp.func
def corner_values(at: packed_rotation, half: vec3, w: wp.vec2d, c: vec3):
    """Right-hand side at the corners of a triangle from its sides between two shapes, with stiffnesses of the sides."""
    fraction = about(w[1] * half)
    s = sides(wp.quat_rotate(fraction, at[0]), wp.quat_rotate(fraction, at[1]), w[0] * at[2] + w[1] * at[3])
    return wp.matrix_from_rows(c[2] * s[2] - c[0] * s[0], c[0] * s[0] - c[1] * s[1], c[1] * s[1] - c[2] * s[2])


@wp.kernel(enable_backward=False)
def right_hand_side(
    faces: wp.array[wp.vec3i], n_vertices: int, quaternions: wp.array[vec4], sign: wp.array[real],
    between: wp.array[packed_rotation], weights: wp.array[wp.vec2d], stiffness: wp.array[vec3],
    right: wp.array[vec3], threads: int,
):  # fmt: skip
    """Right-hand side of the Poisson system of the edge vectors between two shapes, from rotations with signs."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, faces.shape[0], threads):
        at = place(s * faces.shape[0], k)
        half = half_rotation(sign[at] * quaternions[at])
        values = corner_values(between[at], half, weights[s], stiffness[place(k, 0)])
        for j in range(3):
            wp.atomic_add(right, place(s * n_vertices, faces[place(k, 0)][j]), values[j])


@wp.kernel(enable_backward=False)
def trajectory_edges(
    triangle_sides: wp.array[wp.vec3i], signs: wp.array[wp.vec3i], n_edges: int,
    trajectory: wp.array[packed_trajectory], which: wp.array[wp.int32], time: wp.array[real], total: wp.array[vec4],
    threads: int,
):  # fmt: skip
    """Sides of triangles on a smooth trajectory, summed on the edges by area, and the areas."""
    i = wp.tid()
    s = i // threads
    e = s * n_edges
    u = time[s]
    a = u * (real(1.0) - u) * (real(1.0) - u)
    b = -u * (real(1.0) - u) * u
    for k in range(i - s * threads, triangle_sides.shape[0], threads):
        c = trajectory[place(which[s] * triangle_sides.shape[0], k)]
        size = c[3]
        rotation = wp.quat_to_matrix(about((HALF * u) * c[4]) * about(HALF * (a * c[6] + b * c[8])))
        axes = wp.transpose(rotation) @ wp.matrix_from_rows(c[0], c[1], c[2])
        edge_sides = sides(axes[0], axes[1], size + u * c[5] + a * c[7] + b * c[9])
        area = (real(1.0) - u) * doubled_area(size) + u * doubled_area(size + c[5])
        for j in range(3):
            x = (area * real(signs[place(k, 0)][j])) * edge_sides[j]
            wp.atomic_add(total, place(e, triangle_sides[place(k, 0)][j]), vec4(x[0], x[1], x[2], area))
