"""Kernels of totals: the sum of the measures of all elements, and its gradient."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from torch_modal.elastic.kernels.elements import common, kernel_of, module_of
from torch_modal.elastic.kernels.measures import functions_of
from torch_modal.elastic.kernels.types import place, real, vec3
from torch_modal.elastic.term import Formulas


@cache
def kernels_of(f: Formulas) -> SimpleNamespace:
    """The kernel of a term that is no angle."""
    c, functions, kernel = common(f), functions_of(f), kernel_of(f, module_of(f, "total"))
    corners, edge_vectors, add = c.corners, c.edge_vectors, c.add

    @kernel
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

    return SimpleNamespace(total=total)
