"""Conjugate gradients for the steps of all vertices, preconditioned by the vertices' blocks, and the way back.

The scalars of an iteration are the inner product of its residual, the volume that its direction sweeps, and the inner
product of the direction with the Hessian's product but for the volume's part. Backwards, what ``q = H p``,
``d = p . q``, ``l = s / d``, ``x += l p``, ``r -= l q``, ``s = r . M r``, ``p = M r + (s / s_old) p`` receive is found
in the opposite order; for each product with ``H`` there is one more, with a field.
"""

import warp as wp

from torch_modal.elastic import steps as relax
from torch_modal.elastic.kernels.types import multiply, place, real, symmetric, vec3

RIDGE = wp.constant(real(relax.RIDGE))


@wp.func
def invert(m: symmetric):
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
    result = real(0.0)
    if b > real(0.0):
        result = a / b
    return result


@wp.func
def form_of(sums: vec3, stiffness: real):
    """The inner product of a direction with its product, with the volume's part."""
    return sums[2] + stiffness * sums[1] * sums[1]


@wp.func
def row(kind: int, k: int, n_kept: int, n_samples: int, s: int, n: int):
    """Start of a sample's residual (0), direction (1) or product (2) of an iteration; all share one if one is kept."""
    return ((kind * n_kept + k % n_kept) * n_samples + s) * n


@wp.kernel(enable_backward=False)
def begin(
    gradient: wp.array[vec3], normal: wp.array[vec3], moment: wp.array[real], diagonal: wp.array[symmetric],
    n_kept: int, n: int, fields: wp.array[vec3], scalars: wp.array[vec3], solution: wp.array[vec3], threads: int,
):  # fmt: skip
    """The first residual and direction. The diagonal is inverted in place."""
    i = wp.tid()
    s = i // threads
    n_samples = moment.shape[0]
    residual = row(0, 0, n_kept, n_samples, s, n)
    direction = row(1, 0, n_kept, n_samples, s, n)
    product = row(2, 0, n_kept, n_samples, s, n)
    push = moment[s]
    products = vec3()
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        r = -(gradient[v] + push * normal[v])
        inverse = invert(diagonal[v])
        z = multiply(inverse, r)
        diagonal[v] = inverse
        fields[place(residual, k)] = r
        fields[place(direction, k)] = z
        fields[place(product, k)] = vec3()
        solution[v] = vec3()
        products += vec3(wp.dot(r, z), wp.dot(normal[v], z), real(0.0))
    wp.atomic_add(scalars, s, products)


@wp.kernel(enable_backward=False)
def advance(
    normal: wp.array[vec3], inverse: wp.array[symmetric], stiffness: wp.array[real], m: int, n_kept: int, n: int,
    fields: wp.array[vec3], scalars: wp.array[vec3], solution: wp.array[vec3], threads: int,
):  # fmt: skip
    """The solution after a direction, and the residual there."""
    i = wp.tid()
    s = i // threads
    n_samples = stiffness.shape[0]
    residual = row(0, m, n_kept, n_samples, s, n)
    direction = row(1, m, n_kept, n_samples, s, n)
    product = row(2, m, n_kept, n_samples, s, n)
    following = row(0, m + 1, n_kept, n_samples, s, n)
    sums = scalars[m * n_samples + s]
    push = stiffness[s] * sums[1]
    step = quotient(sums[0], form_of(sums, stiffness[s]))
    size = real(0.0)
    last = (m + 2) * n_samples == scalars.shape[0]
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        solution[v] = solution[v] + step * fields[place(direction, k)]
        if not last:
            r = fields[place(residual, k)] - step * (fields[place(product, k)] + push * normal[v])
            fields[place(following, k)] = r
            size += wp.dot(r, multiply(inverse[v], r))
    wp.atomic_add(scalars, (m + 1) * n_samples + s, vec3(size, real(0.0), real(0.0)))


@wp.kernel(enable_backward=False)
def turn(
    normal: wp.array[vec3], inverse: wp.array[symmetric], n_samples: int, m: int, n_kept: int, n: int,
    fields: wp.array[vec3], scalars: wp.array[vec3], threads: int,
):  # fmt: skip
    """The next direction; its product is set to zero."""
    i = wp.tid()
    s = i // threads
    residual = row(0, m + 1, n_kept, n_samples, s, n)
    direction = row(1, m, n_kept, n_samples, s, n)
    following = row(1, m + 1, n_kept, n_samples, s, n)
    product = row(2, m + 1, n_kept, n_samples, s, n)
    to = (m + 1) * n_samples + s
    ratio = quotient(scalars[to][0], scalars[m * n_samples + s][0])
    swept = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        d = multiply(inverse[v], fields[place(residual, k)]) + ratio * fields[place(direction, k)]
        fields[place(following, k)] = d
        fields[place(product, k)] = vec3()
        swept += wp.dot(normal[v], d)
    wp.atomic_add(scalars, to, vec3(real(0.0), swept, real(0.0)))


