"""Adjoints of the kernels of Eq. 5: up to third derivatives, in one pass over the elements.

An energy depends on the shape of a hinge through its angle alone, whose gradient is that of
:func:`~torch_modal.elastic.kernels.elements.angle_gradients`; of the phase nothing else is differentiated.
"""

import warp as wp

from torch_modal.elastic.kernels.elements import (
    ALL,
    FOUR_THIRDS,
    HALF,
    ONCE,
    SIXTH,
    TINIEST,
    TINY,
    Elements,
    Hinge,
    angle_gradients,
    bend_beyond,
    bend_slope,
    corner,
    doubled,
    hinge_of,
    length_of,
    linearised,
    middle_of,
    moments,
    phase_of,
    place,
    real,
    rested,
    symmetric,
    vec3,
)
from torch_modal.elastic.kernels.modal import (
    LEAST,
    NEEDLES,
    NEEDLES_OF_STEPS,
    fullness,
    fullness_of,
    usual_fullness,
)
from torch_modal.elastic.kernels.shell import RATIO, SLACKNESS, bend_weight

TWO = wp.constant(real(2.0))


@wp.func
def direction_of(e: vec3):
    """The unit vector; zero without a length."""
    found = vec3()
    square = wp.dot(e, e)
    if square > TINY:
        found = (real(1.0) / wp.sqrt(square)) * e
    return found


@wp.func
def from_square(d: symmetric, g: vec3):
    """Gradient in a vector of the entries of its square."""
    return vec3(
        TWO * d[0] * g[0] + d[1] * g[1] + d[2] * g[2],
        d[1] * g[0] + TWO * d[3] * g[1] + d[4] * g[2],
        d[2] * g[0] + d[4] * g[1] + TWO * d[5] * g[2],
    )


@wp.func
def from_normals(h: Hinge, to_n1: vec3, to_n2: vec3):
    """Gradients of the edge and both tips of a hinge, from those of the normals."""
    return wp.cross(h.a, to_n1) + wp.cross(to_n2, h.b), wp.cross(to_n1, h.e), wp.cross(h.e, to_n2)


@wp.func
def from_angle_gradients(h: Hinge, ga: vec3, gb: vec3, to_ge: vec3, to_ga: vec3, to_gb: vec3):
    """Gradients of the edge and both tips of a hinge, from those of the gradients of its angle."""
    per_length = real(1.0) / h.length
    per = per_length * per_length
    part_a = per * wp.dot(h.a, h.e)
    part_b = per * wp.dot(h.b, h.e)
    to_part_a = -per * wp.dot(to_ge, ga)
    to_part_b = -per * wp.dot(to_ge, gb)
    to_ga -= part_a * to_ge
    to_gb -= part_b * to_ge
    along_a = h.per1 * wp.dot(h.n1, to_ga)
    along_b = h.per2 * wp.dot(h.n2, to_gb)
    to_n1 = (-h.length * h.per1) * (to_ga - (TWO * along_a) * h.n1)
    to_n2 = (-h.length * h.per2) * (to_gb - (TWO * along_b) * h.n2)
    to_e, to_a, to_b = from_normals(h, to_n1, to_n2)
    to_e += to_part_a * (h.a - (TWO * part_a) * h.e) + to_part_b * (h.b - (TWO * part_b) * h.e)
    to_e -= ((along_a + along_b) * per_length) * h.e
    return to_e, to_a + to_part_a * h.e, to_b + to_part_b * h.e


@wp.func
def add_hinge(to_x: wp.array(dtype=vec3), at: int, q: wp.vec4i, to_e: vec3, to_a: vec3, to_b: vec3):
    wp.atomic_add(to_x, place(at, q[0]), -(to_e + to_a + to_b))
    wp.atomic_add(to_x, place(at, q[1]), to_e)
    if q[2] >= 0:
        wp.atomic_add(to_x, place(at, q[2]), to_a)
        wp.atomic_add(to_x, place(at, q[3]), to_b)


@wp.func
def add_corners(to_x: wp.array(dtype=vec3), at: int, q: wp.vec3i, to_a: vec3, to_b: vec3, to_c: vec3):
    """Adds the gradients of the corners of a triangle, and returns what the middle receives."""
    wp.atomic_add(to_x, place(at, q[0]), to_a)
    wp.atomic_add(to_x, place(at, q[1]), to_b)
    found = -(to_a + to_b)
    if q[2] >= 0:
        wp.atomic_add(to_x, place(at, q[2]), to_c)
        found -= to_c
    return found


