"""Eq. 5 towards two rest shapes: references, value, gradient, convex Hessian, products with it."""

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
    squared,
    stretched,
    symmetric,
    vec3,
    vec4,
    wrapped,
)
from torch_modal.energy.bend import MAX_BENDING_RATIO
from torch_modal.energy.stretch import MIN_RELATIVE_LENGTH, SLACK
from torch_modal.energy.volume import MIN_RELATIVE_VOLUME

RATIO = wp.constant(real(MAX_BENDING_RATIO))
SHORT = wp.constant(real(MIN_RELATIVE_LENGTH))
THIN = wp.constant(real(MIN_RELATIVE_VOLUME))
SLACKNESS = wp.constant(real(SLACK))


# ----------------------------------------------------------------------------------------------------------- references
@wp.kernel(enable_backward=False)
def sizes(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    first_centre: wp.array(dtype=vec3),
    second_centre: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    capped_faces: wp.array(dtype=wp.vec3i),
    n: int,
    length: wp.array(dtype=wp.vec2d),
    volume: wp.array(dtype=wp.vec2d),
    area: wp.array(dtype=wp.vec2d),
    threads: int,
):
    """Of both rest shapes: all edges together, the volume about the centre, the surface, closed towards the centre."""
    i = wp.tid()
    s = i // threads
    v = s * n
    total = wp.vec2d()
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        e1 = first[place(v, q[1])] - first[place(v, q[0])]
        e2 = second[place(v, q[1])] - second[place(v, q[0])]
        total += wp.vec2d(length_of(e1), length_of(e2))
    wp.atomic_add(length, s, total)
    middle1 = middle_of(first, first_centre, capped_faces, s, v)
    middle2 = middle_of(second, second_centre, capped_faces, s, v)
    sixth = real(1.0) / real(6.0)
    enclosed = wp.vec2d()
    around = wp.vec2d()
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        face = capped_faces[place(k, 0)]
        a1 = first[place(v, face[0])] - middle1
        b1 = first[place(v, face[1])] - middle1
        c1 = corner(first, middle1, v, face[2]) - middle1
        a2 = second[place(v, face[0])] - middle2
        b2 = second[place(v, face[1])] - middle2
        c2 = corner(second, middle2, v, face[2]) - middle2
        enclosed += sixth * wp.vec2d(wp.dot(a1, wp.cross(b1, c1)), wp.dot(a2, wp.cross(b2, c2)))
        around += HALF * wp.vec2d(length_of(wp.cross(b1 - a1, c1 - a1)), length_of(wp.cross(b2 - a2, c2 - a2)))
    wp.atomic_add(volume, s, enclosed)
    wp.atomic_add(area, s, around)


@wp.func
def own_size(volume: real, area: real):
    return wp.max(wp.abs(volume), THIN * wp.pow(area, real(1.5)))


@wp.kernel(enable_backward=False)
def weigh(
    time: wp.array(dtype=real),
    gamma: wp.array(dtype=real),
    lengths: wp.array(dtype=wp.vec2d),
    volumes: wp.array(dtype=wp.vec2d),
    areas: wp.array(dtype=wp.vec2d),
    n_edges: int,
    pull: wp.array(dtype=wp.vec2d),
    shortest: wp.array(dtype=wp.vec2d),
    stiffness: wp.array(dtype=real),
    volume: wp.array(dtype=real),
    constant: wp.array(dtype=real),
):
    """Weights of both rest shapes, the shortest edge, both volumes as one (Eq. 8). The stiffness is doubled."""
    s = wp.tid()
    t = time[s]
    pull[s] = wp.vec2d(real(1.0) - t, t)
    shortest[s] = (SHORT / real(n_edges)) * lengths[s]
    v1 = volumes[s][0]
    v2 = volumes[s][1]
    size1 = own_size(v1, areas[s][0])
    size2 = own_size(v2, areas[s][1])
    w1 = (real(1.0) - t) * gamma[s] / (size1 * size1)
    w2 = t * gamma[s] / (size2 * size2)
    share = real(0.0)
    if w1 + w2 > real(0.0):
        share = w2 / (w1 + w2)
    stiffness[s] = real(2.0) * (w1 + w2)
    volume[s] = v1 + share * (v2 - v1)
    constant[s] = w1 * share * (v2 - v1) * (v2 - v1)


