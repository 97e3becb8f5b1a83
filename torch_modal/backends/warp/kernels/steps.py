"""Conjugate gradients for the steps of all vertices, preconditioned by the vertices' blocks, and the way back.

The scalars of an iteration are the inner product of its residual, the volume that its direction sweeps, and the inner
product of the direction with the Hessian's product but for the volume's part. Backwards, what ``q = H p``,
``d = p . q``, ``l = s / d``, ``x += l p``, ``r -= l q``, ``s = r . M r``, ``p = M r + (s / s_old) p`` receive is found
in the opposite order; for each product with ``H`` there is one more, with a field.
"""

import warp as wp

from torch_modal.backends.torch import fine_steps as relax
from torch_modal.backends.warp.kernels.elements import Mesh, applied, linearised, place, real, symmetric, vec3

RIDGE = wp.constant(real(relax.RIDGE))


@wp.func
def inverted(m: symmetric):
    trace = m[0] + m[3] + m[5]
    if trace <= real(0.0):
        trace = real(1.0)
    a = m[0] / trace + RIDGE
    d = m[3] / trace + RIDGE
    f = m[5] / trace + RIDGE
    b = m[1] / trace
    c = m[2] / trace
    e = m[4] / trace
    aa = d * f - e * e
    bb = c * e - b * f
    cc = b * e - c * d
    per = real(1.0) / ((a * aa + b * bb + c * cc) * trace)
    return symmetric(per * aa, per * bb, per * cc, per * (a * f - c * c), per * (b * c - a * e), per * (a * d - b * b))


@wp.func
def quotient(a: real, b: real):
    # A sample that is solved exactly has nothing left: 0 / 0.
    found = real(0.0)
    if b > real(0.0):
        found = a / b
    return found


@wp.func
def form_of(own: vec3, stiffness: real):
    """The inner product of a direction with its product, with the volume's part."""
    return own[2] + stiffness * own[1] * own[1]


@wp.kernel(enable_backward=False)
def begin(
    gradient: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    moment: wp.array(dtype=real),
    diagonal: wp.array(dtype=symmetric),
    n: int,
    residual: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    solution: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    scalars: wp.array(dtype=vec3),
    threads: int,
):
    i = wp.tid()
    s = i // threads
    push = moment[s]
    found = vec3()
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        r = -(gradient[v] + push * normal[v])
        inverse = inverted(diagonal[v])
        z = applied(inverse, r)
        diagonal[v] = inverse
        residual[v] = r
        direction[v] = z
        solution[v] = vec3()
        product[v] = vec3()
        found += vec3(wp.dot(r, z), wp.dot(normal[v], z), real(0.0))
    wp.atomic_add(scalars, s, found)


@wp.kernel(enable_backward=False)
def advance(
    direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    stiffness: wp.array(dtype=real),
    scalars: wp.array(dtype=vec3),
    n: int,
    residual: wp.array(dtype=vec3),
    solution: wp.array(dtype=vec3),
    next_residual: wp.array(dtype=vec3),
    next_scalars: wp.array(dtype=vec3),
    threads: int,
):
    """The solution after a direction, and the residual there, where there is an array for it."""
    i = wp.tid()
    s = i // threads
    push = stiffness[s] * scalars[s][1]
    step = quotient(scalars[s][0], form_of(scalars[s], stiffness[s]))
    size = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        solution[v] = solution[v] + step * direction[v]
        if next_residual:
            r = residual[v] - step * (product[v] + push * normal[v])
            next_residual[v] = r
            size += wp.dot(r, applied(inverse[v], r))
    if next_residual:
        wp.atomic_add(next_scalars, s, vec3(size, real(0.0), real(0.0)))


