"""Eq. 5: its reference towards K rest shapes, value, gradient, convex Hessian, products with it."""

import warp as wp

from torch_modal.elastic.bend import MAX_BENDING_RATIO
from torch_modal.elastic.distortion import LARGEST_STRAIN, LARGEST_WEIGHT
from torch_modal.elastic.kernels.elements import (
    HALF,
    SIXTH,
    TINIEST,
    Elements,
    Hinge,
    angle_gradients,
    bend_energy,
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
    squared,
    symmetric,
    vec3,
    vec4,
)
from torch_modal.elastic.stretch import SLACK

SLACKNESS = wp.constant(real(SLACK))
RATIO = wp.constant(real(MAX_BENDING_RATIO))
STRAIN = wp.constant(real(LARGEST_STRAIN))
WEIGHT = wp.constant(real(LARGEST_WEIGHT))


# -------------------------------------------------------------------------------------------------------- rest shapes
@wp.kernel(enable_backward=False)
def sizes(
    mesh: Elements, x: wp.array(dtype=vec3), centre: wp.array(dtype=vec3), found: wp.array(dtype=vec3), threads: int
):
    """All edges together, the volume about the centre, and the surface, closed towards the centre."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    length = real(0.0)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        length += length_of(x[place(v, q[1])] - x[place(v, q[0])])
    middle = middle_of(mesh, x, centre, s)
    volume = real(0.0)
    area = real(0.0)
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        face = mesh.capped_faces[place(k, 0)]
        a = x[place(v, face[0])]
        normal = wp.cross(x[place(v, face[1])] - a, corner(x, middle, v, face[2]) - a)
        volume += SIXTH * wp.dot(a - middle, normal)
        area += HALF * length_of(normal)
    wp.atomic_add(found, s, vec3(length, volume, area))


@wp.func
def bend_weight(h: Hinge, largest: real):
    """Square of the edge over the area of both triangles, bounded."""
    base = wp.dot(h.e, h.e)
    area = HALF * (length_of(h.n1) + length_of(h.n2))
    return wp.min(base / area, largest)


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
    constant: wp.array(dtype=real),
    threads: int,
):
    """K rest shapes of each sample as one reference (Eq. 8), and the energy of the edges that remains."""
    i = wp.tid()
    s = i // threads
    left = real(0.0)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        # Sums of weights, and of those times the length and its square.
        edge = vec3()
        bend = moments()
        hard = real(2.0) * alpha[place(s * n_alpha, wp.min(k, n_alpha - 1))]
        stiff = real(0.0)
        if q[2] >= 0:
            stiff = real(2.0) * beta[place(s * n_beta, wp.min(mesh.hinge[place(k, 0)], n_beta - 1))]
        for r in range(s * n_shapes, (s + 1) * n_shapes):
            v = r * mesh.n_vertices
            pull = pulls[place(r, 0)]
            length = length_of(x[place(v, q[1])] - x[place(v, q[0])])
            if length > shortest[place(r, 0)]:
                own = pull * hard
                edge += own * vec3(real(1.0) / length, real(1.0), length)
            if q[2] >= 0:
                h = hinge_of(x, v, q)
                if not h.flat:
                    p = phase_of(h)
                    t = doubled(p)
                    bend += (pull * stiff * bend_weight(h, RATIO)) * moments(real(1.0), p[0], p[1], t[0], t[1])
        # Weights below zero may outweigh the others: then there is no minimum, and no weight.
        rest = real(0.0)
        if edge[0] > real(0.0):
            rest = edge[1] / edge[0]
            left += edge[2] - edge[1] * rest
        if bend[0] <= real(0.0):
            bend = moments()
        weight = wp.max(edge[0], real(0.0))
        out[place(s * mesh.record.shape[0], k)] = rested(weight, rest, bend[0], bend[1], bend[2], bend[3], bend[4])
    wp.atomic_add(constant, s, HALF * left)


# --------------------------------------------------------------------------------------------------------- the energy
@wp.func
def enclosed(x: wp.array(dtype=vec3), middle: vec3, q: wp.vec3i, at: int, gradient: wp.array(dtype=vec3)):
    """The volume of the tetrahedron from the middle, a vertex of -1, to a triangle.

    The gradient of all together, where the middle stays, is added where there is an array for it: the triangles around
    a vertex close, so that each gives a sixth of its normal to its corners.
    """
    a = x[place(at, q[0])]
    normal = SIXTH * wp.cross(x[place(at, q[1])] - a, corner(x, middle, at, q[2]) - a)
    if gradient:
        wp.atomic_add(gradient, place(at, q[0]), normal)
        wp.atomic_add(gradient, place(at, q[1]), normal)
        if q[2] >= 0:
            wp.atomic_add(gradient, place(at, q[2]), normal)
    return wp.dot(a - middle, normal)


@wp.kernel(enable_backward=False)
def volume(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    total: wp.array(dtype=wp.vec2d),
    normal: wp.array(dtype=vec3),
    threads: int,
):
    """The volume, the second of the totals, and its gradient, where there is an array for it."""
    i = wp.tid()
    s = i // threads
    middle = middle_of(mesh, x, centre, s)
    found = real(0.0)
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        found += enclosed(x, middle, mesh.capped_faces[place(k, 0)], s * mesh.n_vertices, normal)
    wp.atomic_add(total, s, wp.vec2d(real(0.0), found))


@wp.kernel(enable_backward=False)
def linearise(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    n_references: int,
    centre: wp.array(dtype=vec3),
    total: wp.array(dtype=wp.vec2d),
    gradient: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    diagonal: wp.array(dtype=symmetric),
    factors: wp.array(dtype=linearised),
    threads: int,
):
    """Energy but for the volume's, and volume; their gradients; blocks and factors of the convex Hessian.

    Derivatives without arrays are left out. References come round where there are fewer than shapes.
    """
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    own = real(0.0)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        w = rests[place((s % n_references) * mesh.record.shape[0], k)]
        q0 = place(v, q[0])
        q1 = place(v, q[1])
        e = x[q1] - x[q0]
        length = length_of(e)
        per_length = real(1.0) / length
        slope = w[0] * (length - w[1])
        own += slope * (length - w[1])
        unit = per_length * e
        ge = vec3()
        ga = vec3()
        gb = vec3()
        stiffness = real(0.0)
        moment = real(0.0)
        if q[2] >= 0:
            h = hinge_of(x, v, q)
            if h.flat:
                own += bend_energy(wp.vec2d(real(1.0), real(0.0)), w)
            else:
                p = phase_of(h)
                own += bend_energy(p, w)
                if gradient:
                    ge, ga, gb = angle_gradients(h)
                    stiffness = w[2]
                    moment = bend_slope(p, w)
                    wp.atomic_add(gradient, place(v, q[2]), moment * ga)
                    wp.atomic_add(gradient, place(v, q[3]), moment * gb)
                    if diagonal:
                        wp.atomic_add(diagonal, place(v, q[2]), stiffness * squared(ga))
                        wp.atomic_add(diagonal, place(v, q[3]), stiffness * squared(gb))
        gi = ge + ga + gb
        if gradient:
            wp.atomic_add(gradient, q0, -slope * unit - moment * gi)
            wp.atomic_add(gradient, q1, slope * unit + moment * ge)
        if diagonal:
            width = SLACKNESS * w[0] * length
            across = HALF * per_length * (slope + wp.sqrt(slope * slope + width * width + TINIEST))
            along = w[0] - across
            block = along * squared(unit) + symmetric(across, real(0.0), real(0.0), across, real(0.0), across)
            wp.atomic_add(diagonal, q0, block + stiffness * squared(gi))
            wp.atomic_add(diagonal, q1, block + stiffness * squared(ge))
            factors[place(s * mesh.record.shape[0], k)] = linearised(
                unit[0],
                unit[1],
                unit[2],
                across,
                along,
                ge[0],
                ge[1],
                ge[2],
                ga[0],
                ga[1],
                ga[2],
                gb[0],
                gb[1],
                gb[2],
                stiffness,
            )
    middle = middle_of(mesh, x, centre, s)
    inside = real(0.0)
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        inside += enclosed(x, middle, mesh.capped_faces[place(k, 0)], v, normal)
    wp.atomic_add(total, s, wp.vec2d(HALF * own, inside))


@wp.kernel(enable_backward=False)
def product(
    mesh: Elements,
    fields: wp.array(dtype=vec3),
    start: int,
    factors: wp.array(dtype=linearised),
    out: wp.array(dtype=vec3),
    out_start: int,
    scalars: wp.array(dtype=vec3),
    first: int,
    threads: int,
):
    """The convex Hessian times a field, and the field times that, the third of the scalars, where there are some.

    Fields, results and scalars begin at the given places of their arrays.
    """
    i = wp.tid()
    s = i // threads
    v = start + s * mesh.n_vertices
    to = out_start + s * mesh.n_vertices
    total = real(0.0)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        f = factors[place(s * mesh.record.shape[0], k)]
        q0 = place(to, q[0])
        q1 = place(to, q[1])
        origin = fields[place(v, q[0])]
        e = fields[place(v, q[1])] - origin
        unit = vec3(f[0], f[1], f[2])
        to_j = f[3] * e + (f[4] * wp.dot(unit, e)) * unit
        total += wp.dot(to_j, e)
        if q[2] >= 0:
            ge = vec3(f[5], f[6], f[7])
            ga = vec3(f[8], f[9], f[10])
            gb = vec3(f[11], f[12], f[13])
            change = wp.dot(ge, e) + wp.dot(ga, fields[place(v, q[2])] - origin)
            change += wp.dot(gb, fields[place(v, q[3])] - origin)
            moment = f[14] * change
            total += moment * change
            wp.atomic_add(out, q0, -moment * (ge + ga + gb) - to_j)
            wp.atomic_add(out, q1, moment * ge + to_j)
            wp.atomic_add(out, place(to, q[2]), moment * ga)
            wp.atomic_add(out, place(to, q[3]), moment * gb)
        else:
            wp.atomic_add(out, q0, -to_j)
            wp.atomic_add(out, q1, to_j)
    if scalars:
        wp.atomic_add(scalars, first + s, vec3(real(0.0), real(0.0), total))


# --------------------------------------------------------------------------------------------------------- distortion
@wp.func
def measured(x: wp.array(dtype=vec3), at: int, q: wp.vec4i):
    """Length, cosine and sine of the dihedral angle, and its bounded weight; 0 without a hinge."""
    found = vec4(length_of(x[place(at, q[1])] - x[place(at, q[0])]), real(1.0), real(0.0), real(0.0))
    if q[2] >= 0:
        h = hinge_of(x, at, q)
        if not h.flat:
            phase = phase_of(h)
            found = vec4(found[0], phase[0], phase[1], bend_weight(h, WEIGHT))
    return found


@wp.kernel(enable_backward=False)
def distortion(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    alpha: wp.array(dtype=real),
    beta: wp.array(dtype=real),
    n_shapes: int,
    n_samples: int,
    n_rests: int,
    n_alpha: int,
    n_beta: int,
    out: wp.array(dtype=wp.vec2d),
    threads: int,
):
    """Bounded stretching and bending of several shapes of each sample against its rest shapes."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        for r in range(s * n_rests, (s + 1) * n_rests):
            rest = measured(rests, r * mesh.n_vertices, q)
            stretching = weights[place(r, 0)] * alpha[place(s * n_alpha, wp.min(k, n_alpha - 1))]
            bending = real(0.0)
            if q[2] >= 0:
                bending = (
                    weights[place(r, 0)]
                    * rest[3]
                    * beta[place(s * n_beta, wp.min(mesh.hinge[place(k, 0)], n_beta - 1))]
                )
            for j in range(n_shapes):
                found = measured(x, (j * n_samples + s) * mesh.n_vertices, q)
                off = wp.abs(found[0] - rest[0])
                turn = wp.vec2d(found[1] - rest[1], found[2] - rest[2])
                versine = HALF * wp.dot(turn, turn)
                bent = bending * versine * (real(2.0) + versine / real(3.0))
                stretched = stretching * off * wp.min(off / rest[0], STRAIN)
                wp.atomic_add(out, place(j * n_samples, s), wp.vec2d(stretched, bent))