@wp.func
def edge_weight(pull: real, length: real, shortest: real):
    found = real(0.0)
    if length > shortest:
        found = pull / length
    return found


@wp.func
def bend_weight(e: vec3, n1: vec3, n2: vec3):
    base = wp.dot(e, e)
    area = HALF * (length_of(n1) + length_of(n2))
    return base / wp.max(area, base / RATIO)


@wp.kernel(enable_backward=False)
def rest(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    hinge: wp.array(dtype=wp.int32),
    pull: wp.array(dtype=wp.vec2d),
    shortest: wp.array(dtype=wp.vec2d),
    alpha: wp.array(dtype=real),
    beta: wp.array(dtype=real),
    n: int,
    n_alpha: int,
    n_beta: int,
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    constant: wp.array(dtype=real),
    threads: int,
):
    """Both rest shapes as one reference: Eq. 8. Weights are doubled, for derivatives."""
    i = wp.tid()
    s = i // threads
    v = s * n
    both = pull[s]
    short = shortest[s]
    total = real(0.0)
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        out = place(s * record.shape[0], k)
        origin1 = first[place(v, q[0])]
        origin2 = second[place(v, q[0])]
        e1 = first[place(v, q[1])] - origin1
        e2 = second[place(v, q[1])] - origin2
        l1 = length_of(e1)
        l2 = length_of(e2)
        w1 = edge_weight(both[0], l1, short[0])
        w2 = edge_weight(both[1], l2, short[1])
        whole = w1 + w2
        share = real(0.0)
        if whole > real(0.0):
            share = w2 / whole
        own = alpha[place(s * n_alpha, wp.min(k, n_alpha - 1))]
        stretch[out] = wp.vec2d(real(2.0) * own * whole, l1 + share * (l2 - l1))
        total += own * w1 * share * (l2 - l1) * (l2 - l1)
        if q[2] >= 0:
            stiffness = real(2.0) * beta[place(s * n_beta, wp.min(hinge[place(k, 0)], n_beta - 1))]
            a1 = first[place(v, q[2])] - origin1
            b1 = first[place(v, q[3])] - origin1
            a2 = second[place(v, q[2])] - origin2
            b2 = second[place(v, q[3])] - origin2
            m1 = wp.cross(e1, a1)
            m2 = wp.cross(b1, e1)
            n1 = wp.cross(e2, a2)
            n2 = wp.cross(b2, e2)
            p1 = real(0.0)
            t1 = real(0.0)
            p2 = real(0.0)
            t2 = real(0.0)
            if not (is_flat(e1, m1) or is_flat(e1, m2)):
                p1 = stiffness * both[0] * bend_weight(e1, m1, m2)
                t1 = angle_of(e1, a1, b1, m1, m2)
            if not (is_flat(e2, n1) or is_flat(e2, n2)):
                p2 = stiffness * both[1] * bend_weight(e2, n1, n2)
                t2 = angle_of(e2, a2, b2, n1, n2)
            bend[out] = vec4(p1, t1, p2, t2)
        else:
            bend[out] = vec4()
    wp.atomic_add(constant, s, total)


