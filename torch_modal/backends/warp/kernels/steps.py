"""Conjugate gradients for the steps of all vertices, preconditioned by the vertices' blocks."""

import warp as wp

from torch_modal.backends.torch import fine_steps as relax
from torch_modal.backends.warp.kernels.elements import applied, place, real, symmetric, vec3

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
    size: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    threads: int,
):
    i = wp.tid()
    s = i // threads
    push = moment[s]
    squared = real(0.0)
    across = real(0.0)
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
        squared += wp.dot(r, z)
        across += wp.dot(normal[v], z)
    wp.atomic_add(size, s, squared)
    wp.atomic_add(swept, s, across)


@wp.func
def quotient(a: real, b: real):
    # A sample that is solved exactly has nothing left: 0 / 0.
    found = real(0.0)
    if b > real(0.0):
        found = a / b
    return found


@wp.kernel(enable_backward=False)
def advance(
    direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    stiffness: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    size: wp.array(dtype=real),
    form: wp.array(dtype=real),
    n: int,
    residual: wp.array(dtype=vec3),
    solution: wp.array(dtype=vec3),
    next_residual: wp.array(dtype=vec3),
    next_size: wp.array(dtype=real),
    threads: int,
):
    i = wp.tid()
    s = i // threads
    push = stiffness[s] * swept[s]
    step = quotient(size[s], form[s] + push * swept[s])
    squared = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        solution[v] = solution[v] + step * direction[v]
        r = residual[v] - step * (product[v] + push * normal[v])
        next_residual[v] = r
        squared += wp.dot(r, applied(inverse[v], r))
    wp.atomic_add(next_size, s, squared)


@wp.kernel(enable_backward=False)
def turn(
    residual: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    normal: wp.array(dtype=vec3),
    size: wp.array(dtype=real),
    next_size: wp.array(dtype=real),
    n: int,
    direction: wp.array(dtype=vec3),
    next_direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    swept: wp.array(dtype=real),
    threads: int,
):
    i = wp.tid()
    s = i // threads
    ratio = quotient(next_size[s], size[s])
    across = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        d = applied(inverse[v], residual[v]) + ratio * direction[v]
        next_direction[v] = d
        product[v] = vec3()
        across += wp.dot(normal[v], d)
    wp.atomic_add(swept, s, across)


@wp.kernel(enable_backward=False)
def arrive(
    x: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    size: wp.array(dtype=real),
    form: wp.array(dtype=real),
    n: int,
    solution: wp.array(dtype=vec3),
    reached: wp.array(dtype=vec3),
    threads: int,
):
    i = wp.tid()
    s = i // threads
    step = quotient(size[s], form[s] + stiffness[s] * swept[s] * swept[s])
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found = solution[v] + step * direction[v]
        solution[v] = found
        reached[v] = x[v] + found
