"""Kernels of a term, made from its functions of one element.

Gradients of a measure without a closed form come from ``wp.grad``. In a kernel without ``enable_backward`` it would
lose those of functions that call others, in silence: kernels of such terms have it, though nothing differentiates them.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.measures import functions_of
from torch_modal.elastic.kernels.types import block, place, real, symmetric, vec3
from torch_modal.elastic.term import Formulas


@cache
def _common(f: Formulas) -> SimpleNamespace:
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


@cache
def _merging(f: Formulas) -> SimpleNamespace:
    """Functions that merge the rest shapes of an element."""
    c, own, softness_of = _common(f), functions_of(f), for_kernels(formulas.softness)
    potential, fullness, weight, measure = own.potential, own.fullness, own.weight, own.measure
    vectors, corners, edge_vectors, sums = c.vectors, c.corners, c.edge_vectors, potential.sums

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
    def mean_of(whole: wp.array[real], r: int, n_elements: int):
        result = real(0.0)
        if whole:
            result = whole[r] / real(n_elements)
        return result

    @wp.func
    def merge(
        x: wp.array[vec3], n_vertices: int, q: corners, weights: wp.array[real], whole: wp.array[real],
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

    return SimpleNamespace(**locals())


def _module(f: Formulas, kind: str) -> "wp.Module":
    """A module of the kernels of a term, which Warp compiles as a whole."""
    return wp.get_module(f"{__name__}.{f.name}.{kind}")


def _kernel(f: Formulas, module: "wp.Module") -> Callable[[Callable[..., None]], "wp.Kernel"]:
    """The decorator of kernels that are not differentiated, but for gradients of a measure by ``wp.grad``."""
    return wp.kernel(enable_backward=not f.exact, module=module)


@cache
def _rider(f: Formulas | None) -> SimpleNamespace:
    """Functions of a term of edges that rides on one of larger elements, on their first edge vectors; or of none."""
    if f is None:
        return SimpleNamespace(record=real, Factors=real)
    c, own = _common(f), functions_of(f)
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
def convex(f: Formulas, rider: Formulas | None) -> SimpleNamespace:
    """Value, gradient and convex Hessian of a term, and of another that rides on its elements.

    Where both read and write the same vertices, one pass takes two thirds of the time of two. The elements are then
    those of the rider; ``own`` has the number of the term's element, or -1 where there is none.
    """
    c, functions, other, n, rides = _common(f), functions_of(f), _rider(rider), f.n, rider is not None
    potential = functions.potential
    vectors, corners, edge_vectors, add = c.vectors, c.corners, c.edge_vectors, c.add
    Factors, record = c.Factors, potential.record
    module = _module(f, f"convex.{rider.name if rider else None}")
    kernel = _kernel(f, module) if rider is None or rider.exact else _kernel(rider, module)

    @kernel
    def linearise(
        elements: wp.array[corners], own: wp.array[wp.int32], n_own: int, n_vertices: int, x: wp.array[vec3],
        rests: wp.array[record], others: wp.array[other.record], total: wp.array[real],
        gradient: wp.array[vec3], diagonal: wp.array[symmetric], factors: wp.array[Factors],
        other_factors: wp.array[other.Factors], threads: int,
    ):  # fmt: skip
        """Energy, gradient, and blocks and factors of the convex Hessian.

        What has no arrays is left out.
        """
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
                ridden = vec3()
                square = symmetric()
                if wp.static(rides):
                    energy, ridden, square = other.linearise(e[0], others, edge, other_factors)
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
                received[0] += ridden
                add(gradient, v, q, received)
                if diagonal:
                    whole = g[0]
                    wp.atomic_add(diagonal, place(v, q[1]), square + block(along, g[0], across))
                    for j in range(1, wp.static(n)):
                        whole += g[j]
                        wp.atomic_add(diagonal, place(v, q[j + 1]), block(along, g[j], across))
                    wp.atomic_add(diagonal, place(v, q[0]), square + block(along, whole, across))
            else:
                if wp.static(rides):
                    summed += other.energy(e[0], others, edge)
                if at >= 0:
                    summed += potential.energy(functions.measure(e), rests[place(s * n_own, at)])
        wp.atomic_add(total, s, summed)

    @kernel
    def product(
        elements: wp.array[corners], own: wp.array[wp.int32], n_own: int, n_vertices: int, fields: wp.array[vec3],
        start: int, factors: wp.array[Factors], other_factors: wp.array[other.Factors], out: wp.array[vec3],
        out_start: int, scalars: wp.array[vec3], first: int, threads: int,
    ):  # fmt: skip
        """The convex Hessian times a field, and the field times that, the third of the scalars, where there are some.

        Fields, results and scalars begin at the given places of their arrays.
        """
        i = wp.tid()
        s = i // threads
        total = real(0.0)
        for k in range(i - s * threads, elements.shape[0], threads):
            q = elements[place(k, 0)]
            at = k
            if own:
                at = own[place(k, 0)]
            e = edge_vectors(fields, start + s * n_vertices, q)
            ridden = vec3()
            form = real(0.0)
            if wp.static(rides):
                ridden, form = other.product(other_factors, place(s * elements.shape[0], k), e[0])
                total += form
            received = vectors()
            if at >= 0:
                received, form = c.product(factors[place(s * n_own, at)], e)
                total += form
            received[0] += ridden
            add(out, out_start + s * n_vertices, q, received)
        if scalars:
            wp.atomic_add(scalars, first + s, vec3(real(0.0), real(0.0), total))

    return SimpleNamespace(linearise=linearise, product=product)


@cache
def convex_adjoint(f: Formulas, rider: Formulas | None) -> SimpleNamespace:
    """Adjoints of :func:`convex`, which Warp generates."""
    module = _module(f, f"convex_adjoint.{rider.name if rider else None}")
    kernels = vars(convex(f, rider))
    return SimpleNamespace(**{name: wp.kernel(kernel.func, module=module) for name, kernel in kernels.items()})


@cache
def forward(f: Formulas) -> SimpleNamespace:
    """Kernels that merge the rest shapes of a term into records (Eq. 8)."""
    c, potential, module = _common(f), functions_of(f).potential, _module(f, "forward")
    measure = functions_of(f).measure
    corners, edge_vectors, record = c.corners, c.edge_vectors, potential.record
    kernel, merging = _kernel(f, module), _merging(f)
    fullness, softness, merge_rests = merging.fullness, merging.softness, merging.merge

    @kernel
    def merge(
        elements: wp.array[corners], n_vertices: int, x: wp.array[vec3], weights: wp.array[real], whole: wp.array[real],
        stiffness: wp.array[real], start: wp.array[vec3], altitude: real, relative: int, n_shapes: int,
        n_stiffness: int, out: wp.array[record], constant: wp.array[real], threads: int,
    ):  # fmt: skip
        """K rest shapes of each sample as one, softened at the needles of a start, and the energy that remains."""
        i = wp.tid()
        s = i // threads
        left = real(0.0)
        for k in range(i - s * threads, elements.shape[0], threads):
            q = elements[place(k, 0)]
            moments, usual = merge_rests(
                x,
                n_vertices,
                q,
                weights,
                whole,
                elements.shape[0],
                altitude,
                relative,
                s * n_shapes,
                (s + 1) * n_shapes,
            )
            factor = stiffness[place(s * n_stiffness, wp.min(k, n_stiffness - 1))]
            if start:
                factor *= softness(fullness(edge_vectors(start, s * n_vertices, q), altitude), usual, relative)
            to = potential.merge_rests(moments, factor)
            left += potential.left(moments, factor, to)
            out[place(s * elements.shape[0], k)] = to
        wp.atomic_add(constant, s, left)

    if not f.uses_mean:
        return SimpleNamespace(merge=merge)

    @kernel
    def total(
        elements: wp.array[corners], n_vertices: int, x: wp.array[vec3], out: wp.array[real], threads: int,
    ):  # fmt: skip
        """All measures together."""
        i = wp.tid()
        s = i // threads
        moments_sum = real(0.0)
        for k in range(i - s * threads, elements.shape[0], threads):
            moments_sum += measure(edge_vectors(x, s * n_vertices, elements[place(k, 0)]))
        wp.atomic_add(out, s, moments_sum)

    return SimpleNamespace(merge=merge, total=total)


@cache
def backward(f: Formulas) -> SimpleNamespace:
    """The adjoint of ``merge``."""
    return SimpleNamespace(merge=wp.kernel(forward(f).merge.func, module=_module(f, "backward")))
