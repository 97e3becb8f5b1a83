"""Triangles that turn between two shapes, or along a trajectory."""

from math import factorial

import warp as wp

from torch_modal.elastic.kernels.elements import (
    HALF,
    TINIEST,
    TINY,
    length_of,
    place,
    real,
    vec3,
    vec4,
)
from torch_modal.geometry import rotations, triangle_frames

packed_trajectory = wp.types.vector(length=30, dtype=real)
"""A row of :meth:`torch_modal.geometry.local_rotations.Trajectory`, in the order of its parts."""

packed_turn = wp.types.vector(length=12, dtype=real)
"""Both axes of the frame of a triangle in the first shape, and the entries of its stretch in both."""

FLAT = wp.constant(real(triangle_frames.FLAT))
HEIGHT = wp.constant(real(triangle_frames.HEIGHT))
PER_HEIGHT = wp.constant(real(1 / triangle_frames.HEIGHT))
SMALL = wp.constant(real(rotations.SMALL))

ten, five = wp.types.vector(length=10, dtype=real), wp.types.vector(length=5, dtype=real)
SINC = wp.constant(ten(*[(-1) ** k / factorial(2 * k + 1) for k in range(10)]))
COSINE = wp.constant(ten(*[(-1) ** k / factorial(2 * k) for k in range(10)]))
ARC = wp.constant(five(*[(-1) ** k / (2 * k + 1) for k in range(5)]))


@wp.struct
class FaceTables:
    faces: wp.array(dtype=wp.vec3i)
    sides: wp.array(dtype=wp.vec3i)
    """Edges of the sides of each triangle."""
    signs: wp.array(dtype=vec3)
    """Senses of the sides."""
    order: wp.array(dtype=wp.int32)
    """Triangles, parents before children."""
    parent: wp.array(dtype=wp.int32)
    piece: wp.array(dtype=wp.int32)
    n_vertices: int
    n_edges: int
    n_pieces: int


# ----------------------------------------------------------------------------------------------------------- triangles
@wp.struct
class Triangle:
    e1: vec3
    e2: vec3
    normal: vec3
    xx: real
    xy: real
    yy: real
    flat: bool


@wp.func
def triangle(p: vec3, q: vec3, r: vec3):
    """triangle_frames.frames."""
    t = Triangle()
    one = q - p
    other = PER_HEIGHT * (r - p - HALF * one)
    xx = wp.dot(one, one)
    xy = wp.dot(one, other)
    yy = wp.dot(other, other)
    total = wp.max(xx + yy, TINY)
    up = wp.cross(one, other)
    lift = length_of(up)
    t.flat = lift <= FLAT * total
    lift = wp.max(lift, FLAT * total)
    t.normal = (real(1.0) / lift) * up
    per = real(1.0) / wp.sqrt(total + real(2.0) * lift)
    t.xx = per * (xx + lift)
    t.xy = per * xy
    t.yy = per * (yy + lift)
    if xx + yy <= TINY:
        per = real(0.0)
    t.e1 = per * (one + wp.cross(other, t.normal))
    t.e2 = per * (other + wp.cross(t.normal, one))
    return t


@wp.func
def doubled_area(xx: real, xy: real, yy: real):
    return HEIGHT * (xx * yy - xy * xy)


@wp.func
def quaternion_of(r: wp.mat33d):
    w = real(1.0) + r[0, 0] + r[1, 1] + r[2, 2]
    x = real(1.0) + r[0, 0] - r[1, 1] - r[2, 2]
    y = real(1.0) - r[0, 0] + r[1, 1] - r[2, 2]
    z = real(1.0) - r[0, 0] - r[1, 1] + r[2, 2]
    wx = r[2, 1] - r[1, 2]
    wy = r[0, 2] - r[2, 0]
    wz = r[1, 0] - r[0, 1]
    xy = r[0, 1] + r[1, 0]
    xz = r[0, 2] + r[2, 0]
    yz = r[1, 2] + r[2, 1]
    largest = wp.max(wp.max(w, x), wp.max(y, z))
    row = vec4(w, wx, wy, wz)
    if w < largest:
        if x == largest:
            row = vec4(wx, x, xy, xz)
        elif y == largest:
            row = vec4(wy, xy, y, yz)
        else:
            row = vec4(wz, xz, yz, z)
    return (HALF / wp.sqrt(wp.max(largest, real(2.220446049250313e-16)))) * row


@wp.func
def quaternion(a: Triangle, b: Triangle):
    return quaternion_of(wp.outer(b.e1, a.e1) + wp.outer(b.e2, a.e2) + wp.outer(b.normal, a.normal))


@wp.func
def triangle_of(surface: FaceTables, x: wp.array(dtype=vec3), at: int, k: int):
    f = surface.faces[place(k, 0)]
    return triangle(x[place(at, f[0])], x[place(at, f[1])], x[place(at, f[2])])