@wp.kernel(enable_backward=False)
def sizes(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    to_found: wp.array(dtype=wp.vec2d),
    to_x: wp.array(dtype=vec3),
    to_centre: wp.array(dtype=vec3),
    threads: int,
):
    """From the gradients of volume and surface; all edges together have none."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    middle = middle_of(mesh, x, centre, s)
    to_volume = SIXTH * to_found[s][0]
    to_area = HALF * to_found[s][1]
    to_middle = vec3()
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        q = mesh.capped_faces[place(k, 0)]
        a = x[place(v, q[0])] - middle
        b = x[place(v, q[1])] - middle
        c = corner(x, middle, v, q[2]) - middle
        normal = to_area * direction_of(wp.cross(b - a, c - a))
        to_b = wp.cross(c - a, normal)
        to_c = wp.cross(normal, b - a)
        to_a = to_volume * wp.cross(b, c) - to_b - to_c
        to_b += to_volume * wp.cross(c, a)
        to_c += to_volume * wp.cross(a, b)
        to_middle += add_corners(to_x, v, q, to_a, to_b, to_c)
    if to_centre:
        wp.atomic_add(to_centre, s, to_middle)


@wp.kernel(enable_backward=False)
def merge(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    pulls: wp.array(dtype=real),
    shortest: wp.array(dtype=real),
    alpha: wp.array(dtype=real),
    beta: wp.array(dtype=real),
    n_shapes: int,
    n_alpha: int,
    n_beta: int,
    out: wp.array(dtype=rested),
    to_out: wp.array(dtype=rested),
    to_x: wp.array(dtype=vec3),
    to_pulls: wp.array(dtype=real),
    to_alpha: wp.array(dtype=real),
    to_beta: wp.array(dtype=real),
    threads: int,
):
    """From the gradients of the reference; the shortest lengths, and the energy that remains, have none."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        at = place(s * mesh.record.shape[0], k)
        rest = out[at]
        to = to_out[at]
        at = place(s * n_alpha, wp.min(k, n_alpha - 1))
        bent = place(s * n_beta, wp.min(mesh.hinge[place(k, 0)], n_beta - 1))
        for r in range(s * n_shapes, (s + 1) * n_shapes):
            v = r * mesh.n_vertices
            pull = TWO * pulls[place(r, 0)]
            e = x[place(v, q[1])] - x[place(v, q[0])]
            length = length_of(e)
            to_pull = real(0.0)
            to_e = vec3()
            to_a = vec3()
            to_b = vec3()
            if rest[0] > real(0.0) and length > shortest[place(r, 0)]:
                # The mean length is a quotient of sums.
                per = real(1.0) / length
                to_mean = to[1] / rest[0]
                to_sum = to[0] - to_mean * rest[1]
                found = per * to_sum + to_mean
                to_e = (-pull * alpha[at] * per * per * to_sum) * direction_of(e)
                to_pull += alpha[at] * found
                wp.atomic_add(to_alpha, at, pull * found)
            if q[2] >= 0 and rest[2] > real(0.0):
                h = hinge_of(x, v, q)
                if not h.flat:
                    p = phase_of(h)
                    t = doubled(p)
                    own = pull * beta[bent]
                    weight = bend_weight(h, RATIO)
                    found = to[2] + to[3] * p[0] + to[4] * p[1] + to[5] * t[0] + to[6] * t[1]
                    turn = to[4] * p[0] - to[3] * p[1] + TWO * (to[6] * t[0] - to[5] * t[1])
                    ge, ga, gb = angle_gradients(h)
                    turn = own * weight * turn
                    to_e += turn * ge
                    to_a += turn * ga
                    to_b += turn * gb
                    to_pull += beta[bent] * weight * found
                    wp.atomic_add(to_beta, bent, pull * weight * found)
                    first = length_of(h.n1)
                    second = length_of(h.n2)
                    area = HALF * (first + second)
                    if weight < RATIO:
                        scale = own * found / area
                        to_n1 = (-HALF * scale * weight / first) * h.n1
                        to_n2 = (-HALF * scale * weight / second) * h.n2
                        own_e, own_a, own_b = from_normals(h, to_n1, to_n2)
                        to_e += (TWO * scale) * e + own_e
                        to_a += own_a
                        to_b += own_b
            add_hinge(to_x, v, q, to_e, to_a, to_b)
            wp.atomic_add(to_pulls, place(r, 0), TWO * to_pull)


