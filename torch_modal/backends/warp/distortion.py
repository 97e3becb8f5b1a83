"""The distortion of shapes by a Warp kernel."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.autograd import traced, transformed
from torch_modal.backends.torch.distortion import Distortion
from torch_modal.backends.torch.rests import Rests
from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.energy.energy import Energy
from torch_modal.energy.term import Mesh


class WarpDistortion(Distortion):
    """:class:`Distortion` whose elements of Eq. 5 are looked at in one kernel, in float64."""

    record: Tensor
    record_edge: Tensor
    record_hinge: Tensor

    def __init__(self, mesh: Mesh, further: Energy | None) -> None:
        super().__init__(mesh, further)
        edges, has_hinge = self.edges.T, self.has_hinge
        record = torch.cat([edges, torch.full_like(edges, -1)], 1)
        record[has_hinge] = self.hinges.T
        hinge = torch.zeros_like(self.edge)
        hinge[has_hinge] = self.hinge
        buffers = {"record": record, "record_edge": self.edge, "record_hinge": hinge}
        for name, values in buffers.items():
            self.register_buffer(name, values.int(), persistent=False)

    def of_shell(self, shapes: Sequence[Tensor], rests: Rests) -> Tensor:
        """As in the base class, which has gradients."""
        t, stiffness = rests.t, rests.stiffness[:2]
        if torch.is_grad_enabled() or traced(t) or any(transformed(x) for x in (*shapes, *rests.shapes, t, *stiffness)):
            return super().of_shell(shapes, rests)
        if t.dim() > 1:
            # From each of the rest shapes alone, then weighted.
            n, flat = t.shape[1], torch.stack(rests.shapes, 1).flatten(0, 1)
            each = [value.repeat_interleave(n, 0) for value in (*stiffness, *shapes)]
            alone = Rests((flat, flat), None, flat.new_zeros(len(flat)), each[:2])
            return (self.of_shell(each[2:], alone).unflatten(1, t.shape) * t).sum(-1)
        b, n = shapes[0].shape[:2]
        x = torch.stack([*shapes]).double()
        which = torch.arange(b, device=t.device) if rests.which is None else rests.which
        alpha, beta = (values.double().contiguous() for values in stiffness)
        ends = (end.double().contiguous() for end in rests.shapes)
        out = x.new_zeros(len(shapes), b, 2)
        given = [x, len(shapes), *ends, which.int(), t.double().contiguous()]
        given += [self.record, self.record_edge, self.record_hinge, alpha, beta, alpha.shape[-1], beta.shape[-1], n]
        launch(kernels("distortion").distortion, (b, len(self.record)), [*given, out])
        return (self.shares[0] * out[..., 0] + self.shares[1] * out[..., 1]).to(t)
