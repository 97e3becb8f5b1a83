"""Whether a map keeps distances along the surface: two legs that were exchanged below the knee do not."""

from functools import cached_property

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.registration.maps import FINE_FUNCTIONS, Map, nearest_rows, rate, zoom_out
from torch_modal.registration.spectrum import SpectralShape

N_SAMPLES = 40
_KEPT = 0.12  # distances that differ by less, of a surface of area one, agree
_FEWEST = 8  # samples that must agree before a map is made from them


class Consistency:
    """Distances on the first shape to samples that are spread over it, beside those of their images.

    Args:
        first: The first shape.
        second: The second.
    """

    def __init__(self, first: SpectralShape, second: SpectralShape) -> None:
        self.first, self.second = first, second

    @cached_property
    def _samples(self) -> tuple[IntArray, FloatArray]:
        """Vertices, each as far as possible from those before, and distances to them. *Shape:* ``(m,), (n, m)``."""
        return farthest_points(self.first, N_SAMPLES)

    def distortion(self, vertices: IntArray) -> float:
        """Mean over the vertices of the worst error of their distances to the samples. *Shape:* ``(n_first,)``."""
        samples, here = self._samples
        there = self.second.geodesics_from(vertices[samples])[vertices]
        return float(np.abs(here - there).max(1).mean())

    def mended(self, found: Map) -> Map | None:
        """The map that those samples give which agree with each other; None if they are few.

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
    """Vertices that are each as far as possible from those before; their distances. *Shape:* ``(m,), (n, m)``.

    Args:
        shape: The shape.
        n: How many; fewer on a shape with fewer vertices.
        start: The first ones; by default the vertex farthest from the first vertex.
    """
    if start is None:
        start = shape.geodesics_from(np.zeros(1, dtype=np.int64)).argmax(0)
    chosen, distances = list(start), shape.geodesics_from(start)
    while len(chosen) < min(n, len(shape)):
        chosen.append(int(distances.min(1).argmax()))
        distances = np.hstack([distances, shape.geodesics_from(np.array(chosen[-1:]))])
    return np.array(chosen), distances