# --------------------------------------------------------------------------------------------------- value, derivatives
@wp.kernel(enable_backward=False)
def value(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    n: int,
    n_references: int,
    centre: wp.array(dtype=vec3),
    capped_faces: wp.array(dtype=wp.vec3i),
    energy: wp.array(dtype=real),
    total: wp.array(dtype=real),
    threads: int,
):
    """The energy but for the volume's, and the volume; references come round where there are fewer than shapes."""
    i = wp.tid()
    s = i // threads
    v = s * n
    to = (s % n_references) * record.shape[0]
    found = real(0.0)
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(to, k)
        origin = x[place(v, q[0])]
        e = x[place(v, q[1])] - origin
        wanted = stretch[at]
        d = length_of(e) - wanted[1]
        found += wanted[0] * d * d
        if q[2] >= 0:
            a = x[place(v, q[2])] - origin
            b = x[place(v, q[3])] - origin
            n1 = wp.cross(e, a)
            n2 = wp.cross(b, e)
            theta = real(0.0)
            if not (is_flat(e, n1) or is_flat(e, n2)):
                theta = angle_of(e, a, b, n1, n2)
            w = bend[at]
            d1 = wrapped(theta - w[1])
            d2 = wrapped(theta - w[3])
            found += w[0] * d1 * d1 + w[2] * d2 * d2
    wp.atomic_add(energy, s, HALF * found)
    middle = middle_of(x, centre, capped_faces, s, v)
    enclosed = real(0.0)
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        face = capped_faces[place(k, 0)]
        c = corner(x, middle, v, face[2]) - middle
        enclosed += wp.dot(x[place(v, face[0])] - middle, wp.cross(x[place(v, face[1])] - middle, c))
    wp.atomic_add(total, s, enclosed / real(6.0))


@wp.func
def enclosed(
    x: wp.array(dtype=vec3),
    middle: vec3,
    q: wp.vec3i,
    at: int,
    gradient: wp.array(dtype=vec3),
):
    """Six times the volume of the tetrahedron from the middle, a vertex of -1, to a triangle.

    A sixth of its gradient, where the middle stays, is added.
    """
    a = x[place(at, q[0])] - middle
    b = x[place(at, q[1])] - middle
    c = corner(x, middle, at, q[2]) - middle
    bc = wp.cross(b, c)
    sixth = real(1.0) / real(6.0)
    wp.atomic_add(gradient, place(at, q[0]), sixth * bc)
    wp.atomic_add(gradient, place(at, q[1]), sixth * wp.cross(c, a))
    if q[2] >= 0:
        wp.atomic_add(gradient, place(at, q[2]), sixth * wp.cross(a, b))
    return wp.dot(a, bc)


@wp.kernel(enable_backward=False)
def volume(
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    capped_faces: wp.array(dtype=wp.vec3i),
    n: int,
    total: wp.array(dtype=real),
    gradient: wp.array(dtype=vec3),
    threads: int,
):
    """The volume and its gradient alone."""
    i = wp.tid()
    s = i // threads
    v = s * n
    middle = middle_of(x, centre, capped_faces, s, v)
    found = real(0.0)
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        found += enclosed(x, middle, capped_faces[place(k, 0)], v, gradient)
    wp.atomic_add(total, s, found / real(6.0))


