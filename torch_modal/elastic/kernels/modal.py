"""Eq. 5 through the columns of a modal space: the Jacobian, and the second-order term."""

import warp as wp

from torch_modal.elastic.bend import LEAST_FULLNESS, NEEDLE, NEEDLE_OF_STEPS
from torch_modal.elastic.kernels.elements import (
    HALF,
    SIXTH,
    TINY,
    Elements,
    Hinge,
    angle_gradients,
    bend_beyond,
    bend_energy,
    bend_slope,
    corner,
    hinge_of,
    length_of,
    middle_of,
    phase_of,
    place,
    real,
    rested,
    vec3,
)

NEEDLES = wp.constant(real(NEEDLE**2))
NEEDLES_OF_STEPS = wp.constant(real(NEEDLE_OF_STEPS**2))
LEAST = wp.constant(real(LEAST_FULLNESS))
wide = wp.types.vector(length=8, dtype=real)
"""A row's entries of eight columns."""
three = wp.types.matrix(shape=(3, 8), dtype=real)
"""The three components of a vertex, or of an edge vector, along eight columns."""


@wp.func
def along_edge(columns: wp.array(dtype=wide), g: vec3, start: int, end: int, n_blocks: int, c: int):
    """Change of an edge vector along eight columns, projected on a vector."""
    y = c + n_blocks
    z = y + n_blocks
    return (
        g[0] * (columns[place(end, c)] - columns[place(start, c)])
        + g[1] * (columns[place(end, y)] - columns[place(start, y)])
        + g[2] * (columns[place(end, z)] - columns[place(start, z)])
    )


@wp.kernel(enable_backward=False)
def jacobian(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    columns: wp.array(dtype=wide),
    n_columns: int,
    n_blocks: int,
    n_rows: int,
    out: wp.array(dtype=wide),
    entries: wp.array(dtype=real),
    totals: wp.array(dtype=wp.vec2d),
    threads: int,
):
    """Change of each measure along the columns, and the measure's residual; all stiffnesses and energies together.

    All by the root of its weight. The residual comes in the column after the last. A component of a vertex has a row of
    blocks of eight columns; those of the measures are the same memory twice.
    """
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    total = real(0.0)
    energy = real(0.0)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        w = rests[place(s * mesh.record.shape[0], k)]
        o = 3 * n_blocks * q[0]
        j = 3 * n_blocks * q[1]
        row = s * n_rows + k
        e = x[place(v, q[1])] - x[place(v, q[0])]
        length = length_of(e)
        root = wp.sqrt(w[0])
        g = vec3()
        if wp.dot(e, e) > TINY:
            g = (root / length) * e
        for c in range(n_blocks):
            out[place(row * n_blocks, c)] = along_edge(columns, g, o, j, n_blocks, c)
        residual = root * (length - w[1])
        entries[place(row * n_blocks * 8, n_columns)] = residual
        total += w[0]
        energy += residual * residual
        if q[2] >= 0:
            row = s * n_rows + mesh.record.shape[0] + mesh.hinge[place(k, 0)]
            h = hinge_of(x, v, q)
            ge = vec3()
            ga = vec3()
            gb = vec3()
            off = real(0.0)
            stiff = real(0.0)
            phase = wp.vec2d(real(1.0), real(0.0))
            if not h.flat:
                phase = phase_of(h)
                stiff = wp.sqrt(w[2])
                ge, ga, gb = angle_gradients(h)
                if stiff > real(0.0):
                    off = bend_slope(phase, w) / stiff
                total += w[2]
            energy += bend_energy(phase, w)
            ge = stiff * ge
            ga = stiff * ga
            gb = stiff * gb
            for c in range(n_blocks):
                out[place(row * n_blocks, c)] = (
                    along_edge(columns, ge, o, j, n_blocks, c)
                    + along_edge(columns, ga, o, 3 * n_blocks * q[2], n_blocks, c)
                    + along_edge(columns, gb, o, 3 * n_blocks * q[3], n_blocks, c)
                )
            entries[place(row * n_blocks * 8, n_columns)] = off
    wp.atomic_add(totals, s, wp.vec2d(total, HALF * energy))


@wp.func
def fullness(e: vec3, tip: vec3, normal: vec3, needles: real):
    """bend.fullness of one triangle."""
    longest = wp.max(wp.dot(e, e), wp.max(wp.dot(tip, tip), wp.dot(tip - e, tip - e)))
    squared = wp.dot(normal, normal)
    found = real(0.0)
    if longest > real(0.0):
        found = squared / (squared + needles * longest * longest)
    return found


@wp.func
def fullness_of(h: Hinge, needles: real):
    return fullness(h.e, h.a, h.n1, needles) * fullness(h.e, h.b, h.n2, needles)


@wp.func
def usual_fullness(
    mesh: Elements, shapes: wp.array(dtype=vec3), pulls: wp.array(dtype=real), s: int, n_shapes: int, q: wp.vec4i
):
    """Fullness at rest, the weighted mean, with a lower bound."""
    usual = real(0.0)
    for r in range(s * n_shapes, (s + 1) * n_shapes):
        usual += pulls[place(r, 0)] * fullness_of(hinge_of(shapes, r * mesh.n_vertices, q), NEEDLES_OF_STEPS)
    return wp.max(usual, LEAST)