@wp.kernel(enable_backward=False)
def turn(
    residual: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    normal: wp.array(dtype=vec3),
    scalars: wp.array(dtype=vec3),
    n: int,
    direction: wp.array(dtype=vec3),
    next_scalars: wp.array(dtype=vec3),
    next_direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    threads: int,
):
    """The next direction; its product is set to zero."""
    i = wp.tid()
    s = i // threads
    ratio = quotient(next_scalars[s][0], scalars[s][0])
    swept = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        d = applied(inverse[v], residual[v]) + ratio * direction[v]
        next_direction[v] = d
        product[v] = vec3()
        swept += wp.dot(normal[v], d)
    wp.atomic_add(next_scalars, s, vec3(real(0.0), swept, real(0.0)))


# ----------------------------------------------------------------------------------------------------- and back again
@wp.kernel(enable_backward=False)
def inner(a: wp.array(dtype=vec3), b: wp.array(dtype=vec3), n: int, found: wp.array(dtype=vec3), threads: int):
    """Inner product of two fields, added to the first of three numbers."""
    i = wp.tid()
    s = i // threads
    total = real(0.0)
    for k in range(i - s * threads, n, threads):
        total += wp.dot(a[place(s * n, k)], b[place(s * n, k)])
    wp.atomic_add(found, s, vec3(total, real(0.0), real(0.0)))


@wp.kernel(enable_backward=False)
def back_to_direction(
    to_solution: wp.array(dtype=vec3),
    to_residual: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    scalars: wp.array(dtype=vec3),
    next_scalars: wp.array(dtype=vec3),
    n: int,
    field: wp.array(dtype=vec3),
    to_direction: wp.array(dtype=vec3),
    received: wp.array(dtype=vec3),
    threads: int,
):
    """Gradient of a direction except through the Hessian, and the field to which the Hessian is applied for the rest.

    Where there are no next scalars, there is no next direction either. What the length of the step, the ratio to the
    previous direction and the swept volume receive are three numbers of each iteration.
    """
    i = wp.tid()
    s = i // threads
    push = stiffness[s] * scalars[s][1]
    form = form_of(scalars[s], stiffness[s])
    step = quotient(scalars[s][0], form)
    to_form = -step * quotient(received[s][0], form)
    ratio = real(0.0)
    if next_scalars:
        ratio = quotient(next_scalars[s][0], scalars[s][0])
    swept = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found = step * to_solution[v] + to_form * (product[v] + push * normal[v])
        f = to_form * direction[v]
        if next_scalars:
            found += ratio * to_direction[v]
            f -= step * to_residual[v]
        field[v] = f
        to_direction[v] = found
        swept += wp.dot(normal[v], f)
    wp.atomic_add(received, s, vec3(real(0.0), real(0.0), swept))


@wp.kernel(enable_backward=False)
def back_to_normal(
    direction: wp.array(dtype=vec3),
    previous: wp.array(dtype=vec3),
    field: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    scalars: wp.array(dtype=vec3),
    received: wp.array(dtype=vec3),
    n: int,
    to_direction: wp.array(dtype=vec3),
    to_normal: wp.array(dtype=vec3),
    threads: int,
):
    """The volume's part of the Hessian, and the gradient of the ratio to the previous direction, if any."""
    i = wp.tid()
    s = i // threads
    across = stiffness[s] * scalars[s][1]
    to_across = stiffness[s] * received[s][2]
    along = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found = to_direction[v] + to_across * normal[v]
        to_direction[v] = found
        to_normal[v] = to_normal[v] + across * field[v] + to_across * direction[v]
        if previous:
            along += wp.dot(found, previous[v])
    wp.atomic_add(received, s, vec3(real(0.0), along, real(0.0)))