@wp.kernel(enable_backward=False)
def linearise(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    centre: wp.array(dtype=vec3),
    capped_faces: wp.array(dtype=wp.vec3i),
    n: int,
    energy: wp.array(dtype=real),
    gradient: wp.array(dtype=vec3),
    diagonal: wp.array(dtype=symmetric),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
    total: wp.array(dtype=real),
    normal: wp.array(dtype=vec3),
    threads: int,
):
    """Energy, gradient, the 3 x 3 blocks of the convex Hessian's diagonal, and the factors of products with it.

    The volume and its gradient are separate outputs. Without arrays for the others, the kernel computes only these
    and the gradient.
    """
    i = wp.tid()
    s = i // threads
    v = s * n
    own = real(0.0)
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
        across = HALF * (slope + wp.sqrt(slope * slope + width * width + TINIEST)) / length
        along = wanted[0] - across
        pull = slope * unit
        own += slope * d
        wp.atomic_add(gradient, q0, -pull)
        wp.atomic_add(gradient, q1, pull)
        if diagonal:
            edges[at] = stretched(unit[0], unit[1], unit[2], across, along)
            block = along * squared(unit) + symmetric(across, real(0.0), real(0.0), across, real(0.0), across)
            wp.atomic_add(diagonal, q0, block)
            wp.atomic_add(diagonal, q1, block)
        found = bent()
        if q[2] >= 0:
            q2 = place(v, q[2])
            q3 = place(v, q[3])
            a = x[q2] - origin
            b = x[q3] - origin
            n1 = wp.cross(e, a)
            n2 = wp.cross(b, e)
            w = bend[at]
            if is_flat(e, n1) or is_flat(e, n2):
                d3 = wrapped(-w[1])
                d4 = wrapped(-w[3])
                own += w[0] * d3 * d3 + w[2] * d4 * d4
            else:
                theta = angle_of(e, a, b, n1, n2)
                d1 = wrapped(theta - w[1])
                d2 = wrapped(theta - w[3])
                moment = w[0] * d1 + w[2] * d2
                stiffness = w[0] + w[2]
                ga = (-length / wp.dot(n1, n1)) * n1
                gb = (-length / wp.dot(n2, n2)) * n2
                ge = (-per_length * per_length) * (wp.dot(a, e) * ga + wp.dot(b, e) * gb)
                gi = -(ga + gb + ge)
                found = bent(ge[0], ge[1], ge[2], ga[0], ga[1], ga[2], gb[0], gb[1], gb[2], stiffness)
                own += w[0] * d1 * d1 + w[2] * d2 * d2
                wp.atomic_add(gradient, q0, moment * gi)
                wp.atomic_add(gradient, q1, moment * ge)
                wp.atomic_add(gradient, q2, moment * ga)
                wp.atomic_add(gradient, q3, moment * gb)
                if diagonal:
                    wp.atomic_add(diagonal, q0, stiffness * squared(gi))
                    wp.atomic_add(diagonal, q1, stiffness * squared(ge))
                    wp.atomic_add(diagonal, q2, stiffness * squared(ga))
                    wp.atomic_add(diagonal, q3, stiffness * squared(gb))
        if diagonal:
            hinges[at] = found
    if energy:
        wp.atomic_add(energy, s, HALF * own)
    middle = middle_of(x, centre, capped_faces, s, v)
    sixfold = real(0.0)
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        sixfold += enclosed(x, middle, capped_faces[place(k, 0)], v, normal)
    wp.atomic_add(total, s, sixfold / real(6.0))


@wp.kernel(enable_backward=False)
def product(
    field: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
    n: int,
    out: wp.array(dtype=vec3),
    form: wp.array(dtype=real),
    threads: int,
):
    """The convex Hessian times a field, and the field times that, where there is an array for it."""
    i = wp.tid()
    s = i // threads
    v = s * n
    total = real(0.0)
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(s * record.shape[0], k)
        q0 = place(v, q[0])
        q1 = place(v, q[1])
        origin = field[q0]
        e = field[q1] - origin
        r = edges[at]
        unit = vec3(r[0], r[1], r[2])
        rate = wp.dot(unit, e)
        to_j = r[3] * e + (r[4] * rate) * unit
        total += wp.dot(to_j, e)
        if q[2] >= 0:
            q2 = place(v, q[2])
            q3 = place(v, q[3])
            h = hinges[at]
            ge = vec3(h[0], h[1], h[2])
            ga = vec3(h[3], h[4], h[5])
            gb = vec3(h[6], h[7], h[8])
            change = wp.dot(ge, e) + wp.dot(ga, field[q2] - origin) + wp.dot(gb, field[q3] - origin)
            moment = h[9] * change
            total += moment * change
            wp.atomic_add(out, q0, -moment * (ga + gb + ge) - to_j)
            wp.atomic_add(out, q1, moment * ge + to_j)
            wp.atomic_add(out, q2, moment * ga)
            wp.atomic_add(out, q3, moment * gb)
        else:
            wp.atomic_add(out, q0, -to_j)
            wp.atomic_add(out, q1, to_j)
    if form:
        wp.atomic_add(form, s, total)
