"""References of Eq. 5: two rest shapes as one."""

import warp as wp

from torch_modal.backends.warp.kernels.elements import (
    HALF,
    corner,
    doubled,
    is_flat,
    length_of,
    middle_of,
    moments,
    phase_of,
    place,
    real,
    turn_between,
    vec3,
)
from torch_modal.energy.bend import MAX_BENDING_RATIO
from torch_modal.energy.stretch import MIN_RELATIVE_LENGTH
from torch_modal.energy.volume import MIN_RELATIVE_VOLUME

RATIO = wp.constant(real(MAX_BENDING_RATIO))
SHORT = wp.constant(real(MIN_RELATIVE_LENGTH))
THIN = wp.constant(real(MIN_RELATIVE_VOLUME))


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
    bend: wp.array(dtype=moments),
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
            t1 = wp.vec2d(real(1.0), real(0.0))
            p2 = real(0.0)
            t2 = wp.vec2d(real(1.0), real(0.0))
            if not (is_flat(e1, m1) or is_flat(e1, m2)):
                p1 = stiffness * both[0] * bend_weight(e1, m1, m2)
                t1 = phase_of(e1, b1, m1, m2)
            if not (is_flat(e2, n1) or is_flat(e2, n2)):
                p2 = stiffness * both[1] * bend_weight(e2, n1, n2)
                t2 = phase_of(e2, b2, n1, n2)
            part = real(0.0)
            if p1 + p2 > real(0.0):
                part = p2 / (p1 + p2)
            if part > HALF:  # from the heavier one, for the sake of rounding
                part = real(1.0) - part
                t0 = t1
                t1 = t2
                t2 = t0
            turn = turn_between(t1, t2)
            twice = doubled(turn)
            bend[out] = moments(p1 + p2, t1[0], t1[1], part * turn[0], part * turn[1], part * twice[0], part * twice[1])
        else:
            bend[out] = moments()
    wp.atomic_add(constant, s, total)
