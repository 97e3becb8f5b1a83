"""Back through the conjugate gradients of :mod:`.steps`, from the last iteration to the first.

What ``q = H p``, ``d = p . q``, ``l = s / d``, ``x += l p``, ``r -= l q``, ``s = r . M r``, ``p = M r + (s / s_old) p``
receive is found in the opposite order; for each product with ``H`` there is one more, with a field.
"""

import warp as wp

from torch_modal.backends.warp.kernels.elements import applied, bent, place, real, stretched, symmetric, vec3
from torch_modal.backends.warp.kernels.steps import RIDGE, quotient


@wp.kernel(enable_backward=False)
def back_to_length(
    to_solution: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    n: int,
    to_length: wp.array(dtype=real),
    threads: int,
):
    """Gradient of the last iteration's step length."""
    i = wp.tid()
    s = i // threads
    found = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found += wp.dot(to_solution[v], direction[v])
    wp.atomic_add(to_length, s, found)


@wp.kernel(enable_backward=False)
def back_to_direction(
    to_solution: wp.array(dtype=vec3),
    to_residual: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    size: wp.array(dtype=real),
    form: wp.array(dtype=real),
    next_size: wp.array(dtype=real),
    to_length: wp.array(dtype=real),
    n: int,
    field: wp.array(dtype=vec3),
    to_direction: wp.array(dtype=vec3),
    to_swept: wp.array(dtype=real),
    threads: int,
):
    """Gradient of a direction except through the Hessian, and the field to which the Hessian is applied for the rest.

    Where there is no next size, there is no next direction either.
    """
    i = wp.tid()
    s = i // threads
    push = stiffness[s] * swept[s]
    form_there = form[s] + push * swept[s]
    step = quotient(size[s], form_there)
    to_form = -step * quotient(to_length[s], form_there)
    ratio = real(0.0)
    if next_size:
        ratio = quotient(next_size[s], size[s])
    across = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found = step * to_solution[v] + to_form * (product[v] + push * normal[v])
        f = to_form * direction[v]
        if next_size:
            found += ratio * to_direction[v]
            f -= step * to_residual[v]
        field[v] = f
        to_direction[v] = found
        across += wp.dot(normal[v], f)
    wp.atomic_add(to_swept, s, across)


@wp.kernel(enable_backward=False)
def back_to_normal(
    direction: wp.array(dtype=vec3),
    previous: wp.array(dtype=vec3),
    field: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    to_swept: wp.array(dtype=real),
    n: int,
    to_direction: wp.array(dtype=vec3),
    to_normal: wp.array(dtype=vec3),
    to_ratio: wp.array(dtype=real),
    threads: int,
):
    """The volume's part of the Hessian, and the gradient of the ratio to the previous direction, if any."""
    i = wp.tid()
    s = i // threads
    across = stiffness[s] * swept[s]
    to_across = stiffness[s] * to_swept[s]
    along = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found = to_direction[v] + to_across * normal[v]
        to_direction[v] = found
        to_normal[v] = to_normal[v] + across * field[v] + to_across * direction[v]
        if previous:
            along += wp.dot(found, previous[v])
    if previous:
        wp.atomic_add(to_ratio, s, along)


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
    previous_swept: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    previous_size: wp.array(dtype=real),
    size: wp.array(dtype=real),
    next_size: wp.array(dtype=real),
    form: wp.array(dtype=real),
    to_length: wp.array(dtype=real),
    to_ratio: wp.array(dtype=real),
    to_next_ratio: wp.array(dtype=real),
    n: int,
    to_residual: wp.array(dtype=vec3),
    to_diagonal: wp.array(dtype=symmetric),
    to_previous_length: wp.array(dtype=real),
    threads: int,
):
    """Gradients of a residual, of the preconditioner, and of the previous step length, if any."""
    i = wp.tid()
    s = i // threads
    to_size = quotient(to_length[s], form[s] + stiffness[s] * swept[s] * swept[s])
    push = real(0.0)
    if previous:
        to_size += quotient(to_ratio[s], previous_size[s])
        push = stiffness[s] * previous_swept[s]
    if next_size:
        to_size -= quotient(to_next_ratio[s], size[s]) * quotient(next_size[s], size[s])
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
        wp.atomic_add(to_previous_length, s, along)


@wp.kernel(enable_backward=False)
def back_to_elements(
    directions: wp.array(dtype=vec3),
    fields: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
    n: int,
    n_samples: int,
    n_products: int,
    to_edges: wp.array(dtype=stretched),
    to_hinges: wp.array(dtype=bent),
    threads: int,
):
    """Gradients of the Hessian's elements from ``field . H direction``, summed over several products."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(s * record.shape[0], k)
        r = edges[at]
        unit = vec3(r[0], r[1], r[2])
        to_unit = vec3()
        to_across = real(0.0)
        to_along = real(0.0)
        h = hinges[at]
        ge = vec3(h[0], h[1], h[2])
        ga = vec3(h[3], h[4], h[5])
        gb = vec3(h[6], h[7], h[8])
        to_e = vec3()
        to_a = vec3()
        to_b = vec3()
        to_stiffness = real(0.0)
        for m in range(n_products):
            v = (m * n_samples + s) * n
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
        to_unit = r[4] * to_unit
        to_edges[at] = stretched(to_unit[0], to_unit[1], to_unit[2], to_across, to_along)
        w = h[9]
        to_hinges[at] = bent(
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
