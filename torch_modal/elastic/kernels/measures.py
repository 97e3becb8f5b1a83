"""Functions of one element that kernels of a term are made from; kernels represent angles by cosine and sine."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.types import real, vec2, vec3, vec5, vec6
from torch_modal.elastic.term import Formulas

hinge_vectors = wp.mat33d
phase_of, longest_side = for_kernels(formulas.phase), for_kernels(formulas.longest_side)
triangle_fullness = for_kernels(formulas.triangle_fullness, 3)
hinge_phase, linearised_phase = for_kernels(formulas.hinge_phase, 3), for_kernels(formulas.linearised_phase, 3)
angle_hessian_product = for_kernels(formulas.angle_hessian_product, 3)


@cache
def potential(periodic: bool) -> SimpleNamespace:
    """The function of a measure and a record of K rest shapes, and the types of measures, records and sums."""
    name, (kind, record, sums) = ("periodic", (vec2, vec6, vec5)) if periodic else ("square", (real, vec2, vec3))
    parts = ("moments", "record", "energy", "slope", "left")
    functions = {part: for_kernels(getattr(formulas, f"{name}_{part}")) for part in parts}
    merge_rests = functions.pop("record")
    return SimpleNamespace(kind=kind, record=record, sums=sums, merge_rests=merge_rests, **functions)


@wp.func
def change_of(q: vec2, to: vec2):
    """Change of an angle from the change of its phase."""
    return q[0] * to[1] - q[1] * to[0]


@wp.func_grad(hinge_phase)
def hinge_phase_adjoint(x: hinge_vectors, to: vec2):
    q, g = linearised_phase(x)
    wp.adjoint[x] += change_of(q, to) * g


@wp.func_grad(linearised_phase)
def linearised_phase_adjoint(x: hinge_vectors, to: vec2, d: hinge_vectors):
    """By hand: ``wp.grad`` of the gradient takes twice the time, a tenth of a backward pass."""
    q, g = linearised_phase(x)
    wp.adjoint[x] += angle_hessian_product(x, d) + change_of(q, to) * g


@wp.func_grad(triangle_fullness)
def triangle_fullness_adjoint(e: vec3, tip: vec3, altitude: real, received: real):
    """By hand: few hinges are softened, and nothing is computed of the others."""
    side = tip - e
    longest = longest_side(e, tip)
    normal = wp.cross(e, tip)
    square = wp.dot(normal, normal)
    whole = square + altitude * longest * longest
    if received != real(0.0) and whole > real(0.0):
        factor = real(2.0) * received * altitude * longest / (whole * whole)
        to_normal = (factor * longest) * normal
        to_longest = -real(2.0) * factor * square
        to_e = wp.cross(tip, to_normal)
        to_tip = wp.cross(to_normal, e)
        if wp.dot(e, e) >= longest:
            to_e += to_longest * e
        elif wp.dot(tip, tip) >= longest:
            to_tip += to_longest * tip
        else:
            to_tip += to_longest * side
            to_e -= to_longest * side
        wp.adjoint[e] += to_e
        wp.adjoint[tip] += to_tip


@cache
def functions_of(f: Formulas) -> SimpleNamespace:
    """The functions of a term's elements, of a matrix of the edge vectors by row.

    ``measure``; ``linearise``, with its gradient; ``weight`` at rest, of edge vectors, measure and mean of the
    measures; ``fullness``, of edge vectors and a squared altitude; ``across``, of measure, slope and twice the weight.
    """
    edges = wp.types.matrix(shape=(f.n, 3), dtype=real)
    names = "measure", "linearised", "weight", "fullness", "tension"
    given, linearise, weight, fullness, across = (
        formula and for_kernels(formula, f.n) for formula in (getattr(f, name) for name in names)
    )
    measure = given
    if f.periodic and not f.gives_phase:
        of_angle = linearise

        @wp.func
        def measure(x: edges):
            return phase_of(given(x))

        @wp.func
        def linearise(x: edges):
            q, g = of_angle(x)
            return phase_of(q), g

    if f.linearised is None:

        @wp.func
        def differentiated(x: edges):
            return measure(x), wp.grad(given)(x)

        linearise = differentiated
    functions = {"measure": measure, "linearise": linearise, "weight": weight, "fullness": fullness, "across": across}
    return SimpleNamespace(potential=potential(f.periodic), **functions)
