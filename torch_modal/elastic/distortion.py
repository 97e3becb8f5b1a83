"""Distortion of shapes against their rest shapes, with a bounded contribution of each element."""

from collections.abc import Sequence
from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import torch
from torch import Tensor, nn

from torch_modal.autograd import is_eager
from torch_modal.elastic import bend, stretch
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.energy import Energy, RestShapes, edge_vectors_of
from torch_modal.elastic.kernels.launch import launch, make_once
from torch_modal.elastic.shell import N_SHELL_TERMS
from torch_modal.elastic.steps import TermsTowards
from torch_modal.elastic.term import Mesh, periodic_square
from torch_modal.geometry.vectors import norm

# Elements of each kind that are looked at, spread evenly: the sum is then known to a few percent.
MOST_ELEMENTS = 1024

# Strain of an edge from which on its contribution is linear: of edges that have no length at rest it means nothing.
LARGEST_STRAIN = 4.0

# Bound on the weight l^2 / A of a hinge with a needle; an equilateral hinge has 1.15.
LARGEST_WEIGHT = 8.0

# Strain of all edges below which differences are hardly visible.
VISIBLE_STRAIN = 0.02

BEND = Bend()


class Distortion(nn.Module):
    r"""Stretching and bending of Eq. 5 against K rest shapes, with a bounded contribution of each element.

    .. math:: \sum_e \alpha\, |l_e - \bar l_e| \min(|l_e - \bar l_e| / \bar l_e,\, 4)
        + \sum_h \beta \min(\bar l_h^2 / \bar A_h,\, 8)\, f(\theta_h - \bar\theta_h)

    The sum over the rest shapes is weighted. Further terms of the energy count in full.

    Args:
        mesh: The mesh.
        further: Terms beyond Eq. 5.
    """

    edge: Tensor
    edges: Tensor
    hinge: Tensor
    hinges: Tensor

    def __init__(self, mesh: Mesh, further: Energy | None) -> None:
        super().__init__()
        interior = torch.tensor(mesh.connectivity.counts == 2)
        n_edges, n_hinges = len(interior), int(interior.sum())
        edge = torch.linspace(0, n_edges - 1, min(n_edges, MOST_ELEMENTS), dtype=torch.float64).round().long()
        hinge = (interior.cumsum(0) - 1)[edge[interior[edge]]]
        elements = {"edge": edge, "edges": mesh.edges[edge], "hinge": hinge, "hinges": mesh.hinges[hinge]}
        for name, values in elements.items():
            self.register_buffer(name, values, persistent=False)
        #: How many elements each one stands for.
        self.shares = n_edges / len(edge), n_hinges / max(len(self.hinge), 1)
        self.further = further

    def forward(self, shapes: Sequence[Tensor], rests: RestShapes) -> Tensor:
        """The distortion of S shapes of each sample. *Shape of each:* ``(B, V, 3) -> (S, B)``."""
        total = self.of_shell(shapes, rests)
        if self.further is not None:
            terms = TermsTowards.of_terms(self.further, range(N_SHELL_TERMS, len(rests.stiffness)), rests)
            total = total + torch.stack([terms.value(x) for x in shapes])
        return total

    def of_shell(self, shapes: Sequence[Tensor], rests: RestShapes) -> Tensor:
        """Stretching and bending. *Shape of each:* ``(B, V, 3) -> (S, B)``."""
        # All shapes at once: for so few elements, the number of operations determines the time.
        rows = torch.stack([*shapes, *rests.shapes.unbind(1)]).movedim(-1, 0).contiguous()
        hinges = edge_vectors_of(rows, self.hinges.T)
        n, lengths, angles = len(shapes), norm(edge_vectors_of(rows, self.edges.T)[0]), BEND.measure(hinges)
        alpha, beta = self.on_elements(rests.stiffness)
        off = (lengths[:n, None] - lengths[n:]).abs()
        stretching = (alpha * off * (off / lengths[n:]).clamp_max(LARGEST_STRAIN)).sum(-1)
        weights = BEND.weights(hinges[:, :, n:], angles[n:]).clamp_max(LARGEST_WEIGHT)
        bending = (beta * weights * periodic_square(angles[:n, None] - angles[n:])).sum(-1)
        return (rests.weights.mT * (self.shares[0] * stretching + self.shares[1] * bending)).sum(1)

    def on_elements(self, stiffness: Sequence[Tensor]) -> list[Tensor]:
        """Stiffnesses of the edges and hinges that are looked at. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
        pairs = zip(stiffness, (self.edge, self.hinge), strict=False)
        return [values if values.shape[-1] == 1 else values[:, chosen] for values, chosen in pairs]

    def visibility_threshold(self, stiffness: Sequence[Tensor], like: Tensor) -> Tensor:
        """The distortion of a shape whose edges are all strained by :data:`VISIBLE_STRAIN`. *Shape:* ``(B,)``."""
        ends = like.detach()[:, self.edges]
        lengths = (ends[:, :, 1] - ends[:, :, 0]).norm(dim=-1).sum(-1)
        return self.shares[0] * stiffness[0].detach().mean(-1) * lengths * VISIBLE_STRAIN**2


class KernelDistortion(Distortion):
    """:class:`Distortion` without gradients in one kernel, in float64; with them it is the base class."""

    def of_shell(self, shapes: Sequence[Tensor], rests: RestShapes) -> Tensor:
        """Overrides the base class."""
        values = *shapes, rests.shapes, rests.weights, *rests.stiffness[:2]
        if torch.is_grad_enabled() or not is_eager(*values):
            return super().of_shell(shapes, rests)
        args = [x.double().contiguous() for x in (torch.stack([*shapes]), rests.shapes, rests.weights)]
        stiffness = [x.double().contiguous() for x in self.on_elements(rests.stiffness)]
        (n_samples, n_rests), n_vertices = rests.weights.shape, shapes[0].shape[1]
        sums = args[0].new_zeros(len(shapes), n_samples, 2)
        sizes = [len(shapes), n_samples, n_rests, n_vertices, *(x.shape[-1] for x in stiffness)]
        args += stiffness
        launch(
            make_once(kernels).distortion,
            (n_samples, len(self.edges)),
            [self.edges.int(), self.hinges.int(), *args, *sizes, sums],
        )
        return (sums @ sums.new_tensor(self.shares)).to(rests.weights)


@cache
@no_type_check
def kernels() -> SimpleNamespace:
    """Kernel of :class:`KernelDistortion`."""
    import warp as wp

    from torch_modal.elastic.kernels.types import place

    real, vec2, vec3, module = wp.float64, wp.vec2d, wp.vec3d, wp.get_module("torch_modal.elastic.kernels.distortion")
    largest_strain, largest_weight = wp.constant(real(LARGEST_STRAIN)), wp.constant(real(LARGEST_WEIGHT))
    edge, hinge = stretch.kernel_functions(), bend.kernel_functions()
    potential = hinge.potential

    @wp.func
    def length_of(x: wp.array[vec3], at: int, q: wp.vec2i):
        return edge.measure(wp.matrix_from_rows(x[place(at, q[1])] - x[place(at, q[0])]))

    @wp.func
    def hinge_of(x: wp.array[vec3], at: int, q: wp.vec4i):
        o = x[place(at, q[0])]
        return wp.matrix_from_rows(x[place(at, q[1])] - o, x[place(at, q[2])] - o, x[place(at, q[3])] - o)

    @wp.kernel(module=module, enable_backward=False)
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
                    off = wp.abs(length_of(x, (j * n_samples + s) * n_vertices, q) - rest)
                    contribution = factor * off * wp.min(off / rest, largest_strain)
                    wp.atomic_add(out, place(j * n_samples, s), vec2(contribution, real(0.0)))
        for k in range(i - s * threads, hinges.shape[0], threads):
            q4 = hinges[place(k, 0)]
            sums = potential.sums()
            for r in range(s * n_rests, (s + 1) * n_rests):
                e = hinge_of(rests, r * n_vertices, q4)
                phase = hinge.measure(e)
                weight = weights[r] * wp.min(hinge.weight(e, phase, real(0.0)), largest_weight)
                sums += potential.moments(phase, weight)
            factor = beta[place(s * n_beta, wp.min(k, n_beta - 1))]
            to = potential.merge_rests(sums, factor)
            left = potential.left(sums, factor, to)
            for j in range(n_shapes):
                contribution = potential.energy(hinge.measure(hinge_of(x, (j * n_samples + s) * n_vertices, q4)), to)
                wp.atomic_add(out, place(j * n_samples, s), vec2(real(0.0), contribution + left))

    return SimpleNamespace(module=module, distortion=distortion)
