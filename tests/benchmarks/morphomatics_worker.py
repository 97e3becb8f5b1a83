"""In-betweens by morphomatics, in a process of its own: ``python morphomatics_worker.py request.npz answer.npz``.

The Python that runs this needs morphomatics, not torch or torch_modal. The shape space (gradient and divergence of the
reference, factors of its Poisson system, geodesic compiled by ``jax.jit``) is made first, and timed for itself, once;
what else is timed goes from key-frames to in-betweens.
"""

import sys
import time

import jax
import numpy as np
from morphomatics.geom import Surface
from morphomatics.manifold import DifferentialCoords
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from timing import timed


class PinnedCoords(DifferentialCoords):
    """Differential coordinates of a surface that may have several pieces.

    Gradients do not see where a piece lies, and the library pins one vertex of all: here it is one of each piece, and
    the pieces are put where they lie in the linear in-between.
    """

    def update_ref_geom(self, v: np.ndarray) -> None:
        super().update_ref_geom(v)
        f = self.ref.f
        links = sparse.coo_matrix((np.ones(2 * len(f)), (f[:, :2].T.ravel(), f[:, 1:].T.ravel())), (len(v), len(v)))
        self.n_pieces, self.piece = connected_components(links, directed=False)
        if self.n_pieces > 1:
            pins = np.unique(self.piece, return_index=True)[1]
            pin = sparse.coo_matrix((np.ones(len(pins)), (pins, pins)), (len(v), len(v)))
            self.poisson = sparse.linalg.factorized((self.ref.div @ self.ref.grad + pin).tocsc())

    def centred(self, x: np.ndarray, like: np.ndarray) -> np.ndarray:
        """Each piece moved to the centroid that it has in another shape."""
        if self.n_pieces == 1:
            return x
        size = np.bincount(self.piece)[:, None]
        gap = [np.bincount(self.piece, (like - x)[:, axis]) for axis in range(3)]
        return x + (np.stack(gap, axis=1) / size)[self.piece]


def main(request: str, answer: str) -> None:
    """Read key-frames, write frames and seconds."""
    given = np.load(request)
    x_a, x_b, faces = given["x_a"], given["x_b"], given["faces"]
    begin = time.process_time()
    made = PinnedCoords(Surface(x_a.copy(), faces))

    @jax.jit
    def geodesic(a: jax.Array, b: jax.Array, t: float) -> jax.Array:
        return made.connec.exp(a, t * made.connec.log(a, b))

    def frames() -> np.ndarray:
        a, b = made.to_coords(x_a), made.to_coords(x_b)
        shapes = [np.asarray(made.from_coords(geodesic(a, b, float(t)))) for t in given["times"]]
        return np.stack([made.centred(x, (1 - t) * x_a + t * x_b) for x, t in zip(shapes, given["times"], strict=True)])

    frames()
    making = time.process_time() - begin
    result, seconds = timed(frames)
    np.savez(answer, frames=result, seconds=seconds, making=making - seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