@wp.func
def from_fullness(e: vec3, tip: vec3, normal: vec3, needles: real, to_found: real):
    """Gradients of the edge, the tip and the normal."""
    across = tip - e
    longest = wp.max(wp.dot(e, e), wp.max(wp.dot(tip, tip), wp.dot(across, across)))
    squared = wp.dot(normal, normal)
    to_e = vec3()
    to_tip = vec3()
    to_normal = vec3()
    if longest > real(0.0):
        bound = needles * longest * longest
        scale = TWO * to_found / ((squared + bound) * (squared + bound))
        to_normal = (scale * bound) * normal
        to_longest = -TWO * scale * squared * needles * longest
        if wp.dot(e, e) == longest:
            to_e = to_longest * e
        elif wp.dot(tip, tip) == longest:
            to_tip = to_longest * tip
        else:
            to_tip = to_longest * across
            to_e = -to_tip
    return to_e, to_tip, to_normal


@wp.func
def add_fullness(to_x: wp.array(dtype=vec3), v: int, q: wp.vec4i, h: Hinge, needles: real, to_found: real):
    """Adjoint of ``modal.fullness_of``."""
    first = to_found * fullness(h.e, h.a, h.n1, needles)
    second = to_found * fullness(h.e, h.b, h.n2, needles)
    first_e, first_a, to_n1 = from_fullness(h.e, h.a, h.n1, needles, second)
    second_e, second_b, to_n2 = from_fullness(h.e, h.b, h.n2, needles, first)
    to_e, to_a, to_b = from_normals(h, to_n1, to_n2)
    add_hinge(to_x, v, q, to_e + first_e + second_e, to_a + first_a, to_b + second_b)