@wp.kernel(enable_backward=False)
def turns(
    surface: FaceTables,
    x: wp.array(dtype=vec3),
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
    packed: wp.array(dtype=packed_turn),
    threads: int,
):
    """Quaternions between the frames of two shapes, twice both areas, and the other inputs of :func:`part_turned`."""
    i = wp.tid()
    s = i // threads
    v = 2 * s * surface.n_vertices
    for k in range(i - s * threads, surface.faces.shape[0], threads):
        a = triangle_of(surface, x, v, k)
        b = triangle_of(surface, x, v + surface.n_vertices, k)
        at = place(s * surface.faces.shape[0], k)
        quaternions[at] = quaternion(a, b)
        areas[at] = doubled_area(a.xx, a.xy, a.yy) + doubled_area(b.xx, b.xy, b.yy)
        packed[at] = packed_turn(
            a.e1[0], a.e1[1], a.e1[2], a.e2[0], a.e2[1], a.e2[2], a.xx, a.xy, a.yy, b.xx, b.xy, b.yy
        )


@wp.kernel(enable_backward=False)
def sign_votes(
    surface: FaceTables,
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
    sign: wp.array(dtype=real),
    vote: wp.array(dtype=real),
):
    """Signs passed down the tree, parents before children; then each piece votes. One thread for a sample."""
    s = wp.tid()
    n = surface.order.shape[0]
    for j in range(n):
        k = surface.order[place(j, 0)]
        at = place(s * n, k)
        above = surface.parent[place(k, 0)]
        q = quaternions[at]
        own = real(1.0)
        if above != k:
            own = sign[place(s * n, above)]
            if wp.dot(q, quaternions[place(s * n, above)]) < real(0.0):
                own = -own
        sign[at] = own
        wp.atomic_add(vote, place(s * surface.n_pieces, surface.piece[place(k, 0)]), areas[at] * own * q[0])
    least = real(0.0)
    for k in range(surface.n_pieces):
        least = wp.min(least, vote[place(s * surface.n_pieces, k)])
    if least < real(0.0):
        for k in range(n):
            if vote[place(s * surface.n_pieces, surface.piece[place(k, 0)])] < real(0.0):
                sign[place(s * n, k)] = -sign[place(s * n, k)]


@wp.func
def rotated(real_part: real, axis: vec3, v: vec3):
    twice = real(2.0) * wp.cross(axis, v)
    return v + real_part * twice + wp.cross(axis, twice)


@wp.func
def sinc_near(z: real):
    """Series of ``sin r / r`` in the square of an ``r`` of at most one."""
    found = SINC[9]
    for k in range(9):
        found = found * z + SINC[8 - k]
    return found


@wp.func
def cosine_near(z: real):
    """Series of ``cos r``, likewise."""
    found = COSINE[9]
    for k in range(9):
        found = found * z + COSINE[8 - k]
    return found


@wp.func
def half_turn(q: vec4):
    """Axis times half the angle: rotations.arc."""
    axis = vec3(q[1], q[2], q[3])
    sine = wp.dot(axis, axis)
    factor = real(0.0)
    if sine < SMALL * q[0] * q[0] and q[0] > real(0.0):
        per = real(1.0) / q[0]
        t = sine * per * per
        factor = ARC[4]
        for k in range(4):
            factor = factor * t + ARC[3 - k]
        factor = factor * per
    else:
        root = wp.sqrt(wp.max(sine, TINIEST))
        factor = wp.atan2(root, q[0]) / root
    return factor * axis


@wp.func
def add_sides(total: wp.array(dtype=vec4), edge: int, e: wp.vec3i, g: vec3, area: real, first: vec3, second: vec3):
    s1 = (area * g[0]) * first
    s2 = (area * g[1]) * (second - first)
    s3 = (-area * g[2]) * second
    wp.atomic_add(total, place(edge, e[0]), vec4(s1[0], s1[1], s1[2], area))
    wp.atomic_add(total, place(edge, e[1]), vec4(s2[0], s2[1], s2[2], area))
    wp.atomic_add(total, place(edge, e[2]), vec4(s3[0], s3[1], s3[2], area))


@wp.func
def about(half: vec3):
    """The quaternion that turns about an axis by twice its length."""
    z = wp.dot(half, half)
    real_part = real(0.0)
    factor = real(0.0)
    if z < real(1.0):
        real_part = cosine_near(z)
        factor = sinc_near(z)
    else:
        angle = wp.sqrt(z)
        real_part = wp.cos(angle)
        factor = wp.sin(angle) / angle
    return vec4(real_part, factor * half[0], factor * half[1], factor * half[2])


@wp.func
def composed(p: vec4, q: vec4):
    """First the second, then the first."""
    a = vec3(p[1], p[2], p[3])
    b = vec3(q[1], q[2], q[3])
    axis = p[0] * b + q[0] * a + wp.cross(a, b)
    return vec4(p[0] * q[0] - wp.dot(a, b), axis[0], axis[1], axis[2])


