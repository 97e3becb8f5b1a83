"""Kernels that merge the rest shapes of a term into records (Eq. 8), and that add up measures."""

from functools import cache

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.elements import common, kernel_of
from torch_modal.elastic.kernels.measures import functions_of
from torch_modal.elastic.kernels.types import place, real, vec3
from torch_modal.elastic.term import Formulas


@cache
def merge(f: Formulas) -> "wp.Kernel":
    """The kernel that merges the rest shapes of a term into records (Eq. 8)."""
    c, own, softness_of = common(f), functions_of(f), for_kernels(formulas.softness)
    potential, fullness, weight, measure = own.potential, own.fullness, own.weight, own.measure
    vectors, corners, edge_vectors = c.vectors, c.corners, c.edge_vectors
    sums, record = potential.sums, potential.record

    if fullness is None:

        @wp.func
        def fullness(e: vectors, altitude: real):
            return real(1.0)

    @wp.func
    def softness(at_start: real, usual: real, relative: int):
        """bend.Bend.softening."""
        result = at_start
        if relative > 0:
            result = softness_of(at_start, usual)
        return result

    @wp.func
    def mean_of(whole: wp.array[vec3], r: int, n_elements: int):
        result = real(0.0)
        if whole:
            result = whole[2 * r + 1][0] / real(n_elements)
        return result

    @wp.func
    def merge_rests(
        x: wp.array[vec3], n_vertices: int, q: corners, weights: wp.array[real], whole: wp.array[vec3],
        n_elements: int, altitude: real, relative: int, first: int, last: int,
    ):  # fmt: skip
        """Sums over rest shapes, and their mean fullness if wanted."""
        result = sums()
        usual = real(0.0)
        for r in range(first, last):
            e = edge_vectors(x, r * n_vertices, q)
            m = measure(e)
            result += potential.moments(m, weights[r] * weight(e, m, mean_of(whole, r, n_elements)))
            if relative > 0:
                usual += weights[r] * fullness(e, altitude)
        return result, usual

    @kernel_of("forward", f)
    def merge(
        elements: wp.array[corners], n_vertices: int, x: wp.array[vec3], weights: wp.array[real], whole: wp.array[vec3],
        stiffness: wp.array[real], start: wp.array[vec3], altitude: real, relative: int, n_shapes: int,
        n_stiffness: int, out: wp.array[record], threads: int,
    ):  # fmt: skip
        """K rest shapes of each sample as one, softened at the needles of a start."""
        i = wp.tid()
        s = i // threads
        for k in range(i - s * threads, elements.shape[0], threads):
            q = elements[place(k, 0)]
            first, last = s * n_shapes, (s + 1) * n_shapes
            moments, usual = merge_rests(
                x, n_vertices, q, weights, whole, elements.shape[0], altitude, relative, first, last
            )
            factor = stiffness[place(s * n_stiffness, wp.min(k, n_stiffness - 1))]
            if start:
                factor *= softness(fullness(edge_vectors(start, s * n_vertices, q), altitude), usual, relative)
            out[place(s * elements.shape[0], k)] = potential.merge_rests(moments, factor)

    return merge


@cache
def total(f: Formulas) -> "wp.Kernel":
    """The kernel that adds up the measures of all elements, of a term that is no angle."""
    c, functions = common(f), functions_of(f)
    corners, edge_vectors, add = c.corners, c.edge_vectors, c.add

    @kernel_of("total", f)
    def total(
        elements: wp.array[corners], n_vertices: int, x: wp.array[vec3], result: wp.array[vec3],
        normal: wp.array[vec3], threads: int,
    ):  # fmt: skip
        """All measures of each shape together, in the second of two vertices; and the gradient of that, if wanted."""
        i = wp.tid()
        s = i // threads
        whole = real(0.0)
        for k in range(i - s * threads, elements.shape[0], threads):
            q = elements[place(k, 0)]
            e = edge_vectors(x, s * n_vertices, q)
            if normal:
                m, g = functions.linearise(e)
                whole += m
                add(normal, s * n_vertices, q, g)
            else:
                whole += functions.measure(e)
        wp.atomic_add(result, 2 * s + 1, vec3(whole, real(0.0), real(0.0)))

    return total