@wp.kernel(enable_backward=False)
def soften(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    shapes: wp.array(dtype=vec3),
    pulls: wp.array(dtype=real),
    n_shapes: int,
    out: wp.array(dtype=rested),
    threads: int,
):
    """References with less bending stiffness at the needles of shapes: bend.softening."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        at = place(s * mesh.record.shape[0], k)
        w = rests[at]
        if q[2] >= 0:
            h = hinge_of(x, v, q)
            f = real(0.0)
            if n_shapes == 0:
                f = fullness_of(h, NEEDLES)
            else:
                f = wp.min(
                    fullness_of(h, NEEDLES_OF_STEPS) / usual_fullness(mesh, shapes, pulls, s, n_shapes, q), real(1.0)
                )
                f = f * f * (real(3.0) - real(2.0) * f)
            w = rested(w[0], w[1], f * w[2], f * w[3], f * w[4], f * w[5], f * w[6])
        out[at] = w


@wp.func
def of_vertex(columns: wp.array(dtype=wide), v: int, n_blocks: int, c: int):
    at = place(3 * n_blocks * v, c)
    return wp.matrix_from_rows(columns[at], columns[place(at, n_blocks)], columns[place(at, 2 * n_blocks)])


@wp.func
def add(out: wp.array(dtype=wide), v: int, n_blocks: int, c: int, value: three):
    at = place(3 * n_blocks * v, c)
    for r in range(3):
        wp.atomic_add(out, place(at, r * n_blocks), value[r])


@wp.func
def half_of_hinge(e: vec3, tip: vec3, normal: vec3, w: vec3, length: real):
    """One triangle's part of the dihedral angle's Hessian: bend.dihedral_hessian."""
    area = wp.dot(normal, normal)
    half = wp.outer((length / (area * area)) * normal, w)
    s = half + wp.transpose(half)
    u = wp.outer(e, normal / (length * area))
    r = wp.dot(tip, e) / (length * length)
    base = length * length
    own = (r * r + HALF * area / (base * base)) * s - r * (u + wp.transpose(u))
    return own, u - r * s, s


@wp.kernel(enable_backward=False)
def curved_columns(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    centre: wp.array(dtype=vec3),
    moment: wp.array(dtype=real),
    columns: wp.array(dtype=wide),
    n_blocks: int,
    out: wp.array(dtype=wide),
    threads: int,
):
    """The second-order term on all columns: modal_energy._second_order. The moment is the volume's."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    to = s * (mesh.n_vertices + 1)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        w = rests[place(s * mesh.record.shape[0], k)]
        e = x[place(v, q[1])] - x[place(v, q[0])]
        length = length_of(e)
        ee = wp.mat33d()
        if wp.dot(e, e) > TINY:
            unit = e / length
            ee = (w[0] * (length - w[1]) / length) * (wp.identity(3, dtype=real) - wp.outer(unit, unit))
        bent = q[2] >= 0
        ab = wp.mat33d()
        ae = wp.mat33d()
        aa = wp.mat33d()
        be = wp.mat33d()
        bb = wp.mat33d()
        if bent:
            h = hinge_of(x, v, q)
            bent = not h.flat
            if bent:
                phase = phase_of(h)
                slope = bend_slope(phase, w)
                beyond = bend_beyond(phase, w)
                ge, ga, gb = angle_gradients(h)
                own1, ae, aa = half_of_hinge(e, h.a, h.n1, wp.cross(h.n1, e), length)
                own2, be, bb = half_of_hinge(e, h.b, h.n2, wp.cross(e, h.n2), length)
                ee += slope * (own1 + own2) + wp.outer(beyond * ge, ge)
                ae = slope * ae + wp.outer(beyond * ga, ge)
                aa = slope * aa + wp.outer(beyond * ga, ga)
                be = slope * be + wp.outer(beyond * gb, ge)
                bb = slope * bb + wp.outer(beyond * gb, gb)
                ab = wp.outer(beyond * ga, gb)
        ea = wp.transpose(ae)
        eb = wp.transpose(be)
        ba = wp.transpose(ab)
        for c in range(n_blocks):
            origin = of_vertex(columns, q[0], n_blocks, c)
            de = of_vertex(columns, q[1], n_blocks, c) - origin
            to_e = ee * de
            whole = to_e
            if bent:
                da = of_vertex(columns, q[2], n_blocks, c) - origin
                db = of_vertex(columns, q[3], n_blocks, c) - origin
                to_a = ae * de + aa * da + ab * db
                to_b = be * de + ba * da + bb * db
                to_e += ea * da + eb * db
                add(out, to + q[2], n_blocks, c, to_a)
                add(out, to + q[3], n_blocks, c, to_b)
                whole = to_e + to_a + to_b
            add(out, to + q[1], n_blocks, c, to_e)
            add(out, to + q[0], n_blocks, c, -whole)
    middle = middle_of(mesh, x, centre, s)
    sixth = SIXTH * moment[s]
    n = mesh.n_vertices  # the row of the centre
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        face = mesh.capped_faces[place(k, 0)]
        last = face[2]
        if last < 0:
            last = n
        of_p = wp.skew(sixth * (x[place(v, face[0])] - middle))
        of_q = wp.skew(sixth * (x[place(v, face[1])] - middle))
        of_r = wp.skew(sixth * (corner(x, middle, v, face[2]) - middle))
        for c in range(n_blocks):
            origin = of_vertex(columns, n, n_blocks, c)
            dp = of_vertex(columns, face[0], n_blocks, c) - origin
            dq = of_vertex(columns, face[1], n_blocks, c) - origin
            dr = of_vertex(columns, last, n_blocks, c) - origin
            to_p = of_q * dr - of_r * dq
            to_q = of_r * dp - of_p * dr
            to_r = of_p * dq - of_q * dp
            add(out, to + face[0], n_blocks, c, to_p)
            add(out, to + face[1], n_blocks, c, to_q)
            add(out, to + last, n_blocks, c, to_r)
            add(out, to + n, n_blocks, c, -(to_p + to_q + to_r))