@wp.kernel(enable_backward=False)
def soften(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    shapes: wp.array(dtype=vec3),
    pulls: wp.array(dtype=real),
    n_shapes: int,
    to_out: wp.array(dtype=rested),
    to_x: wp.array(dtype=vec3),
    to_rests: wp.array(dtype=rested),
    to_shapes: wp.array(dtype=vec3),
    to_pulls: wp.array(dtype=real),
    threads: int,
):
    """Adjoint of ``modal.soften``."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        at = place(s * mesh.record.shape[0], k)
        to = to_out[at]
        if q[2] >= 0:
            w = rests[at]
            h = hinge_of(x, v, q)
            found = to[2] * w[2] + to[3] * w[3] + to[4] * w[4] + to[5] * w[5] + to[6] * w[6]
            f = real(0.0)
            if n_shapes == 0:
                f = fullness_of(h, NEEDLES)
                add_fullness(to_x, v, q, h, NEEDLES, found)
            else:
                usual = usual_fullness(mesh, shapes, pulls, s, n_shapes, q)
                part = wp.min(fullness_of(h, NEEDLES_OF_STEPS) / usual, real(1.0))
                f = part * part * (real(3.0) - TWO * part)
                to_part = real(6.0) * part * (real(1.0) - part) * found
                add_fullness(to_x, v, q, h, NEEDLES_OF_STEPS, to_part / usual)
                if usual > LEAST:
                    to_usual = -to_part * part / usual
                    for r in range(s * n_shapes, (s + 1) * n_shapes):
                        rest = hinge_of(shapes, r * mesh.n_vertices, q)
                        pull = pulls[place(r, 0)]
                        add_fullness(to_shapes, r * mesh.n_vertices, q, rest, NEEDLES_OF_STEPS, to_usual * pull)
                        wp.atomic_add(to_pulls, place(r, 0), to_usual * fullness_of(rest, NEEDLES_OF_STEPS))
            to = rested(to[0], to[1], f * to[2], f * to[3], f * to[4], f * to[5], f * to[6])
        to_rests[at] = to


@wp.kernel(enable_backward=False)
def linearise(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    centre: wp.array(dtype=vec3),
    to_total: wp.array(dtype=wp.vec2d),
    to_gradient: wp.array(dtype=vec3),
    to_normal: wp.array(dtype=vec3),
    to_diagonal: wp.array(dtype=symmetric),
    to_factors: wp.array(dtype=linearised),
    to_x: wp.array(dtype=vec3),
    to_rests: wp.array(dtype=rested),
    to_centre: wp.array(dtype=vec3),
    threads: int,
):
    """From the gradients of the energy and its derivatives; those of blocks and factors may be left out, both."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    to_own = HALF * to_total[s][0]
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        at = place(s * mesh.record.shape[0], k)
        w = rests[at]
        q0 = place(v, q[0])
        q1 = place(v, q[1])
        e = x[q1] - x[q0]
        length = length_of(e)
        per_length = real(1.0) / length
        unit = per_length * e
        off = length - w[1]
        slope = w[0] * off
        origin = to_gradient[q0]
        d = to_gradient[q1] - origin
        to_slope = wp.dot(unit, d)
        to_unit = slope * d
        to_length = TWO * to_own * slope
        to_weight = to_own * off * off
        to_rest = -to_length
        f = linearised()
        at_first = symmetric()
        at_second = symmetric()
        if to_diagonal:
            f = to_factors[at]
            at_first = to_diagonal[q0]
            at_second = to_diagonal[q1]
            width = SLACKNESS * w[0] * length
            per_root = real(1.0) / wp.sqrt(slope * slope + width * width + TINIEST)
            across = HALF * per_length * (slope + real(1.0) / per_root)
            both = at_first + at_second
            turned = from_square(both, unit)
            to_along = HALF * wp.dot(unit, turned) + f[4]
            to_unit += (w[0] - across) * turned + vec3(f[0], f[1], f[2])
            to_across = per_length * (both[0] + both[3] + both[5] + f[3] - to_along)
            to_width = HALF * to_across * width * per_root * SLACKNESS
            to_slope += HALF * to_across * (real(1.0) + slope * per_root)
            to_length += to_width * w[0] - to_across * across
            to_weight += to_along + to_width * length
        to_weight += off * to_slope
        to_length += w[0] * to_slope
        to_rest -= w[0] * to_slope
        to_e = (to_length - per_length * wp.dot(unit, to_unit)) * unit + per_length * to_unit
        to_a = vec3()
        to_b = vec3()
        bend = moments()
        if q[2] >= 0:
            h = hinge_of(x, v, q)
            if h.flat:
                bend = to_own * moments(ALL, -ONCE, real(0.0), SIXTH, real(0.0))
            else:
                p = phase_of(h)
                t = doubled(p)
                ge, ga, gb = angle_gradients(h)
                moment = bend_slope(p, w)
                da = to_gradient[place(v, q[2])] - origin
                db = to_gradient[place(v, q[3])] - origin
                to_moment = wp.dot(ge, d) + wp.dot(ga, da) + wp.dot(gb, db)
                to_ge = moment * d
                to_ga = moment * da
                to_gb = moment * db
                to_stiffness = real(0.0)
                if to_diagonal:
                    first = from_square(at_first, ge + ga + gb)
                    second = from_square(at_second, ge)
                    third = from_square(to_diagonal[place(v, q[2])], ga)
                    fourth = from_square(to_diagonal[place(v, q[3])], gb)
                    to_stiffness = f[14] + HALF * (
                        wp.dot(first, ge + ga + gb) + wp.dot(second, ge) + wp.dot(third, ga) + wp.dot(fourth, gb)
                    )
                    to_ge += w[2] * (first + second) + vec3(f[5], f[6], f[7])
                    to_ga += w[2] * (first + third) + vec3(f[8], f[9], f[10])
                    to_gb += w[2] * (first + fourth) + vec3(f[11], f[12], f[13])
                to_angle = TWO * to_own * moment + to_moment * (w[2] + bend_beyond(p, w))
                own_e, own_a, own_b = from_angle_gradients(h, ga, gb, to_ge, to_ga, to_gb)
                to_e += own_e + to_angle * ge
                to_a = own_a + to_angle * ga
                to_b = own_b + to_angle * gb
                bend = moments(
                    to_own * ALL + to_stiffness,
                    FOUR_THIRDS * to_moment * p[1] - ONCE * to_own * p[0],
                    -FOUR_THIRDS * to_moment * p[0] - ONCE * to_own * p[1],
                    SIXTH * (to_own * t[0] - to_moment * t[1]),
                    SIXTH * (to_own * t[1] + to_moment * t[0]),
                )
        add_hinge(to_x, v, q, to_e, to_a, to_b)
        to_rests[at] = to_rests[at] + rested(to_weight, to_rest, bend[0], bend[1], bend[2], bend[3], bend[4])
    middle = middle_of(mesh, x, centre, s)
    to_volume = to_total[s][1]
    to_middle = vec3()
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        q3 = mesh.capped_faces[place(k, 0)]
        p0 = x[place(v, q3[0])] - middle
        p1 = x[place(v, q3[1])] - middle
        p2 = corner(x, middle, v, q3[2]) - middle
        n0 = to_normal[place(v, q3[0])]
        n1 = to_normal[place(v, q3[1])]
        n2 = vec3()
        if q3[2] >= 0:
            n2 = to_normal[place(v, q3[2])]
        to_0 = to_volume * wp.cross(p1, p2) + wp.cross(n1, p2) + wp.cross(p1, n2)
        to_1 = to_volume * wp.cross(p2, p0) + wp.cross(n2, p0) + wp.cross(p2, n0)
        to_2 = to_volume * wp.cross(p0, p1) + wp.cross(n0, p1) + wp.cross(p0, n1)
        to_middle += add_corners(to_x, v, q3, SIXTH * to_0, SIXTH * to_1, SIXTH * to_2)
    if to_centre:
        wp.atomic_add(to_centre, s, to_middle)
