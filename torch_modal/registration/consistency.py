"""Consistency of geodesic distances under a map, which detects exchanged limbs."""

from functools import cached_property

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.registration.maps import FINE_FUNCTIONS, Map, nearest_rows, rate, zoom_out
from torch_modal.registration.spectrum import SpectralShape

N_SAMPLES = 40
_KEPT = 0.12  # largest error of a consistent distance, for a surface of unit area
_FEWEST = 8  # minimum number of consistent samples for a repair


class Consistency:
    """Compares geodesic distances to samples of the first shape with those to their images.

    Args:
        first: The first shape.
        second: The second.
    """

    def __init__(self, first: SpectralShape, second: SpectralShape) -> None:
        self.first, self.second = first, second

    @cached_property
    def _samples(self) -> tuple[IntArray, FloatArray]:
        """Farthest-point samples and the distances to them. *Shape:* ``(m,), (n, m)``."""
        return farthest_points(self.first, N_SAMPLES)

    def errors(self, vertices: IntArray) -> FloatArray:
        """Errors of the distances from vertices to samples. *Shape:* ``(n_first,) -> (n_first, m)``."""
        samples, here = self._samples
        there = self.second.geodesics_from(vertices[samples])[vertices]
        found: FloatArray = np.abs(here - there)
        return found

    def distortion(self, vertices: IntArray) -> float:
        """Mean over the vertices of the largest distance error to a sample. *Shape:* ``(n_first,)``."""
        return float(self.errors(vertices).max(1).mean())

    def repaired(self, found: Map) -> Map | None:
        """A map from the mutually consistent samples; None if they are few.

        Args:
            found: A map that may be wrong in parts.
        """
        samples, here = self._samples
        images = found.vertices[samples]
        there = self.second.geodesics_from(images)
        error = np.abs(here[samples] - there[images])
        error = np.maximum(error, error.T)
        kept = np.arange(len(samples))
        while len(kept) >= _FEWEST:
            against = (error[np.ix_(kept, kept)] > _KEPT).sum(1)
            if not against.any():
                break
            kept = np.delete(kept, against.argmax())
        if len(kept) < _FEWEST or len(kept) == len(samples):
            return None
        vertices = nearest_rows(here[:, kept], there[:, kept])
        vertices = zoom_out(self.first, self.second, vertices, 26, FINE_FUNCTIONS)
        return Map(vertices, rate(self.first, self.second, vertices, FINE_FUNCTIONS))


def farthest_points(shape: SpectralShape, n: int, start: IntArray | None = None) -> tuple[IntArray, FloatArray]:
    """Farthest-point samples and the distances to them. *Shape:* ``(m,), (n, m)``.

    Args:
        shape: The shape.
        n: Number of samples; fewer on a shape with fewer vertices.
        start: The first samples; by default the vertex farthest from the first vertex.
    """
    if start is None:
        start = shape.geodesics_from(np.zeros(1, dtype=np.int64)).argmax(0)
    chosen, distances = list(start), shape.geodesics_from(start)
    while len(chosen) < min(n, len(shape)):
        chosen.append(int(distances.min(1).argmax()))
        distances = np.hstack([distances, shape.geodesics_from(np.array(chosen[-1:]))])
    return np.array(chosen), distances
