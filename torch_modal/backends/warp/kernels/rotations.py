"""Triangles that turn between shapes, and the vertices that fit them."""

import warp as wp

from torch_modal.backends.warp.kernels.elements import HALF, TINIEST, TINY, length_of, place, real, vec3, vec4
from torch_modal.geometry import rotations, triangle_frames

packed_trajectory = wp.types.vector(length=31, dtype=real)
"""A row of :meth:`torch_modal.geometry.local_rotations.Trajectory`, in the order of its parts."""

packed_turn = wp.types.vector(length=12, dtype=real)
"""Of a triangle, both axes of its frame in the first shape, the entries of its stretch there, and how they change."""

FLAT = wp.constant(real(triangle_frames.FLAT))
HEIGHT = wp.constant(real(triangle_frames.HEIGHT))
PER_HEIGHT = wp.constant(real(1 / triangle_frames.HEIGHT))
SMALL = wp.constant(real(rotations.SMALL))


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
    up = (real(1.0) / total) * wp.cross(one, other)
    area = wp.max(length_of(up), FLAT)
    t.flat = area <= FLAT
    t.normal = (real(1.0) / area) * up
    lift = area * total
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


@wp.kernel(enable_backward=False)
def turns(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    faces: wp.array(dtype=wp.vec3i),
    n: int,
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
    packed: wp.array(dtype=packed_turn),
    threads: int,
):
    """Quaternions between the frames of triangles, twice both areas, and the other inputs of :func:`part_turned`."""
    i = wp.tid()
    s = i // threads
    v = s * n
    for k in range(i - s * threads, faces.shape[0], threads):
        f = faces[place(k, 0)]
        p = place(v, f[0])
        q = place(v, f[1])
        r = place(v, f[2])
        a = triangle(first[p], first[q], first[r])
        b = triangle(second[p], second[q], second[r])
        at = place(s * faces.shape[0], k)
        quaternions[at] = quaternion(a, b)
        areas[at] = doubled_area(a.xx, a.xy, a.yy) + doubled_area(b.xx, b.xy, b.yy)
        packed[at] = packed_turn(
            a.e1[0],
            a.e1[1],
            a.e1[2],
            a.e2[0],
            a.e2[1],
            a.e2[2],
            a.xx,
            a.xy,
            a.yy,
            b.xx - a.xx,
            b.xy - a.xy,
            b.yy - a.yy,
        )


@wp.kernel(enable_backward=False)
def sign_votes(
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
    order: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    piece: wp.array(dtype=wp.int32),
    n_pieces: int,
    sign: wp.array(dtype=real),
    vote: wp.array(dtype=real),
):
    """Signs passed down the tree, parents before children; then each piece votes. One thread for a sample."""
    s = wp.tid()
    n = order.shape[0]
    for j in range(n):
        k = order[place(j, 0)]
        at = place(s * n, k)
        above = parent[place(k, 0)]
        q = quaternions[at]
        own = real(1.0)
        if above != k:
            own = sign[place(s * n, above)]
            if wp.dot(q, quaternions[place(s * n, above)]) < real(0.0):
                own = -own
        sign[at] = own
        wp.atomic_add(vote, place(s * n_pieces, piece[place(k, 0)]), areas[at] * own * q[0])
    for k in range(n):
        if vote[place(s * n_pieces, piece[place(k, 0)])] < real(0.0):
            sign[place(s * n, k)] = -sign[place(s * n, k)]


@wp.func
def rotated(real_part: real, axis: vec3, v: vec3):
    twice = real(2.0) * wp.cross(axis, v)
    return v + real_part * twice + wp.cross(axis, twice)


@wp.func
def sinc(squared_angle: real):
    # Of the square: with all derivatives at zero.
    found = real(1.0) - squared_angle / real(6.0) * (
        real(1.0) - squared_angle / real(20.0) * (real(1.0) - squared_angle / real(42.0))
    )
    if squared_angle >= SMALL:
        angle = wp.sqrt(squared_angle)
        found = wp.sin(angle) / angle
    return found