# ----------------------------------------------------------------------------------------------------- and back again
@wp.kernel(enable_backward=False)
def back_to_direction(
    normal: wp.array[vec3], stiffness: wp.array[real], m: int, n_products: int, n: int, fields: wp.array[vec3],
    scalars: wp.array[vec3], to_solution: wp.array[vec3], to_residual: wp.array[vec3], pushed: wp.array[vec3],
    to_direction: wp.array[vec3], received: wp.array[vec3], threads: int,
):  # fmt: skip
    """Gradient of a direction except through the Hessian, and the field that the Hessian is applied to for the rest.

    After the last direction there is no next one. What the length of the step, the ratio to the previous direction and
    the swept volume receive are three numbers of each iteration.
    """
    i = wp.tid()
    s = i // threads
    n_samples = stiffness.shape[0]
    at = m * n_samples + s
    direction = row(1, m, n_products, n_samples, s, n)
    product = row(2, m, n_products, n_samples, s, n)
    push = stiffness[s] * scalars[at][1]
    form = form_of(scalars[at], stiffness[s])
    step = quotient(scalars[at][0], form)
    to_form = -step * quotient(received[at][0], form)
    ratio = real(0.0)
    if m + 1 < n_products:
        ratio = quotient(scalars[at + n_samples][0], scalars[at][0])
    swept = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        direction_gradient = step * to_solution[v] + to_form * (fields[place(product, k)] + push * normal[v])
        f = to_form * fields[place(direction, k)]
        if m + 1 < n_products:
            direction_gradient += ratio * to_direction[v]
            f -= step * to_residual[v]
        pushed[place(at * n, k)] = f
        to_direction[v] = direction_gradient
        swept += wp.dot(normal[v], f)
    wp.atomic_add(received, at, vec3(real(0.0), real(0.0), swept))


@wp.kernel(enable_backward=False)
def back_to_normal(
    normal: wp.array[vec3], stiffness: wp.array[real], m: int, n_products: int, n: int, fields: wp.array[vec3],
    scalars: wp.array[vec3], pushed: wp.array[vec3], to_direction: wp.array[vec3], to_normal: wp.array[vec3],
    received: wp.array[vec3], threads: int,
):  # fmt: skip
    """The volume's part of the Hessian, and the gradient of the ratio to the previous direction, if any."""
    i = wp.tid()
    s = i // threads
    n_samples = stiffness.shape[0]
    at = m * n_samples + s
    direction = row(1, m, n_products, n_samples, s, n)
    previous = row(1, wp.max(m - 1, 0), n_products, n_samples, s, n)
    across = stiffness[s] * scalars[at][1]
    to_across = stiffness[s] * received[at][2]
    along = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        direction_gradient = to_direction[v] + to_across * normal[v]
        to_direction[v] = direction_gradient
        to_normal[v] = to_normal[v] + across * pushed[place(at * n, k)] + to_across * fields[place(direction, k)]
        along += wp.dot(direction_gradient, fields[place(previous, k)])
    if m > 0:
        wp.atomic_add(received, at, vec3(real(0.0), along, real(0.0)))


@wp.kernel(enable_backward=False)
def back_to_residual(
    normal: wp.array[vec3], stiffness: wp.array[real], m: int, n_products: int, n: int, fields: wp.array[vec3],
    scalars: wp.array[vec3], inverse: wp.array[symmetric], to_solution: wp.array[vec3], to_direction: wp.array[vec3],
    to_residual: wp.array[vec3], to_diagonal: wp.array[symmetric], received: wp.array[vec3], threads: int,
):  # fmt: skip
    """Gradients of a residual, of the preconditioner, and of the previous step length, if any."""
    i = wp.tid()
    s = i // threads
    n_samples = stiffness.shape[0]
    at = m * n_samples + s
    residual = row(0, m, n_products, n_samples, s, n)
    direction = row(1, wp.max(m - 1, 0), n_products, n_samples, s, n)
    product = row(2, wp.max(m - 1, 0), n_products, n_samples, s, n)
    size = scalars[at][0]
    to_size = quotient(received[at][0], form_of(scalars[at], stiffness[s]))
    push = real(0.0)
    if m > 0:
        to_size += quotient(received[at][1], scalars[at - n_samples][0])
        push = stiffness[s] * scalars[at - n_samples][1]
    if m + 1 < n_products:
        to_size -= quotient(received[at + n_samples][1], size) * quotient(scalars[at + n_samples][0], size)
    along = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        c = inverse[v]
        z = multiply(c, fields[place(residual, k)])
        w = multiply(c, to_direction[v])
        u = w + to_size * z
        residual_gradient = to_residual[v] + u + to_size * z
        to_residual[v] = residual_gradient
        ridge = RIDGE * wp.dot(u, z)
        to_diagonal[v] = to_diagonal[v] - symmetric(
            u[0] * z[0] + ridge,
            u[0] * z[1] + u[1] * z[0],
            u[0] * z[2] + u[2] * z[0],
            u[1] * z[1] + ridge,
            u[1] * z[2] + u[2] * z[1],
            u[2] * z[2] + ridge,
        )
        along += wp.dot(to_solution[v], fields[place(direction, k)])
        along -= wp.dot(residual_gradient, fields[place(product, k)] + push * normal[v])
    if m > 0:
        wp.atomic_add(received, at - n_samples, vec3(along, real(0.0), real(0.0)))
