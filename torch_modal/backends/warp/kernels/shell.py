"""Eq. 5 towards a reference: value, gradient, convex Hessian, products with it."""

import warp as wp

from torch_modal.backends.warp.kernels.elements import (
    HALF,
    TINIEST,
    TINY,
    bend_energy,
    bend_slope,
    bent,
    corner,
    is_flat,
    length_of,
    middle_of,
    moments,
    phase_of,
    place,
    real,
    squared,
    stretched,
    symmetric,
    vec3,
)
from torch_modal.energy.stretch import SLACK

SLACKNESS = wp.constant(real(SLACK))


@wp.kernel(enable_backward=False)
def value(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=moments),
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
            phase = wp.vec2d(real(1.0), real(0.0))
            if not (is_flat(e, n1) or is_flat(e, n2)):
                phase = phase_of(e, b, n1, n2)
            found += bend_energy(phase, bend[at])
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
    bend: wp.array(dtype=moments),
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
                own += bend_energy(wp.vec2d(real(1.0), real(0.0)), w)
            else:
                phase = phase_of(e, b, n1, n2)
                moment = bend_slope(phase, w)
                stiffness = w[0]
                ga = (-length / wp.dot(n1, n1)) * n1
                gb = (-length / wp.dot(n2, n2)) * n2
                ge = (-per_length * per_length) * (wp.dot(a, e) * ga + wp.dot(b, e) * gb)
                gi = -(ga + gb + ge)
                found = bent(ge[0], ge[1], ge[2], ga[0], ga[1], ga[2], gb[0], gb[1], gb[2], stiffness)
                own += bend_energy(phase, w)
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
