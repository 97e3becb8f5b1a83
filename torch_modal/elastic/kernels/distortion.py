"""Bounded stretching and bending of a sample of elements."""

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.measures import hinge_phase, potential
from torch_modal.elastic.kernels.types import place, real, vec2, vec3

periodic = potential(True)
length, bounded_stretch = for_kernels(formulas.length), for_kernels(formulas.bounded_stretch)
bounded_weight = for_kernels(formulas.bounded_hinge_weight, 3)
moments, merge_rests, energy, left_of = periodic.moments, periodic.merge_rests, periodic.energy, periodic.left
sums_of_rests = periodic.sums


@wp.func
def length_of(x: wp.array[vec3], at: int, q: wp.vec2i):
    return length(x[place(at, q[1])] - x[place(at, q[0])])


@wp.func
def vectors_of(x: wp.array[vec3], at: int, q: wp.vec4i):
    o = x[place(at, q[0])]
    return wp.matrix_from_rows(x[place(at, q[1])] - o, x[place(at, q[2])] - o, x[place(at, q[3])] - o)


@wp.kernel(enable_backward=False)
def distortion(
    edges: wp.array[wp.vec2i], hinges: wp.array[wp.vec4i], x: wp.array[vec3], rests: wp.array[vec3],
    weights: wp.array[real], alpha: wp.array[real], beta: wp.array[real], n_shapes: int, n_samples: int,
    n_rests: int, n_vertices: int, n_alpha: int, n_beta: int, out: wp.array[vec2], threads: int,
):  # fmt: skip
    """Bounded stretching and bending of several shapes of each sample against its rest shapes."""
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, edges.shape[0], threads):
        q = edges[place(k, 0)]
        for r in range(s * n_rests, (s + 1) * n_rests):
            rest = length_of(rests, r * n_vertices, q)
            factor = weights[r] * alpha[place(s * n_alpha, wp.min(k, n_alpha - 1))]
            for j in range(n_shapes):
                contribution = factor * bounded_stretch(length_of(x, (j * n_samples + s) * n_vertices, q), rest)
                wp.atomic_add(out, place(j * n_samples, s), vec2(contribution, real(0.0)))
    for k in range(i - s * threads, hinges.shape[0], threads):
        q4 = hinges[place(k, 0)]
        sums = sums_of_rests()
        for r in range(s * n_rests, (s + 1) * n_rests):
            e = vectors_of(rests, r * n_vertices, q4)
            sums += moments(hinge_phase(e), weights[r] * bounded_weight(e))
        factor = beta[place(s * n_beta, wp.min(k, n_beta - 1))]
        to = merge_rests(sums, factor)
        left = left_of(sums, factor, to)
        for j in range(n_shapes):
            contribution = energy(hinge_phase(vectors_of(x, (j * n_samples + s) * n_vertices, q4)), to)
            wp.atomic_add(out, place(j * n_samples, s), vec2(real(0.0), contribution + left))
