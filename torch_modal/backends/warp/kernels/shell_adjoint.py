"""Adjoints of :mod:`torch_modal.backends.warp.kernels.shell`: gradients of rest shapes and shapes.

``to_y`` is the gradient in ``y`` of what is differentiated. All is added to what is there.
"""

import warp as wp

from torch_modal.backends.warp.kernels.elements import (
    HALF,
    TINIEST,
    TINY,
    angle_of,
    bent,
    corner,
    is_flat,
    length_of,
    middle_of,
    place,
    real,
    stretched,
    symmetric,
    vec3,
    vec4,
    wrapped,
)
from torch_modal.backends.warp.kernels.shell import RATIO, SLACKNESS, edge_weight

TWO = wp.constant(real(2.0))


# ----------------------------------------------------------------------------------------------------------- references
@wp.func
def from_rest_hinge(e: vec3, a: vec3, b: vec3, to_weight: real, to_angle: real):
    """Adjoint of ``shell.bend_weight``: gradients of the edge and the tips of a hinge at rest, and its weight."""
    to_e = vec3()
    to_a = vec3()
    to_b = vec3()
    weight = real(0.0)
    n1 = wp.cross(e, a)
    n2 = wp.cross(b, e)
    if not (is_flat(e, n1) or is_flat(e, n2)):
        base = wp.dot(e, e)
        length = length_of(e)
        l1 = length_of(n1)
        l2 = length_of(n2)
        area = HALF * (l1 + l2)
        weight = RATIO
        to_n1 = vec3()
        to_n2 = vec3()
        if area * RATIO > base:
            weight = base / area
            to_base = to_weight / area
            to_area = -HALF * to_base * weight
            to_n1 = (to_area / l1) * n1
            to_n2 = (to_area / l2) * n2
            to_e = (TWO * to_base) * e
        ga = (-to_angle * length / (l1 * l1)) * n1
        gb = (-to_angle * length / (l2 * l2)) * n2
        to_e += wp.cross(a, to_n1) + wp.cross(to_n2, b) - (wp.dot(a, e) / base) * ga - (wp.dot(b, e) / base) * gb
        to_a = ga + wp.cross(to_n1, e)
        to_b = gb + wp.cross(e, to_n2)
    return to_e, to_a, to_b, weight


@wp.func
def from_volume_and_area(a: vec3, b: vec3, c: vec3, to_volume: real, to_area: real):
    """Gradients of a triangle's corners relative to the middle, from those of the tetrahedron's volume and area."""
    sixth = to_volume / real(6.0)
    to_a = sixth * wp.cross(b, c)
    to_b = sixth * wp.cross(c, a)
    to_c = sixth * wp.cross(a, b)
    if to_area != real(0.0):
        normal = wp.cross(b - a, c - a)
        size = wp.dot(normal, normal)
        if size > TINY:
            g = (HALF * to_area / wp.sqrt(size)) * normal
            at_b = wp.cross(c - a, g)
            at_c = wp.cross(g, b - a)
            to_a -= at_b + at_c
            to_b += at_b
            to_c += at_c
    return to_a, to_b, to_c


