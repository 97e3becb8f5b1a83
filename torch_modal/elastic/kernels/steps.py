"""Conjugate gradients for the steps of all vertices, preconditioned by the vertices' blocks.

The scalars of an iteration are the inner product of its residual, the volume that its direction sweeps, and the inner
product of the direction with the Hessian's product but for the volume's part. Adjoints need the fields of all
iterations.
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
    gradient: wp.array[vec3], normal: wp.array[vec3], diagonal: wp.array[symmetric], n_samples: int, n_kept: int,
    n: int, inverse: wp.array[symmetric], fields: wp.array[vec3], scalars: wp.array[vec3], threads: int,
):  # fmt: skip
    """The inverse of the diagonal, and the first residual and direction."""
    i = wp.tid()
    s = i // threads
    residual = row(0, 0, n_kept, n_samples, s, n)
    direction = row(1, 0, n_kept, n_samples, s, n)
    product = row(2, 0, n_kept, n_samples, s, n)
    products = vec3()
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        r = -gradient[v]
        block = invert(diagonal[v])
        z = multiply(block, r)
        inverse[v] = block
        fields[place(residual, k)] = r
        fields[place(direction, k)] = z
        fields[place(product, k)] = vec3()
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
