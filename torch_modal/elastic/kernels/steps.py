"""Conjugate gradients for the steps of all vertices, preconditioned by the vertices' blocks.

The scalars of an iteration are the inner product of its residual, and that of its direction with the Hessian's product
but for the totals' parts. Of each total, these are its stiffness times its gradient times the change along the
direction, which is swept. Gradients of totals, stiffnesses and changes are rows of one total after the other.
"""

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.types import multiply, place, real, symmetric, vec2, vec3

quotient, invert = for_kernels(formulas.quotient), for_kernels(formulas.symmetric_inverse)


@wp.func
def form_of_totals(stiffness: wp.array[real], swept: wp.array[real], n_samples: int, s: int):
    """The totals' part of the inner product of a direction with its product.

    A function, as below: adjoints of kernels take results of their own loops for those before the loops.
    """
    result = real(0.0)
    for t in range(stiffness.shape[0] // n_samples):
        at = place(t * n_samples, s)
        result += stiffness[at] * swept[at] * swept[at]
    return result


@wp.func
def push_of_totals(
    normals: wp.array[vec3], stiffness: wp.array[real], swept: wp.array[real], n_all: int, v: int, n_samples: int,
    s: int,
):  # fmt: skip
    """The totals' part of a product at a vertex."""
    result = vec3()
    for t in range(stiffness.shape[0] // n_samples):
        at = place(t * n_samples, s)
        result += (stiffness[at] * swept[at]) * normals[place(t * n_all, v)]
    return result


@wp.func
def sweep(
    normals: wp.array[vec3], direction: wp.array[vec3], before: int, first: int, n: int, begin: int, threads: int
):  # fmt: skip
    """The change of a total along a direction, at the vertices of a thread."""
    result = real(0.0)
    for k in range(begin, n, threads):
        v = place(first, k)
        result += wp.dot(normals[place(before, v)], direction[v])
    return result


@wp.kernel(enable_backward=False)
def begin(
    gradient: wp.array[vec3], normals: wp.array[vec3], diagonal: wp.array[symmetric], n: int,
    inverse: wp.array[symmetric], residual: wp.array[vec3], direction: wp.array[vec3], product: wp.array[vec3],
    scalars: wp.array[vec2], swept: wp.array[real], threads: int,
):  # fmt: skip
    """The inverse of the diagonal, and the first residual and direction."""
    i = wp.tid()
    s = i // threads
    n_all = gradient.shape[0]
    size = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        r = -gradient[v]
        block = invert(diagonal[v])
        z = multiply(block, r)
        inverse[v] = block
        residual[v] = r
        direction[v] = z
        product[v] = vec3()
        size += wp.dot(r, z)
    wp.atomic_add(scalars, s, vec2(size, real(0.0)))
    for t in range(normals.shape[0] // n_all):
        change = sweep(normals, direction, t * n_all, s * n, n, i - s * threads, threads)
        wp.atomic_add(swept, place(t * (n_all // n), s), change)


@wp.kernel(enable_backward=False)
def advance(
    normals: wp.array[vec3], inverse: wp.array[symmetric], stiffness: wp.array[real], n: int,
    residual: wp.array[vec3], direction: wp.array[vec3], product: wp.array[vec3], scalars: wp.array[vec2],
    swept: wp.array[real], next_residual: wp.array[vec3], next_scalars: wp.array[vec2], solution: wp.array[vec3],
    threads: int,
):  # fmt: skip
    """The solution after a direction, and the residual there if wanted."""
    i = wp.tid()
    s = i // threads
    n_all = solution.shape[0]
    n_samples = n_all // n
    sums = scalars[s]
    step = quotient(sums[0], sums[1] + form_of_totals(stiffness, swept, n_samples, s))
    size = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        solution[v] = solution[v] + step * direction[v]
        if next_residual:
            pushed = push_of_totals(normals, stiffness, swept, n_all, v, n_samples, s)
            r = residual[v] - step * (product[v] + pushed)
            next_residual[v] = r
            size += wp.dot(r, multiply(inverse[v], r))
    wp.atomic_add(next_scalars, s, vec2(size, real(0.0)))


@wp.kernel(enable_backward=False)
def turn(
    normals: wp.array[vec3], inverse: wp.array[symmetric], n: int, direction: wp.array[vec3],
    scalars: wp.array[vec2], next_residual: wp.array[vec3], next_direction: wp.array[vec3],
    next_product: wp.array[vec3], next_scalars: wp.array[vec2], next_swept: wp.array[real], threads: int,
):  # fmt: skip
    """The next direction; its product is set to zero."""
    i = wp.tid()
    s = i // threads
    n_all = direction.shape[0]
    ratio = quotient(next_scalars[s][0], scalars[s][0])
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        d = multiply(inverse[v], next_residual[v]) + ratio * direction[v]
        next_direction[v] = d
        next_product[v] = vec3()
    for t in range(normals.shape[0] // n_all):
        change = sweep(normals, next_direction, t * n_all, s * n, n, i - s * threads, threads)
        wp.atomic_add(next_swept, place(t * (n_all // n), s), change)
