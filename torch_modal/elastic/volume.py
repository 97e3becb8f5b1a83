"""The enclosed volume, the third term of Eq. 5."""

from functools import cache
from types import SimpleNamespace
from typing import no_type_check

import torch
from torch import Tensor

from torch_modal.elastic.term import KernelFunctions, Mesh, Term, square
from torch_modal.geometry.connectivity import Connectivity, double_areas
from torch_modal.geometry.inspect import OPEN, open_part, volume_of
from torch_modal.geometry.vectors import cross, norm

# Eq. 5 divides by the rest volume, which has this bound for flat bodies, as a part of (surface area)^(3/2); a sphere
# has 0.094.
MIN_RELATIVE_VOLUME = 1e-6


class Volume(Term):
    r"""Enclosed volume: :math:`\gamma\, (v - \bar v)^2 / \bar v^2`, the third term of Eq. 5.

    It is the sum of the tetrahedra from the centroid to all faces, so that an open surface may be moved too.
    """

    total = True

    def elements(self, mesh: Mesh) -> Tensor:
        """The centre and each face."""
        return torch.cat([torch.full_like(mesh.faces[:, :1], mesh.centre), mesh.faces], 1)

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """Signed volume of a tetrahedron."""
        p, q, r = edge_vectors
        return (p * cross(q, r)).sum(0) / 6

    measures = measure

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """One over the square of the volume."""
        p, q, r = edge_vectors
        surface = 0.5 * norm(cross(q - p, r - p)).sum(-1, keepdim=True)
        return torch.maximum(measures.abs(), MIN_RELATIVE_VOLUME * surface**1.5) ** -2

    def linearise(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Volumes, and sixths of cross products."""
        p, q, r = edge_vectors
        gradients = torch.stack([cross(q, r), cross(r, p), cross(p, q)]) / 6
        return (p * gradients[0]).sum(0), gradients

    def kernel_functions(self, n: int) -> KernelFunctions | None:
        """Functions of rest shapes; of a class that inherits from this one, none."""
        return kernel_functions() if type(self) is Volume else None


def encloses(x: Tensor, mesh: Connectivity) -> bool:
    """True for a shape that encloses a volume: it has small holes at most, and is not flat. *Shape:* ``(V, 3)``."""
    points = x.detach().cpu().double().numpy()
    if open_part(points, mesh) > OPEN:
        return False
    area = double_areas(points, mesh.faces).sum() / 2
    volume = volume_of(points - points[mesh.used].mean(0), mesh.faces)
    return bool(abs(volume) > MIN_RELATIVE_VOLUME * area**1.5)


@cache
@no_type_check
def kernel_functions() -> KernelFunctions:
    """Weights at rest, for kernels, of elements whose edge vector consists of volume and area."""
    import warp as wp

    real, edge = wp.float64, wp.types.matrix(shape=(1, 3), dtype=wp.float64)
    least = wp.constant(real(MIN_RELATIVE_VOLUME))

    @wp.func
    def measure(x: edge):
        return x[0, 0]

    @wp.func
    def linearise(x: edge):
        return x[0, 0], wp.matrix_from_rows(wp.vec3d(real(1.0), real(0.0), real(0.0)))

    @wp.func
    def weight(x: edge, volume: real, mean: real):
        size = wp.max(wp.abs(volume), least * wp.pow(x[0, 1], real(1.5)))
        return real(1.0) / (size * size)

    return KernelFunctions("volume", 1, square(), measure, linearise, weight=weight)


@cache
@no_type_check
def kernels() -> SimpleNamespace:
    """Volumes as above, with their gradients, and the adjoint."""
    import warp as wp

    from torch_modal.elastic.kernels.types import length_of, place

    real, vec3, module = wp.float64, wp.vec3d, wp.get_module("torch_modal.elastic.kernels.volume")
    half, sixth = wp.constant(real(0.5)), wp.constant(real(1 / 6))

    @wp.kernel(module=module)
    def sizes(
        faces: wp.array[wp.vec3i], n_vertices: int, x: wp.array[vec3], result: wp.array[vec3], n_areas: int,
        normal: wp.array[vec3], threads: int,
    ):  # fmt: skip
        """The volume, and the area of the first faces, of each shape in the second of two; and the volume's gradient.

        Volumes lie between the faces and a vertex, the centre of an extended shape. The faces around a vertex close, so
        that each gives a sixth of its normal to its corners.
        """
        i = wp.tid()
        s = i // threads
        v = s * n_vertices
        middle = x[place(v, faces[faces.shape[0] - 1][2])]
        inside = real(0.0)
        surface = real(0.0)
        for k in range(i - s * threads, faces.shape[0], threads):
            face = faces[place(k, 0)]
            p = x[place(v, face[0])]
            doubled = wp.cross(x[place(v, face[1])] - p, x[place(v, face[2])] - p)
            inside += sixth * wp.dot(p - middle, doubled)
            if normal:
                for j in range(3):
                    wp.atomic_add(normal, place(v, face[j]), sixth * doubled)
            if k < n_areas:
                surface += half * length_of(doubled)
        wp.atomic_add(result, 2 * s + 1, vec3(inside, surface, real(0.0)))

    return SimpleNamespace(sizes=sizes)
