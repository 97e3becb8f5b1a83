"""Between the caller's coordinates and the frame of a layer: key-frames centred, scaled and turned on to each other."""

import threading
import warnings
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import is_eager
from torch_modal.elastic.backend import TorchBackend
from torch_modal.errors import MeshWarning
from torch_modal.geometry.canonical import CANONICAL_SIZE, size
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.rigid import best_rotation, centroid, looks_mirrored

# A key-frame smaller than this part of the reference is a point.
SMALLEST_SIZE = 1e-6

# A key-frame that is larger or smaller than the reference by this factor is in other units, or another body.
OTHER_SIZE = 3.0

_WARNING = threading.Lock()


class Pose(NamedTuple):
    """Place of shapes of the frame in the caller's coordinates."""

    rotation: Tensor
    """*Shape:* ``(B, 3, 3)``."""
    centre: Tensor
    """The origin of the frame. *Shape:* ``(B, 3)``."""


class KeyframeAlignment(nn.Module):
    """The scale of 100, and the alignment of key-frames.

    Args:
        references: Shapes near the key-frames, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        mesh: Their connectivity.
        backend: Turns the key-frames.
    """

    scale: Tensor
    weights: Tensor
    references: Tensor
    turns: Tensor
    roots: Tensor
    rooted: Tensor
    stand_in: Tensor
    extent: Tensor
    faces: Tensor

    def __init__(self, references: Tensor, mesh: Connectivity, backend: TorchBackend) -> None:
        super().__init__()
        self.mean_pose, self.volumes_of = backend.mean_pose, backend.volumes_of
        sizes = torch.tensor([size(x.numpy(), mesh.faces) for x in references], dtype=references.dtype)
        scale = CANONICAL_SIZE / sizes.mean()
        areas = torch.stack([torch.from_numpy(vertex_areas(x.numpy(), mesh.faces)) for x in references])
        weights = (areas / areas.sum(1, keepdim=True)).mean(0)
        centred = references - centroid(references, weights)[:, None]
        self.register_buffer("scale", scale, persistent=False)
        #: Of the vertices, adding up to one. *Shape:* ``(V,)``.
        self.register_buffer("weights", weights, persistent=False)
        covariances = (centred[0] * weights[:, None]).mT @ centred
        rotations = torch.cat([torch.eye(3).to(weights)[None], best_rotation(covariances[1:])])
        #: From the references to the frame, for vectors such as modes. *Shape:* ``(K, 3, 3)``.
        self.register_buffer("turns", rotations, persistent=False)
        #: The references in the frame, turned on to the first. *Shape:* ``(K, V, 3)``.
        self.register_buffer("references", centred @ rotations.mT * scale, persistent=False)
        #: Roots of the weights, and the first reference times these. *Shape:* ``(V,), (3, V)``.
        self.register_buffer("roots", weights.sqrt(), persistent=False)
        self.register_buffer("rooted", (self.reference.mT * self.roots).contiguous(), persistent=False)
        #: The first reference at the caller's scale, for key-frames without a shape. *Shape:* ``(3, V)``.
        self.register_buffer("stand_in", (self.reference.mT / scale).contiguous(), persistent=False)
        extent = (self.reference.amax(0) - self.reference.amin(0)).norm()
        #: Diagonal of the bounding box of the first reference.
        self.register_buffer("extent", extent, persistent=False)
        self.register_buffer("faces", torch.tensor(mesh.faces).int(), persistent=False)
        self.closed = len(mesh.boundary_edges) == 0
        self.size_warned = False

    @property
    def reference(self) -> Tensor:
        """The first reference in the frame. *Shape:* ``(V, 3)``."""
        return self.references[0]

    def forward(self, keyframes: Tensor, weights: Tensor) -> tuple[Tensor, Pose, Tensor]:
        """Key-frames turned on to each other, the weighted mean of their poses, and which samples have an in-between.

        Samples have none with key-frames or weights that are not finite, that are a point, or, of closed surfaces,
        mirror images of each other; key-frames without a weight do not count. The reference stands in for these.

        Args:
            keyframes: *Shape:* ``(B, K, V, 3)``.
            weights: *Shape:* ``(B, K)``.

        Returns:
            Shapes, *shape* ``(B, K, V, 3)``; the pose; *shape* ``(B,)``, bool.
        """
        weights, known = torch.where(weights.isfinite(), weights, 1 / weights.shape[1]), weights.isfinite()
        x, usable = self.replace_unusable(keyframes.mT.contiguous())
        aligned, pose = self._align(x, weights)
        shapes = aligned.mT.contiguous()
        usable = usable & ~self.find_mirrored(shapes.detach(), weights)
        return shapes, pose, ((usable | (weights == 0)) & known).all(1)

    def replace_unusable(self, keyframes: Tensor) -> tuple[Tensor, Tensor]:
        """Replace key-frames that are not finite or have no size by the reference; True for those that are kept.

        *Shape:* ``(B, K, 3, V) -> (B, K, 3, V), (B, K)``.
        """
        rows = keyframes.detach()
        sizes = (rows.amax(-1) - rows.amin(-1)).norm(dim=-1) * self.scale
        usable = sizes.isfinite() & (sizes > SMALLEST_SIZE * CANONICAL_SIZE)  # what is not finite has no extent
        self._warn_of_size(sizes)
        return torch.where(usable[..., None, None], keyframes, self.stand_in), usable

    def _align(self, keyframes: Tensor, weights: Tensor) -> tuple[Tensor, Pose]:
        """Key-frames turned on to their weighted mean, and this to the reference. *Shape:* ``(B, K, 3, V)``."""
        centres = keyframes @ self.weights
        centred = (keyframes - centres[..., None]) * self.scale
        rows = (centred * self.roots).flatten(1, 2)
        to_reference = (self.rooted @ rows.mT).unflatten(2, (-1, 3)).transpose(1, 2)  # (B, K, 3, 3)
        among = (rows @ rows.mT).unflatten(2, (-1, 3)).unflatten(1, (-1, 3)).transpose(2, 3)  # (B, K, K, 3, 3)
        rotations, rotation = self.mean_pose(to_reference, among, weights)
        return rotations @ centred, Pose(rotation, (weights[..., None] * centres).sum(1))

    def to_caller(self, x: Tensor, pose: Pose) -> Tensor:
        """Shapes of the frame in the caller's coordinates. *Shape:* ``(B, V, 3)``."""
        return torch.baddbmm(pose.centre[:, None], x, pose.rotation.mT / self.scale)

    def to_frame(self, points: Tensor, pose: Pose) -> Tensor:
        """The inverse of :meth:`to_caller`. *Shape:* ``(B, P, 3)``."""
        return (points - pose.centre[:, None]) @ pose.rotation * self.scale

    def find_mirrored(self, shapes: Tensor, weights: Tensor) -> Tensor:
        """True for mirror images of the heaviest, of closed surfaces. *Shape:* ``(B, K, V, 3), (B, K) -> (B, K)``."""
        if not self.closed:
            return torch.zeros_like(weights, dtype=torch.bool)
        volumes, heaviest = self.volumes_of(shapes, self.faces), weights.argmax(1, keepdim=True)
        inverted = volumes * volumes.gather(1, heaviest) < 0
        if is_eager(inverted) and not inverted.any():
            return inverted
        first = shapes.take_along_dim(heaviest[..., None, None], 1).expand_as(shapes)
        heaviest_shapes, others = first.flatten(0, 1), shapes.flatten(0, 1)
        return inverted & looks_mirrored(heaviest_shapes, others, self.faces.long()).view_as(inverted)

    def _warn_of_size(self, sizes: Tensor) -> None:
        """Warn, once for each layer, that key-frames and bases seem to be in different units."""
        if self.size_warned or not is_eager(sizes):
            return
        ratios = sizes / self.extent
        other = (ratios > SMALLEST_SIZE) & ratios.isfinite() & ((ratios > OTHER_SIZE) | (ratios < 1 / OTHER_SIZE))
        if not bool(other.any()):
            return
        with _WARNING:  # chunks of a batch come here in threads
            warned = self.size_warned
            self.size_warned = True
        if warned:
            return
        warnings.warn(
            f"key-frames are {float(ratios[other][0]):.3g} times as large as the shapes that the bases were made from; "
            "Eq. 5 depends on the size, so that the in-betweens differ from in-betweens of bases in the same units: "
            "scale the key-frames, or make the bases from them",
            MeshWarning,
            stacklevel=2,
        )