@wp.kernel(enable_backward=False)
def from_reference(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    first_centre: wp.array(dtype=vec3),
    second_centre: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    hinge: wp.array(dtype=wp.int32),
    capped_faces: wp.array(dtype=wp.vec3i),
    pull: wp.array(dtype=wp.vec2d),
    shortest: wp.array(dtype=wp.vec2d),
    alpha: wp.array(dtype=real),
    beta: wp.array(dtype=real),
    n: int,
    n_alpha: int,
    n_beta: int,
    to_stretch: wp.array(dtype=wp.vec2d),
    to_bend: wp.array(dtype=vec4),
    to_volume: wp.array(dtype=wp.vec2d),
    to_area: wp.array(dtype=wp.vec2d),
    to_first: wp.array(dtype=vec3),
    to_second: wp.array(dtype=vec3),
    to_first_centre: wp.array(dtype=vec3),
    to_second_centre: wp.array(dtype=vec3),
    to_pull: wp.array(dtype=wp.vec2d),
    to_alpha: wp.array(dtype=real),
    to_beta: wp.array(dtype=real),
    threads: int,
):
    """Adjoint of ``shell.rest`` and ``shell.sizes``: gradients of both rest shapes, weights and stiffnesses."""
    i = wp.tid()
    s = i // threads
    v = s * n
    both = pull[s]
    short = shortest[s]
    drawn = wp.vec2d()
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(s * record.shape[0], k)
        q0 = place(v, q[0])
        q1 = place(v, q[1])
        origin1 = first[q0]
        origin2 = second[q0]
        e1 = first[q1] - origin1
        e2 = second[q1] - origin2
        l1 = length_of(e1)
        l2 = length_of(e2)
        w1 = edge_weight(both[0], l1, short[0])
        w2 = edge_weight(both[1], l2, short[1])
        whole = w1 + w2
        per_whole = real(0.0)
        if whole > real(0.0):
            per_whole = real(1.0) / whole
        share = w2 * per_whole
        given = to_stretch[at]
        own = place(s * n_alpha, wp.min(k, n_alpha - 1))
        to_share = given[1] * (l2 - l1) * per_whole
        to_w1 = TWO * alpha[own] * given[0] - to_share * share
        to_w2 = to_w1 + to_share
        to_l1 = given[1] * (real(1.0) - share)
        to_l2 = given[1] * share
        if l1 > short[0]:
            drawn += wp.vec2d(to_w1 / l1, real(0.0))
            to_l1 -= to_w1 * w1 / l1
        if l2 > short[1]:
            drawn += wp.vec2d(real(0.0), to_w2 / l2)
            to_l2 -= to_w2 * w2 / l2
        to_e1 = (to_l1 / l1) * e1
        to_e2 = (to_l2 / l2) * e2
        if to_alpha:
            wp.atomic_add(to_alpha, own, TWO * whole * given[0])
        if q[2] >= 0:
            q2 = place(v, q[2])
            q3 = place(v, q[3])
            own_beta = place(s * n_beta, wp.min(hinge[place(k, 0)], n_beta - 1))
            stiffness = TWO * beta[own_beta]
            bending = to_bend[at]
            a1 = first[q2] - origin1
            b1 = first[q3] - origin1
            a2 = second[q2] - origin2
            b2 = second[q3] - origin2
            at_e1, to_a1, to_b1, weight1 = from_rest_hinge(e1, a1, b1, stiffness * both[0] * bending[0], bending[1])
            at_e2, to_a2, to_b2, weight2 = from_rest_hinge(e2, a2, b2, stiffness * both[1] * bending[2], bending[3])
            to_e1 += at_e1
            to_e2 += at_e2
            wp.atomic_add(to_first, q0, -(to_e1 + to_a1 + to_b1))
            wp.atomic_add(to_first, q1, to_e1)
            wp.atomic_add(to_first, q2, to_a1)
            wp.atomic_add(to_first, q3, to_b1)
            wp.atomic_add(to_second, q0, -(to_e2 + to_a2 + to_b2))
            wp.atomic_add(to_second, q1, to_e2)
            wp.atomic_add(to_second, q2, to_a2)
            wp.atomic_add(to_second, q3, to_b2)
            drawn += stiffness * wp.vec2d(weight1 * bending[0], weight2 * bending[2])
            if to_beta:
                wp.atomic_add(
                    to_beta, own_beta, TWO * (both[0] * weight1 * bending[0] + both[1] * weight2 * bending[2])
                )
        else:
            wp.atomic_add(to_first, q0, -to_e1)
            wp.atomic_add(to_first, q1, to_e1)
            wp.atomic_add(to_second, q0, -to_e2)
            wp.atomic_add(to_second, q1, to_e2)
    wp.atomic_add(to_pull, s, drawn)
    middle1 = middle_of(first, first_centre, capped_faces, s, v)
    middle2 = middle_of(second, second_centre, capped_faces, s, v)
    to_middle1 = vec3()
    to_middle2 = vec3()
    of_volume = to_volume[s]
    of_area = to_area[s]
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        face = capped_faces[place(k, 0)]
        q0 = place(v, face[0])
        q1 = place(v, face[1])
        c1 = corner(first, middle1, v, face[2]) - middle1
        c2 = corner(second, middle2, v, face[2]) - middle2
        to_a1, to_b1, to_c1 = from_volume_and_area(
            first[q0] - middle1, first[q1] - middle1, c1, of_volume[0], of_area[0]
        )
        to_a2, to_b2, to_c2 = from_volume_and_area(
            second[q0] - middle2, second[q1] - middle2, c2, of_volume[1], of_area[1]
        )
        wp.atomic_add(to_first, q0, to_a1)
        wp.atomic_add(to_first, q1, to_b1)
        wp.atomic_add(to_second, q0, to_a2)
        wp.atomic_add(to_second, q1, to_b2)
        to_middle1 -= to_a1 + to_b1
        to_middle2 -= to_a2 + to_b2
        if face[2] >= 0:
            wp.atomic_add(to_first, place(v, face[2]), to_c1)
            wp.atomic_add(to_second, place(v, face[2]), to_c2)
            to_middle1 -= to_c1
            to_middle2 -= to_c2
    if to_first_centre:
        wp.atomic_add(to_first_centre, s, to_middle1)
        wp.atomic_add(to_second_centre, s, to_middle2)


