r"""As-isometric-as-possible geodesics in shape space (Kilian, Mitra and Pottmann 2007), what the paper compares with.

A path is a few shapes ``P_0 .. P_n``, and its energy what each step does to the edges, seen from both its ends, with a
little of how far the vertices go:

.. math::
    \sum_i \sum_e ((e_{i+1} - e_i) \cdot e_i)^2 + ((e_{i+1} - e_i) \cdot e_{i+1})^2
        + \lambda \sum_i \sum_v A_v |x_{v,i+1} - x_{v,i}|^2

It is minimised over all vertices of all shapes between, by a quasi-Newton method, from coarse to fine: few steps and
few vertices first, then twice the steps until there are enough, then more vertices.
"""

from typing import NamedTuple

import numpy as np
import torch
from decimated_pair import ReducedPair
from helpers.shapes import fraction
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import minimize
from torch import Tensor

from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.rigid import best_fit

FloatArray = NDArray[np.float64]

LAMBDA = 1e-3
"""Of the distances, as in the paper."""
N_STEPS = 8
"""Of the path: a power of two."""
LEVELS = (4_000, 1_000)
"""Faces of the coarser meshes."""
ITERATIONS = {"coarse": 1000, "fine": 200}
"""Of the quasi-Newton method, at most."""


class Geodesic(NamedTuple):
    """A path, in the caller's coordinates."""

    frames: Tensor
    """At even times from 0 to 1, both key-frames included. *Shape:* ``(n + 1, V, 3)``."""
    iterations: list[int]
    """Of each level."""

    def at(self, times: Tensor) -> Tensor:
        """Shapes at any times, straight between neighbours. *Shape:* ``(T,) -> (T, V, 3)``."""
        place = times * (len(self.frames) - 1)
        before = place.floor().long().clamp(0, len(self.frames) - 2)
        return torch.lerp(self.frames[before], self.frames[before + 1], (place - before)[:, None, None])


def geodesic(x_a: Tensor, x_b: Tensor, faces: Tensor) -> Geodesic:
    """The path between two key-frames, in the frame of the first; its rigid motion is that of the key-frames.

    Args:
        x_a: Key-frame at 0. *Shape:* ``(V, 3)``.
        x_b: Key-frame at 1. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """
    scale = CANONICAL_SIZE / (x_a.amax(0) - x_a.amin(0)).norm()
    first, second = x_a.double() * scale, x_b.double() * scale
    back = best_fit(second, first, torch.from_numpy(vertex_areas(first.numpy(), faces.numpy())))
    pairs = []
    ends, own_faces = torch.stack([first, back.apply(second)]), faces
    finest = ends
    for n_faces in [n for n in LEVELS if n < len(faces)]:
        pairs.append(ReducedPair(*ends, own_faces, n_faces))
        ends, own_faces = pairs[-1].coarse, pairs[-1].faces
    metric = _Metric(ends, own_faces)
    path, iterations = torch.lerp(ends[0], ends[1], 0.5)[None], []
    while True:
        path, count = metric.minimise(path, ITERATIONS["coarse"] if pairs else ITERATIONS["fine"])
        iterations.append(count)
        if len(path) + 1 == N_STEPS:
            break
        whole = torch.cat([ends[:1], path, ends[1:]])
        path = torch.stack([(whole[:-1] + whole[1:]) / 2, whole[1:]], 1).flatten(0, 1)[:-1]
    for pair in reversed(pairs):
        times = (torch.arange(1, N_STEPS) / N_STEPS).tolist()
        path = torch.stack([pair.expand(x, t) for x, t in zip(path, times, strict=True)])
        metric = _Metric(pair.fine, pair.fine_faces)
        path, count = metric.minimise(path, ITERATIONS["fine"])
        iterations.append(count)
    whole = torch.cat([finest[:1], path, finest[1:]])
    motion = fraction(back.inverse(), torch.linspace(0, 1, N_STEPS + 1, dtype=torch.float64))
    return Geodesic((motion.apply(whole) / scale).to(x_a), iterations)


class _Metric:
    """The energy of paths on one mesh.

    Args:
        ends: Both key-frames, aligned. *Shape:* ``(2, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
    """

    def __init__(self, ends: Tensor, faces: Tensor) -> None:
        n = ends.shape[1]
        edges = Connectivity(faces.numpy(), n).edges
        rows = np.arange(len(edges))
        signs = np.repeat([-1.0, 1.0], len(edges))
        self.edges = sparse.csr_matrix((signs, (np.tile(rows, 2), edges.T.reshape(-1))), (len(edges), n))
        self.back = self.edges.T.tocsr()
        self.areas = np.mean([vertex_areas(x.numpy(), faces.numpy()) for x in ends], axis=0)[:, None, None]
        self.first, self.last = (x.numpy()[:, None] for x in ends)

    def minimise(self, path: Tensor, iterations: int) -> tuple[Tensor, int]:
        """Shapes between the ends, ``(n - 1, V, 3)``, and iterations."""
        start = np.ascontiguousarray(path.numpy().transpose(1, 0, 2))

        def function(flat: FloatArray) -> tuple[float, FloatArray]:
            value, gradient = self(flat.reshape(start.shape))
            return value, gradient.reshape(-1)

        options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 20, "ftol": 1e-7, "gtol": 0.0}
        found = minimize(function, start.reshape(-1), jac=True, method="L-BFGS-B", options=options)
        shapes = torch.from_numpy(np.ascontiguousarray(found.x.reshape(start.shape).transpose(1, 0, 2)))
        return shapes, int(found.nit)

    def __call__(self, path: FloatArray) -> tuple[float, FloatArray]:
        """The energy and its gradient. *Shape:* ``(V, n - 1, 3)``."""
        whole = np.concatenate([self.first, path, self.last], axis=1)
        n_vertices, n_shapes = whole.shape[:2]
        edge = (self.edges @ whole.reshape(n_vertices, -1)).reshape(-1, n_shapes, 3)
        before, after = edge[:, :-1], edge[:, 1:]
        step, move = after - before, whole[:, 1:] - whole[:, :-1]
        p = np.einsum("enc,enc->en", step, before)[..., None]
        q = np.einsum("enc,enc->en", step, after)[..., None]
        pull = LAMBDA * self.areas * move
        value = (p * p).sum() + (q * q).sum() + (pull * move).sum()
        on_edges = np.zeros_like(edge)
        on_edges[:, 1:] += 2 * (p * before + q * (step + after))
        on_edges[:, :-1] += 2 * (p * (step - before) - q * after)
        gradient = (self.back @ on_edges.reshape(len(edge), -1)).reshape(whole.shape)
        gradient[:, 1:] += 2 * pull
        gradient[:, :-1] -= 2 * pull
        return float(value), gradient[:, 1:-1]