@wp.kernel(enable_backward=False)
def back_to_residual(
    to_solution: wp.array(dtype=vec3),
    to_direction: wp.array(dtype=vec3),
    residual: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    previous: wp.array(dtype=vec3),
    previous_product: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    previous_scalars: wp.array(dtype=vec3),
    scalars: wp.array(dtype=vec3),
    next_scalars: wp.array(dtype=vec3),
    received: wp.array(dtype=vec3),
    next_received: wp.array(dtype=vec3),
    n: int,
    to_residual: wp.array(dtype=vec3),
    to_diagonal: wp.array(dtype=symmetric),
    previous_received: wp.array(dtype=vec3),
    threads: int,
):
    """Gradients of a residual, of the preconditioner, and of the previous step length, if any."""
    i = wp.tid()
    s = i // threads
    to_size = quotient(received[s][0], form_of(scalars[s], stiffness[s]))
    push = real(0.0)
    if previous:
        to_size += quotient(received[s][1], previous_scalars[s][0])
        push = stiffness[s] * previous_scalars[s][1]
    if next_scalars:
        size = scalars[s][0]
        to_size -= quotient(next_received[s][1], size) * quotient(next_scalars[s][0], size)
    along = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        m = inverse[v]
        z = applied(m, residual[v])
        w = applied(m, to_direction[v])
        u = w + to_size * z
        found = to_residual[v] + u + to_size * z
        to_residual[v] = found
        ridge = RIDGE * wp.dot(u, z)
        to_diagonal[v] = to_diagonal[v] - symmetric(
            u[0] * z[0] + ridge,
            u[0] * z[1] + u[1] * z[0],
            u[0] * z[2] + u[2] * z[0],
            u[1] * z[1] + ridge,
            u[1] * z[2] + u[2] * z[1],
            u[2] * z[2] + ridge,
        )
        if previous:
            along += wp.dot(to_solution[v], previous[v]) - wp.dot(found, previous_product[v] + push * normal[v])
    if previous:
        wp.atomic_add(previous_received, s, vec3(along, real(0.0), real(0.0)))


@wp.kernel(enable_backward=False)
def back_to_factors(
    mesh: Mesh,
    directions: wp.array(dtype=vec3),
    fields: wp.array(dtype=vec3),
    factors: wp.array(dtype=linearised),
    n_samples: int,
    n_products: int,
    to_factors: wp.array(dtype=linearised),
    threads: int,
):
    """Gradients of the Hessian's factors from ``field . H direction``, summed over several products."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        at = place(s * mesh.record.shape[0], k)
        h = factors[at]
        unit = vec3(h[0], h[1], h[2])
        ge = vec3(h[5], h[6], h[7])
        ga = vec3(h[8], h[9], h[10])
        gb = vec3(h[11], h[12], h[13])
        to_unit = vec3()
        to_across = real(0.0)
        to_along = real(0.0)
        to_e = vec3()
        to_a = vec3()
        to_b = vec3()
        to_stiffness = real(0.0)
        for m in range(n_products):
            v = (m * n_samples + s) * mesh.n_vertices
            q0 = place(v, q[0])
            q1 = place(v, q[1])
            origin = directions[q0]
            start = fields[q0]
            e = directions[q1] - origin
            f = fields[q1] - start
            rate = wp.dot(unit, e)
            rate_f = wp.dot(unit, f)
            to_unit += rate_f * e + rate * f
            to_across += wp.dot(e, f)
            to_along += rate * rate_f
            if q[2] >= 0:
                q2 = place(v, q[2])
                q3 = place(v, q[3])
                a = directions[q2] - origin
                b = directions[q3] - origin
                fa = fields[q2] - start
                fb = fields[q3] - start
                change = wp.dot(ge, e) + wp.dot(ga, a) + wp.dot(gb, b)
                change_f = wp.dot(ge, f) + wp.dot(ga, fa) + wp.dot(gb, fb)
                to_e += change_f * e + change * f
                to_a += change_f * a + change * fa
                to_b += change_f * b + change * fb
                to_stiffness += change * change_f
        to_unit = h[4] * to_unit
        w = h[14]
        to_factors[at] = linearised(
            to_unit[0],
            to_unit[1],
            to_unit[2],
            to_across,
            to_along,
            w * to_e[0],
            w * to_e[1],
            w * to_e[2],
            w * to_a[0],
            w * to_a[1],
            w * to_a[2],
            w * to_b[0],
            w * to_b[1],
            w * to_b[2],
            to_stiffness,
        )