# ---------------------------------------------------------------------------------------------------------- derivatives
@wp.func
def from_squared(m: symmetric, g: vec3):
    """Adjoint of ``elements.squared``."""
    return vec3(
        TWO * m[0] * g[0] + m[1] * g[1] + m[2] * g[2],
        m[1] * g[0] + TWO * m[3] * g[1] + m[4] * g[2],
        m[2] * g[0] + m[4] * g[1] + TWO * m[5] * g[2],
    )


@wp.kernel(enable_backward=False)
def from_point(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    centre: wp.array(dtype=vec3),
    capped_faces: wp.array(dtype=wp.vec3i),
    n: int,
    to_gradient: wp.array(dtype=vec3),
    to_diagonal: wp.array(dtype=symmetric),
    to_edges: wp.array(dtype=stretched),
    to_hinges: wp.array(dtype=bent),
    to_total: wp.array(dtype=real),
    to_normal: wp.array(dtype=vec3),
    to_x: wp.array(dtype=vec3),
    to_stretch: wp.array(dtype=wp.vec2d),
    to_bend: wp.array(dtype=vec4),
    to_centre: wp.array(dtype=vec3),
    threads: int,
):
    """Adjoint of ``shell.linearise`` without the energy: gradients of shapes and the reference.

    There may be no arrays of what the diagonal, the edges and the hinges receive.
    """
    i = wp.tid()
    s = i // threads
    v = s * n
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(s * record.shape[0], k)
        q0 = place(v, q[0])
        q1 = place(v, q[1])
        origin = x[q0]
        e = x[q1] - origin
        base = wp.dot(e, e)
        length = length_of(e)
        per_length = real(0.0)
        if base > TINY:
            per_length = real(1.0) / length
        wanted = stretch[at]
        d = length - wanted[1]
        slope = wanted[0] * d
        unit = per_length * e
        width = SLACKNESS * wanted[0] * length
        root = wp.sqrt(slope * slope + width * width + TINIEST)
        across = HALF * (slope + root) / length
        start = to_gradient[q0]
        pulled = to_gradient[q1] - start
        to_unit = slope * pulled
        to_slope = wp.dot(unit, pulled)
        to_across = real(0.0)
        to_along = real(0.0)
        if to_edges:
            r = to_edges[at]
            to_unit += vec3(r[0], r[1], r[2])
            to_across = r[3]
            to_along = r[4]
        if to_diagonal:
            m = to_diagonal[q0] + to_diagonal[q1]
            turned = from_squared(m, unit)
            to_unit += (wanted[0] - across) * turned
            to_along += HALF * wp.dot(unit, turned)
            to_across += m[0] + m[3] + m[5]
        to_across -= to_along
        to_root = HALF * to_across / length
        to_slope += to_root * (real(1.0) + slope / root)
        to_width = to_root * width / root
        to_length = wanted[0] * (to_slope + SLACKNESS * to_width) - to_across * across / length
        to_weight = to_along + d * to_slope + SLACKNESS * length * to_width
        to_stretch[at] = to_stretch[at] + wp.vec2d(to_weight, -wanted[0] * to_slope)
        to_e = per_length * (to_unit - wp.dot(unit, to_unit) * unit) + to_length * unit
        to_origin = -to_e
        if q[2] >= 0:
            q2 = place(v, q[2])
            q3 = place(v, q[3])
            a = x[q2] - origin
            b = x[q3] - origin
            n1 = wp.cross(e, a)
            n2 = wp.cross(b, e)
            if not (is_flat(e, n1) or is_flat(e, n2)):
                w = bend[at]
                theta = angle_of(e, a, b, n1, n2)
                d1 = wrapped(theta - w[1])
                d2 = wrapped(theta - w[3])
                moment = w[0] * d1 + w[2] * d2
                stiffness = w[0] + w[2]
                per1 = real(1.0) / wp.dot(n1, n1)
                per2 = real(1.0) / wp.dot(n2, n2)
                per_base = per_length * per_length
                ga = (-length * per1) * n1
                gb = (-length * per2) * n2
                along_a = per_base * wp.dot(a, e)
                along_b = per_base * wp.dot(b, e)
                ge = -(along_a * ga + along_b * gb)
                pulled_a = to_gradient[q2] - start
                pulled_b = to_gradient[q3] - start
                to_moment = wp.dot(ge, pulled) + wp.dot(ga, pulled_a) + wp.dot(gb, pulled_b)
                to_ge = moment * pulled
                to_ga = moment * pulled_a
                to_gb = moment * pulled_b
                to_stiffness = real(0.0)
                if to_hinges:
                    h = to_hinges[at]
                    to_ge += vec3(h[0], h[1], h[2])
                    to_ga += vec3(h[3], h[4], h[5])
                    to_gb += vec3(h[6], h[7], h[8])
                    to_stiffness = h[9]
                if to_diagonal:
                    gi = -(ga + gb + ge)
                    at_i = from_squared(to_diagonal[q0], gi)
                    at_e = from_squared(to_diagonal[q1], ge)
                    at_a = from_squared(to_diagonal[q2], ga)
                    at_b = from_squared(to_diagonal[q3], gb)
                    to_ge += stiffness * (at_e - at_i)
                    to_ga += stiffness * (at_a - at_i)
                    to_gb += stiffness * (at_b - at_i)
                    to_stiffness += HALF * (wp.dot(gi, at_i) + wp.dot(ge, at_e) + wp.dot(ga, at_a) + wp.dot(gb, at_b))
                to_bend[at] = to_bend[at] + vec4(
                    to_moment * d1 + to_stiffness, -to_moment * w[0], to_moment * d2 + to_stiffness, -to_moment * w[2]
                )
                to_angle = to_moment * stiffness
                to_ga -= along_a * to_ge
                to_gb -= along_b * to_ge
                across_a = per_base * wp.dot(ga, to_ge)
                across_b = per_base * wp.dot(gb, to_ge)
                in1 = per1 * wp.dot(n1, to_ga)
                in2 = per2 * wp.dot(n2, to_gb)
                to_n1 = (-length * per1) * (to_ga - (TWO * in1) * n1)
                to_n2 = (-length * per2) * (to_gb - (TWO * in2) * n2)
                to_a = to_angle * ga - across_a * e + wp.cross(to_n1, e)
                to_b = to_angle * gb - across_b * e + wp.cross(e, to_n2)
                to_edge = to_angle * ge - across_a * a - across_b * b + wp.cross(a, to_n1) + wp.cross(to_n2, b)
                to_edge -= (TWO * per_base * wp.dot(ge, to_ge)) * e + (in1 + in2) * unit
                wp.atomic_add(to_x, q2, to_a)
                wp.atomic_add(to_x, q3, to_b)
                to_e += to_edge
                to_origin -= to_edge + to_a + to_b
        wp.atomic_add(to_x, q0, to_origin)
        wp.atomic_add(to_x, q1, to_e)
    middle = middle_of(x, centre, capped_faces, s, v)
    to_middle = vec3()
    sixth = real(1.0) / real(6.0)
    swept = to_total[s]
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        face = capped_faces[place(k, 0)]
        q0 = place(v, face[0])
        q1 = place(v, face[1])
        a = x[q0] - middle
        b = x[q1] - middle
        c = corner(x, middle, v, face[2]) - middle
        # Of a third of the normals at each corner, and of the volume.
        at_a = to_normal[q0] + swept * a
        at_b = to_normal[q1]
        at_c = vec3()
        if face[2] >= 0:
            at_c = to_normal[place(v, face[2])]
        to_a = sixth * (swept * wp.cross(b, c) + wp.cross(at_b, c) + wp.cross(b, at_c))
        to_b = sixth * (wp.cross(c, at_a) + wp.cross(at_c, a))
        to_c = sixth * (wp.cross(at_a, b) + wp.cross(a, at_b))
        wp.atomic_add(to_x, q0, to_a)
        wp.atomic_add(to_x, q1, to_b)
        to_middle -= to_a + to_b
        if face[2] >= 0:
            wp.atomic_add(to_x, place(v, face[2]), to_c)
            to_middle -= to_c
    if to_centre:
        wp.atomic_add(to_centre, s, to_middle)
