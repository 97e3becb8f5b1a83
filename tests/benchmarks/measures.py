"""What is measured on an in-between."""

from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec

import numpy as np
import torch
from cases import HALF, Case
from numpy.typing import NDArray
from shapes import edge_lengths
from torch import Tensor

import torch_modal as tm
from torch_modal.energy.bend import wrap_angle
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import Crossings
from torch_modal.geometry.rigid import best_fit

NAN = float("nan")
HAS_CONTACT = all(find_spec(name) for name in ("ipctk", "igl"))
FLAT = 1e-3  # volumes below this part of (surface area)^(3/2) are not compared; a sphere has 0.094


@dataclass
class Row:
    """One method on one case. All but ``edge_error_all`` is at t = 1/2."""

    case: str
    method: str
    edge_error: float = NAN
    """Mean over the edges of ``|l - l_true| / l_true``; NaN without a truth."""
    edge_error_all: float = NAN
    """The same, its mean over all times with a truth."""
    edge_drift: float = NAN
    """Mean over the edges of ``|l - m| / m`` with ``m`` the mean length of the edge in both key-frames."""
    vertex_error: float = NAN
    """Root mean square distance to the truth after the best rigid motion, over its bounding-box diagonal."""
    volume: float = NAN
    """Over that of the truth, or the mean of both key-frames'."""
    energy: float = NAN
    """Mean of Eq. 5 against both key-frames, on the fine mesh, at a bounding-box diagonal of 100."""
    turned: float = NAN
    """Faces whose normal points away from the truth's, or, without one, from the full-space optimum's."""
    folds: float = NAN
    """Hinges bent by more than a right angle beyond what they are in either key-frame."""
    crossings: float = NAN
    """Faces that go through others they did not go through in either key-frame; NaN without the extra ``contact``."""
    seconds: float = NAN
    """Processor time of one in-between."""
    note: str = ""


def crossing_pairs(x: Tensor, faces: Tensor) -> NDArray[np.int64]:
    """Pairs of faces that intersect; faces that share a vertex are no pair. *Shape:* ``(n, 2)``."""
    shape = x.double().numpy()
    return np.sort(Crossings(Connectivity(faces.numpy(), len(shape)), shape[None]).pairs(shape), axis=1)


