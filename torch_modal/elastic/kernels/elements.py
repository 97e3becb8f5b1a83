"""Kernels of a term, made from its functions of one element.

Gradients of a measure without a closed form come from ``wp.grad``. In a kernel without ``enable_backward`` it would
lose those of functions that call others, in silence: kernels of such terms have it, though nothing differentiates them.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import warp as wp

from torch_modal.elastic.kernels.measures import functions_of
from torch_modal.elastic.kernels.types import block, place, real, symmetric, vec2, vec3
from torch_modal.elastic.term import Formulas


@cache
def common(f: Formulas) -> SimpleNamespace:
    """Types and functions of elements of as many vertices."""
    own = functions_of(f)
    n, kind, across_of, tense = f.n, own.potential.kind, own.across, own.across is not None
    vectors, corners = wp.types.matrix(shape=(n, 3), dtype=real), wp.types.vector(length=n + 1, dtype=wp.int32)

    @wp.struct
    class Factors:
        """Factors of products with the convex Hessian."""

        gradient: vectors
        along: real
        across: real

    @wp.func
    def edge_vectors(x: wp.array[vec3], at: int, q: corners):
        origin = x[place(at, q[0])]
        result = vectors()
        for j in range(wp.static(n)):
            result[j] = x[place(at, q[j + 1])] - origin
        return result

    @wp.func
    def add(out: wp.array[vec3], at: int, q: corners, received: vectors):
        whole = vec3()
        for c in range(wp.static(n)):
            wp.atomic_add(out, place(at, q[c + 1]), received[c])
            whole += received[c]
        wp.atomic_add(out, place(at, q[0]), -whole)

    @wp.func_replay(add)
    def add_nothing(out: wp.array[vec3], at: int, q: corners, received: vectors):
        """Adjoints of kernels do not add once more."""

    @wp.func
    def inner(a: vectors, b: vectors):
        """By rows: several times as fast as ``wp.ddot``."""
        result = wp.dot(a[0], b[0])
        for j in range(1, wp.static(n)):
            result += wp.dot(a[j], b[j])
        return result

    if not tense:

        @wp.func
        def across_of(q: kind, slope: real, along: real):
            return real(0.0)

    @wp.func
    def stiffness(q: kind, slope: real, along: real):
        """Stiffness along the gradient, beyond what is across, and across."""
        across = across_of(q, slope, along)
        return along - across, across

    @wp.func
    def factors_of(gradient: vectors, along: real, across: real):
        h = Factors()
        h.gradient = gradient
        h.along = along
        h.across = across
        return h

    @wp.func
    def product(h: Factors, e: vectors):
        """Forces of an element, and their product with its change."""
        rate = inner(h.gradient, e)
        push = h.along * rate
        forces = push * h.gradient
        form = push * rate
        if wp.static(tense):
            forces += h.across * e
            form += h.across * inner(e, e)
        return forces, form

    return SimpleNamespace(**locals())


def kernel_of(kind: str, f: Formulas, fused: Formulas | None = None) -> Callable[[Callable[..., None]], "wp.Kernel"]:
    """The decorator of kernels of one or two terms, in a module that Warp compiles as a whole."""
    by_grad = not all(each.exact for each in (f, fused) if each is not None)
    return wp.kernel(enable_backward=by_grad, module=wp.get_module(f"{__name__}.{f.name}.{kind}"))  # type: ignore[no-any-return]


@cache
def _fused(f: Formulas | None) -> SimpleNamespace:
    """Functions of a term of edges that is fused with one of larger elements, on their first edge vectors."""
    if f is None:
        return SimpleNamespace(record=real, Factors=real)
    c, own = common(f), functions_of(f)
    potential, record, Factors = own.potential, own.potential.record, c.Factors

    @wp.func
    def energy(e: vec3, rests: wp.array[record], at: int):
        return potential.energy(own.measure(wp.matrix_from_rows(e)), rests[at])

    @wp.func
    def linearise(e: vec3, rests: wp.array[record], at: int, factors: wp.array[Factors]):
        m, g = own.linearise(wp.matrix_from_rows(e))
        rest = rests[at]
        slope = potential.slope(m, rest)
        square = symmetric()
        if factors:
            along, across = c.stiffness(m, slope, real(2.0) * rest[0])
            factors[at] = c.factors_of(g, along, across)
            square = block(along, g[0], across)
        return potential.energy(m, rest), slope * g[0], square

    @wp.func
    def product(factors: wp.array[Factors], at: int, e: vec3):
        received, form = c.product(factors[at], wp.matrix_from_rows(e))
        return received[0], form

    return SimpleNamespace(record=record, Factors=Factors, energy=energy, linearise=linearise, product=product)


@cache
def convex(f: Formulas, fused: Formulas | None) -> SimpleNamespace:
    """Value, gradient and convex Hessian of a term, fused with a term of edges, on their first edge vectors.

    One pass takes two thirds of the time of two. The elements then begin with the edges; ``own`` has the number of the
    term's element, or -1 where there is none.
    """
    kernel = kernel_of(f"convex.{fused.name if fused else None}", f, fused)
    return SimpleNamespace(linearise=kernel(_linearise(f, fused)), product=kernel(_product(f, fused)))


def _linearise(f: Formulas, fused: Formulas | None) -> Callable[..., None]:
    c, functions, other, n, fuses = common(f), functions_of(f), _fused(fused), f.n, fused is not None
    vectors, corners, edge_vectors, add, Factors = c.vectors, c.corners, c.edge_vectors, c.add, c.Factors
    potential, record = functions.potential, functions.potential.record

    def linearise(
        elements: wp.array[corners], own: wp.array[wp.int32], n_own: int, n_vertices: int, x: wp.array[vec3],
        rests: wp.array[record], others: wp.array[other.record], total: wp.array[real],
        gradient: wp.array[vec3], diagonal: wp.array[symmetric], factors: wp.array[Factors],
        other_factors: wp.array[other.Factors], threads: int,
    ):  # fmt: skip
        """Energy, gradient, and blocks and factors of the convex Hessian, as far as there are arrays."""
        i = wp.tid()
        s = i // threads
        v = s * n_vertices
        summed = real(0.0)
        for k in range(i - s * threads, elements.shape[0], threads):
            q = elements[place(k, 0)]
            at = k
            if own:
                at = own[place(k, 0)]
            e = edge_vectors(x, v, q)
            edge = place(s * elements.shape[0], k)
            if gradient:
                energy = real(0.0)
                of_edge = vec3()
                square = symmetric()
                if wp.static(fuses):
                    energy, of_edge, square = other.linearise(e[0], others, edge, other_factors)
                summed += energy
                received = vectors()
                g = vectors()
                along = real(0.0)
                across = real(0.0)
                if at >= 0:
                    m, g = functions.linearise(e)
                    to = rests[place(s * n_own, at)]
                    summed += potential.energy(m, to)
                    slope = potential.slope(m, to)
                    received = slope * g
                    if diagonal:
                        along, across = c.stiffness(m, slope, real(2.0) * to[0])
                        factors[place(s * n_own, at)] = c.factors_of(g, along, across)
                received[0] += of_edge
                add(gradient, v, q, received)
                if diagonal:
                    whole = g[0]
                    wp.atomic_add(diagonal, place(v, q[1]), square + block(along, g[0], across))
                    for j in range(1, wp.static(n)):
                        whole += g[j]
                        wp.atomic_add(diagonal, place(v, q[j + 1]), block(along, g[j], across))
                    wp.atomic_add(diagonal, place(v, q[0]), square + block(along, whole, across))
            else:
                if wp.static(fuses):
                    summed += other.energy(e[0], others, edge)
                if at >= 0:
                    summed += potential.energy(functions.measure(e), rests[place(s * n_own, at)])
        wp.atomic_add(total, s, summed)

    return linearise


def _product(f: Formulas, fused: Formulas | None) -> Callable[..., None]:
    c, other, fuses = common(f), _fused(fused), fused is not None
    vectors, corners, edge_vectors, add, Factors = c.vectors, c.corners, c.edge_vectors, c.add, c.Factors

    def product(
        elements: wp.array[corners], own: wp.array[wp.int32], n_own: int, n_vertices: int, field: wp.array[vec3],
        factors: wp.array[Factors], other_factors: wp.array[other.Factors], out: wp.array[vec3],
        scalars: wp.array[vec2], threads: int,
    ):  # fmt: skip
        """The convex Hessian times a field, and the field times that, the second of the scalars, if wanted."""
        i = wp.tid()
        s = i // threads
        total = real(0.0)
        for k in range(i - s * threads, elements.shape[0], threads):
            q = elements[place(k, 0)]
            at = k
            if own:
                at = own[place(k, 0)]
            e = edge_vectors(field, s * n_vertices, q)
            of_edge = vec3()
            form = real(0.0)
            if wp.static(fuses):
                of_edge, form = other.product(other_factors, place(s * elements.shape[0], k), e[0])
                total += form
            received = vectors()
            if at >= 0:
                received, form = c.product(factors[place(s * n_own, at)], e)
                total += form
            received[0] += of_edge
            add(out, s * n_vertices, q, received)
        if scalars:
            wp.atomic_add(scalars, s, vec2(real(0.0), total))

    return product