@wp.func
def first_axis(q: vec4):
    """Turned."""
    two = real(2.0)
    return vec3(
        real(1.0) - two * (q[2] * q[2] + q[3] * q[3]),
        two * (q[1] * q[2] + q[0] * q[3]),
        two * (q[1] * q[3] - q[0] * q[2]),
    )


@wp.func
def second_axis(q: vec4):
    """Turned."""
    two = real(2.0)
    return vec3(
        two * (q[1] * q[2] - q[0] * q[3]),
        real(1.0) - two * (q[1] * q[1] + q[3] * q[3]),
        two * (q[2] * q[3] + q[0] * q[1]),
    )


@wp.func
def turned(q: vec4, v: vec3):
    return rotated(q[0], vec3(q[1], q[2], q[3]), v)


@wp.func
def at_sides(surface: FaceTables, values: wp.array(dtype=real), k: int):
    """Values of edges at the sides of a triangle."""
    e = surface.sides[place(k, 0)]
    return vec3(values[place(e[0], 0)], values[place(e[1], 0)], values[place(e[2], 0)])


@wp.kernel(enable_backward=False)
def part_turned(
    surface: FaceTables,
    quaternions: wp.array(dtype=vec4),
    sign: wp.array(dtype=real),
    packed: wp.array(dtype=packed_turn),
    weights: wp.array(dtype=wp.vec2d),
    shares: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    pulls: wp.array(dtype=vec3),
    threads: int,
):
    """Pulls of the edge vectors between two shapes on their vertices, of turns whose signs are known.

    A side of a triangle has a share of its edge vector, which is pulled at with a stiffness.
    """
    i = wp.tid()
    s = i // threads
    w = weights[s]
    to = s * surface.n_vertices
    for k in range(i - s * threads, surface.sides.shape[0], threads):
        at = place(s * surface.sides.shape[0], k)
        c = packed[at]
        turn = about(w[1] * half_turn(sign[at] * quaternions[at]))
        one = turned(turn, vec3(c[0], c[1], c[2]))
        two = turned(turn, vec3(c[3], c[4], c[5]))
        x = w[0] * c[6] + w[1] * c[9]
        y = w[0] * c[7] + w[1] * c[10]
        z = w[0] * c[8] + w[1] * c[11]
        first = x * one + y * two
        second = HALF * first + HEIGHT * (y * one + z * two)
        f = surface.faces[place(k, 0)]
        pull = wp.cw_mul(shares[place(k, 0)], at_sides(surface, stiffness, k))
        s1 = pull[0] * first
        s2 = pull[1] * (second - first)
        s3 = -pull[2] * second
        wp.atomic_add(pulls, place(to, f[0]), s3 - s1)
        wp.atomic_add(pulls, place(to, f[1]), s1 - s2)
        wp.atomic_add(pulls, place(to, f[2]), s2 - s3)


@wp.kernel(enable_backward=False)
def trajectory_edges(
    surface: FaceTables,
    trajectory: wp.array(dtype=packed_trajectory),
    which: wp.array(dtype=wp.int32),
    time: wp.array(dtype=real),
    total: wp.array(dtype=vec4),
    threads: int,
):
    """Sides of triangles on a smooth trajectory, summed on the edges by area, and the areas."""
    i = wp.tid()
    s = i // threads
    u = time[s]
    a = u * (real(1.0) - u) * (real(1.0) - u)
    b = -u * (real(1.0) - u) * u
    for k in range(i - s * threads, surface.sides.shape[0], threads):
        c = trajectory[place(which[s] * surface.sides.shape[0], k)]
        e1 = vec3(c[0], c[1], c[2])
        e2 = vec3(c[3], c[4], c[5])
        normal = vec3(c[6], c[7], c[8])
        straight = about((HALF * u) * vec3(c[12], c[13], c[14]))
        bend = about(HALF * (a * vec3(c[18], c[19], c[20]) + b * vec3(c[24], c[25], c[26])))
        xx = c[9] + u * c[15] + a * c[21] + b * c[27]
        xy = c[10] + u * c[16] + a * c[22] + b * c[28]
        yy = c[11] + u * c[17] + a * c[23] + b * c[29]
        q = composed(straight, bend)
        x = first_axis(q)
        y = second_axis(q)
        one = x[0] * e1 + x[1] * e2 + x[2] * normal
        two = y[0] * e1 + y[1] * e2 + y[2] * normal
        area = (real(1.0) - u) * doubled_area(c[9], c[10], c[11])
        area += u * doubled_area(c[9] + c[15], c[10] + c[16], c[11] + c[17])
        first = xx * one + xy * two
        second = HALF * first + HEIGHT * (xy * one + yy * two)
        add_sides(
            total, s * surface.n_edges, surface.sides[place(k, 0)], surface.signs[place(k, 0)], area, first, second
        )