class Yardstick:
    """Measures the in-betweens of one case."""

    def __init__(self, case: Case) -> None:
        self.case = case
        used = case.x_a[case.faces.unique()]
        self.scale = CANONICAL_SIZE / torch.linalg.norm(used.amax(0) - used.amin(0))
        self.shell = tm.ShellEnergy(case.faces)
        self.truth = case.truths.get(HALF)

    def measure(self, row: Row, x: Tensor, upright: Tensor | None) -> None:
        """Write what is found on a shape half-way into a row.

        Args:
            row: What is filled in.
            x: The in-between. *Shape:* ``(V, 3)``.
            upright: A shape whose faces all look the right way, where there is no truth. *Shape:* ``(V, 3)``.
        """
        case, truth = self.case, self.truth
        length = self.lengths(x)
        mean_length = (self.lengths(case.x_a) + self.lengths(case.x_b)) / 2
        row.edge_drift = mean_ratio(length, mean_length)
        row.energy = self.energy(x)
        if self.has_volume:
            row.volume = self.volume(x) / self.usual_volume
        row.folds = float(self.folded(x).sum())
        if HAS_CONTACT:
            row.crossings = float(len(np.unique(self.new_crossings(x))))
        if truth is not None:
            row.edge_error = self.edge_error(x, HALF)
            laid = self.laid(x, truth)
            diagonal = torch.linalg.norm(truth.amax(0) - truth.amin(0))
            row.vertex_error = float((laid - truth).square().sum(1).mean().sqrt() / diagonal)
        guide = truth if truth is not None else upright
        if guide is not None:
            agree = (self.normals(self.laid(x, guide)) * self.normals(guide)).sum(1)
            row.turned = float((agree < 0).sum())

    def edge_error(self, x: Tensor, time: float) -> float:
        """Mean relative error of edge lengths against the truth at a time."""
        return mean_ratio(self.lengths(x), self.lengths(self.case.truths[time]))

    def lengths(self, x: Tensor) -> Tensor:
        """*Shape:* ``(V, 3) -> (E,)``."""
        return edge_lengths(x, self.case.faces)

    def energy(self, x: Tensor) -> float:
        """What an in-between at t = 1/2 minimises."""
        ends = torch.stack([self.case.x_a, self.case.x_b])
        return float(self.shell(x * self.scale, ends * self.scale).mean())

    def volume(self, x: Tensor) -> float:
        """Enclosed with the centroid."""
        return float(self.shell.measure(x).volume)

    @cached_property
    def usual_volume(self) -> float:
        """Of the truth, or the mean of both key-frames."""
        if self.truth is not None:
            return self.volume(self.truth)
        return (self.volume(self.case.x_a) + self.volume(self.case.x_b)) / 2

    @cached_property
    def has_volume(self) -> bool:
        """Whether all known shapes enclose something: a sheet does not."""
        shapes = [self.case.x_a, self.case.x_b, *([] if self.truth is None else [self.truth])]
        areas = [float(self.normals(x).norm(dim=1).sum() / 2) for x in shapes]
        closed = len(Connectivity(self.case.faces.numpy()).boundary_edges) == 0
        return closed or all(abs(self.volume(x)) > FLAT * a**1.5 for x, a in zip(shapes, areas, strict=True))

    def normals(self, x: Tensor) -> Tensor:
        """Of the length of twice the area. *Shape:* ``(V, 3) -> (F, 3)``."""
        a, b, c = (x[corner] for corner in self.case.faces.T)
        return torch.linalg.cross(b - a, c - a)

    def folded(self, x: Tensor) -> Tensor:
        """Which hinges are folded: their angle and both key-frames' leave more than a right angle between them.

        *Shape:* ``(V, 3) -> (H,)``.
        """
        angle = self.shell.measure(x).angle
        gaps = [wrap_angle(angle - self.shell.measure(end).angle).abs() for end in (self.case.x_a, self.case.x_b)]
        return torch.minimum(*gaps) > torch.pi / 2

    def new_crossings(self, x: Tensor) -> NDArray[np.int64]:
        """Pairs of faces that intersect here and in neither key-frame. *Shape:* ``(n, 2)``."""
        n = len(self.case.faces)
        return np.array([divmod(key, n) for key in self._crossing_keys(x) - self._old_crossings]).reshape(-1, 2)

    @cached_property
    def _old_crossings(self) -> set[int]:
        return self._crossing_keys(self.case.x_a) | self._crossing_keys(self.case.x_b)

    def _crossing_keys(self, x: Tensor) -> set[int]:
        i, j = crossing_pairs(x, self.case.faces).T
        return set((i * len(self.case.faces) + j).tolist())

    @staticmethod
    def laid(x: Tensor, on: Tensor) -> Tensor:
        """Moved rigidly to lie on another shape."""
        return best_fit(x, on, torch.ones(len(x), dtype=x.dtype)).apply(x)


def mean_ratio(found: Tensor, wanted: Tensor) -> float:
    """Mean of ``|found - wanted| / wanted``; edges without a length do not count."""
    some = wanted > 0
    return float(((found - wanted).abs()[some] / wanted[some]).mean())


def distance_and_edges(found: Tensor, truth: Tensor, faces: Tensor, size: float) -> tuple[float, float]:
    """Mean distance of vertices over a size, and mean error of edges over their mean length, in percent."""
    lengths, true = (edge_lengths(x, faces) for x in (found, truth))
    distance = (found - truth).norm(dim=-1).mean() / size
    return 100 * float(distance), 100 * float((lengths - true).abs().mean() / true.mean())
