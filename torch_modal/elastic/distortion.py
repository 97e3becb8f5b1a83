"""Distortion of shapes against their rest shapes, with a bounded contribution of each element."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_modal.autograd import is_eager
from torch_modal.elastic import formulas
from torch_modal.elastic.energy import Energy, RestShapes, edge_vectors_of
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.elastic.steps import TermsTowards
from torch_modal.elastic.term import Mesh

# Elements of each kind that are looked at, spread evenly: the sum is then known to a few percent.
MOST_ELEMENTS = 1024

# Strain of all edges below which differences are hardly visible.
VISIBLE_STRAIN = 0.02


class Distortion(nn.Module):
    r"""Stretching and bending of Eq. 5 against K rest shapes, with a bounded contribution of each element.

    .. math:: \sum_e \alpha\, |l_e - \bar l_e| \min(|l_e - \bar l_e| / \bar l_e,\, 4)
        + \sum_h \beta \min(\bar l_h^2 / \bar A_h,\, 8)\, f(\theta_h - \bar\theta_h)

    The sum over the rest shapes is weighted. Further terms of the energy count in full.

    Args:
        mesh: The mesh.
        further: Terms beyond Eq. 5, which come last.
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
            rests = rests._replace(stiffness=rests.stiffness[-len(self.further.parts) :])
            terms = TermsTowards(self.further, rests.reference(self.further), rests.anchors)
            total = total + torch.stack([terms.value(x) for x in shapes])
        return total

    def of_shell(self, shapes: Sequence[Tensor], rests: RestShapes) -> Tensor:
        """Stretching and bending. *Shape of each:* ``(B, V, 3) -> (S, B)``."""
        # All shapes at once: for so few elements, the number of operations determines the time.
        rows = torch.stack([*shapes, *rests.shapes.unbind(1)]).movedim(-1, 0).contiguous()
        hinges = edge_vectors_of(rows, self.hinges.T)
        lengths = formulas.edge_length(edge_vectors_of(rows, self.edges.T))
        n, angles = len(shapes), formulas.hinge_angle(hinges)
        alpha, beta = self.on_elements(rests.stiffness)
        stretching = (alpha * formulas.bounded_stretch(lengths[:n, None], lengths[n:])).sum(-1)
        weights = formulas.bounded_hinge_weight(hinges[:, :, n:])
        bending = (beta * weights * formulas.periodic_square(angles[:n, None] - angles[n:])).sum(-1)
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
            kernels("distortion").distortion,
            (n_samples, len(self.edges)),
            [self.edges.int(), self.hinges.int(), *args, *sizes, sums],
        )
        return (sums @ sums.new_tensor(self.shares)).to(rests.weights)