@wp.func
def half_turn(q: vec4):
    """Axis times half the angle: rotations.arc."""
    axis = vec3(q[1], q[2], q[3])
    sine = wp.dot(axis, axis)
    factor = real(0.0)
    if sine < SMALL * q[0] * q[0] and q[0] > real(0.0):
        t = sine / (q[0] * q[0])
        factor = (
            real(1.0)
            - t
            * (
                real(1.0) / real(3.0)
                - t * (real(1.0) / real(5.0) - t * (real(1.0) / real(7.0) - t * real(1.0) / real(9.0)))
            )
        ) / q[0]
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
    # Both are functions of the square: up to a whole turn, interpolated at Chebyshev's nodes to 2e-19.
    w = z * z
    even = real(1.0) + w * (
        real(0.041666666666666644)
        + w
        * (
            real(2.4801587301543947e-05)
            + w * (real(2.087675689868704e-09) + w * (real(4.7794436302050165e-14) + w * (real(4.086623381139723e-19))))
        )
    )
    odd = real(-0.5) + w * (
        real(-0.001388888888888844)
        + w
        * (
            real(-2.7557319221516713e-07)
            + w
            * (real(-1.1470743476144586e-11) + w * (real(-1.561566465023175e-16) + w * (real(-7.978335129390308e-22))))
        )
    )
    cosine = even + z * odd
    even = real(1.0) + w * (
        real(0.008333333333333333)
        + w
        * (
            real(2.755731922396843e-06)
            + w
            * (real(1.6059043800914716e-10) + w * (real(2.8114436905160995e-15) + w * (real(1.947767908073262e-20))))
        )
    )
    odd = real(-0.16666666666666666) + w * (
        real(-0.0001984126984126966)
        + w
        * (
            real(-2.505210838444744e-08)
            + w
            * (real(-7.647162877752289e-13) + w * (real(-8.219210144599324e-18) + w * (real(-3.4993887391279544e-23))))
        )
    )
    sine = even + z * odd
    if z > real(10.0):
        cosine = wp.cos(wp.sqrt(z))
        sine = sinc(z)
    return vec4(cosine, sine * half[0], sine * half[1], sine * half[2])


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


@wp.kernel(enable_backward=False)
def part_turned(
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
    packed: wp.array(dtype=packed_turn),
    time: wp.array(dtype=real),
    sides: wp.array(dtype=wp.vec3i),
    signs: wp.array(dtype=vec3),
    sign: wp.array(dtype=real),
    n_edges: int,
    total: wp.array(dtype=vec4),
    threads: int,
):
    """Sides of all triangles at their times, summed on the edges by area, and the areas, of turns that are known."""
    i = wp.tid()
    s = i // threads
    t = time[s]
    for k in range(i - s * threads, sides.shape[0], threads):
        at = place(s * sides.shape[0], k)
        c = packed[at]
        turn = about(t * half_turn(sign[at] * quaternions[at]))
        one = turned(turn, vec3(c[0], c[1], c[2]))
        two = turned(turn, vec3(c[3], c[4], c[5]))
        x = c[6] + t * c[9]
        y = c[7] + t * c[10]
        z = c[8] + t * c[11]
        first = x * one + y * two
        second = HALF * first + HEIGHT * (y * one + z * two)
        add_sides(total, s * n_edges, sides[place(k, 0)], signs[place(k, 0)], areas[at], first, second)


@wp.kernel(enable_backward=False)
def trajectory_edges(
    trajectory: wp.array(dtype=packed_trajectory),
    which: wp.array(dtype=wp.int32),
    time: wp.array(dtype=real),
    sides: wp.array(dtype=wp.vec3i),
    signs: wp.array(dtype=vec3),
    n_edges: int,
    total: wp.array(dtype=vec4),
    threads: int,
):
    """The same of triangles on a smooth trajectory."""
    i = wp.tid()
    s = i // threads
    u = time[s]
    a = u * (real(1.0) - u) * (real(1.0) - u)
    b = -u * (real(1.0) - u) * u
    for k in range(i - s * threads, sides.shape[0], threads):
        c = trajectory[place(which[s] * sides.shape[0], k)]
        e1 = vec3(c[0], c[1], c[2])
        e2 = vec3(c[3], c[4], c[5])
        normal = vec3(c[6], c[7], c[8])
        straight = about((HALF * u) * vec3(c[12], c[13], c[14]))
        bend = about(HALF * (a * vec3(c[18], c[19], c[20]) + b * vec3(c[24], c[25], c[26])))
        unit = c[30]
        xx = c[9] + unit * (u * c[15] + a * c[21] + b * c[27])
        xy = c[10] + unit * (u * c[16] + a * c[22] + b * c[28])
        yy = c[11] + unit * (u * c[17] + a * c[23] + b * c[29])
        q = composed(straight, bend)
        x = first_axis(q)
        y = second_axis(q)
        one = x[0] * e1 + x[1] * e2 + x[2] * normal
        two = y[0] * e1 + y[1] * e2 + y[2] * normal
        area = (real(1.0) - u) * doubled_area(c[9], c[10], c[11])
        area += u * doubled_area(c[9] + unit * c[15], c[10] + unit * c[16], c[11] + unit * c[17])
        first = xx * one + xy * two
        second = HALF * first + HEIGHT * (xy * one + yy * two)
        add_sides(total, s * n_edges, sides[place(k, 0)], signs[place(k, 0)], area, first, second)


# ---------------------------------------------------------------------------------------------------- Poisson problem
@wp.kernel(enable_backward=False)
def pulls(
    wanted: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    ends: wp.array(dtype=wp.vec2i),
    n: int,
    out: wp.array(dtype=vec3),
    threads: int,
):
    """The right side of the Poisson problem: the divergence of the edges."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, ends.shape[0], threads):
        pull = weights[place(k, 0)] * wanted[place(s * ends.shape[0], k)]
        both = ends[place(k, 0)]
        wp.atomic_add(out, place(s * n, both[0]), -pull)
        wp.atomic_add(out, place(s * n, both[1]), pull)
