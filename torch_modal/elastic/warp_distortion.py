"""The distortion of shapes by a Warp kernel."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.autograd import plain
from torch_modal.elastic.distortion import Distortion
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.kernels.launch import Constants, kernels, launch, records
from torch_modal.elastic.term import Mesh


class WarpDistortion(Distortion):
    """:class:`Distortion` without gradients in one kernel, in float64; with them it is the base class."""

    def __init__(self, mesh: Mesh, further: Energy | None) -> None:
        super().__init__(mesh, further)
        record = records(mesh)[self.edge]
        hinge = (record[:, 2] >= 0).cumsum(0) - 1
        arrays = {"record": record.int(), "hinge": hinge.int(), "capped_faces": mesh.faces[:0].int()}
        #: The elements as the first argument of the kernel.
        self.constants = Constants("elements", "Elements", **arrays, n_vertices=mesh.n_vertices)

    def of_shell(self, shapes: Sequence[Tensor], rests: RestShapes) -> Tensor:
        """Overrides the base class."""
        values = *shapes, rests.shapes, rests.weights, *rests.stiffness[:2]
        if torch.is_grad_enabled() or not plain(*values):
            return super().of_shell(shapes, rests)
        given = [x.double().contiguous() for x in (torch.stack([*shapes]), rests.shapes, rests.weights)]
        stiffness = [x.double().contiguous() for x in self.on_elements(rests.stiffness)]
        n_samples, n_rests = rests.weights.shape
        found = given[0].new_zeros(len(shapes), n_samples, 2)
        sizes = [len(shapes), n_samples, n_rests, *(x.shape[-1] for x in stiffness)]
        arguments = [self.constants, *given, *stiffness, *sizes, found]
        launch(kernels("shell").distortion, (n_samples, len(self.edge)), arguments)
        return (found @ found.new_tensor(self.shares)).to(rests.weights)
