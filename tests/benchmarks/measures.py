"""What is measured on an in-between."""

from importlib.util import find_spec

import numpy as np
import torch
from cases import Case
from helpers.shapes import edge_lengths
from numpy.typing import NDArray
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.bend import wrap_angle
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import Crossings
from torch_modal.geometry.rigid import best_fit

NAN = float("nan")
HAS_CONTACT = find_spec("igl") is not None


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

    def folded(self, x: Tensor) -> Tensor:
        """Which hinges are folded: their angle and both key-frames' leave more than a right angle between them.

        *Shape:* ``(V, 3) -> (H,)``.
        """
        angle = self.shell.measure(x).angle
        gaps = [wrap_angle(angle - self.shell.measure(end).angle).abs() for end in (self.case.x_a, self.case.x_b)]
        return torch.minimum(*gaps) > torch.pi / 2

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
