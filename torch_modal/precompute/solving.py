"""Modes of all key-frames of a set, computed in parallel threads."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray
from torch_modal.errors import MeshError
from torch_modal.io.cache import Cache
from torch_modal.precompute.eigen import N_RIGID, ModalAnalysisError, VolumeModes, lowest_modes
from torch_modal.precompute.filling import Body, Filler, Filling, meshing_order
from torch_modal.precompute.following import deforming, larger_pieces
from torch_modal.precompute.parallel import Budget, StoppedError, run_all
from torch_modal.precompute.proximity import separation
from torch_modal.precompute.stiffness import HessianForm, arap_hessian
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import TetrahedralizationError, loose_pieces
from torch_modal.progress import ProgressReport

MAX_SEPARATION = 0.014
"""Largest separation of parts in contact at which carrying is tried
(:func:`~torch_modal.precompute.proximity.separation`). On the samples and five data sets carrying worked up to 0.0105,
never from 0.0127 on."""
VERTICES_AT_ONCE = 30_000
"""Total size of concurrent eigenproblems, in tetrahedral vertices: about 2 GiB."""


class Solved(NamedTuple):
    """Modes of a key-frame in the caller's units.

    Attributes:
        eigenvalues: Ascending. *Shape:* ``(k,)``.
        modes: Displacements of all vertices, zero at unreferenced ones. *Shape:* ``(k, V, 3)``.
        rigid_eigenvalues: Zero up to rounding. *Shape:* ``(6,)``.
        n_zero: Number of zero eigenvalues, including the six rigid ones.
        n_pieces: Number of loose pieces of the tetrahedra, without small ones.
    """

    eigenvalues: FloatArray
    modes: FloatArray
    rigid_eigenvalues: FloatArray
    n_zero: int
    n_pieces: int = 1


@dataclass(frozen=True)
class KeyframeSet:
    """Key-frames whose modes are computed.

    Attributes:
        surfaces: Canonical surfaces.
        n_vertices: Number of vertices of each, including unreferenced ones.
        filler: Mesher and cache.
        n_modes: Number of elastic modes of each.
        form: Form of the Hessian.
        tolerance: Residual of the modes.
        bar: Updated twice for each key-frame: after meshing and after the modes.
        meanwhile: Background task, see :func:`~torch_modal.precompute.parallel.run_all`.
    """

    surfaces: list[CanonicalSurface]
    n_vertices: int
    filler: Filler
    n_modes: int
    form: HessianForm
    tolerance: float
    bar: ProgressReport
    meanwhile: Callable[[], object] | None = None
    _memory: Budget = field(default_factory=lambda: Budget(VERTICES_AT_ONCE))

    def solve(self, carry: bool) -> list[Solved]:
        """Modes of all key-frames, with separate tetrahedra, or with carried ones where possible.

        Args:
            carry: Whether the tetrahedra of the key-frame of least self-proximity are carried to the others.
        """
        own: dict[int, Filling] = {}
        if carry and len(self.surfaces) > 1:
            first, *others = meshing_order(self.surfaces)
            rest = self.surfaces[first]
            # Key-frames with separating contacts are meshed in parallel with the first one.
            alone = [first, *(index for index in others if separation(rest, self.surfaces[index]) > MAX_SEPARATION)]
            made = run_all(lambda i: self._own(alone[i]), len(alone), self.filler.stop)
            own = dict(zip(alone, made, strict=True))

        def solve_one(index: int) -> Solved:
            if index in own:
                return self._solved(index, own[index])
            carried = self._carried(own[first].body, index) if own else None
            if carried is not None:
                with contextlib.suppress(ModalAnalysisError):  # too distorted: mesh separately
                    return self._solved(index, carried)
            return self._solved(index, self._own(index, counted=carried is None))

        return run_all(solve_one, len(self.surfaces), self.filler.stop, self.meanwhile)

    def _own(self, index: int, counted: bool = True) -> Filling:
        """Mesh a key-frame; counted as done unless carried tetrahedra were counted before."""
        with self._stage(index, "tetrahedra"):
            body = self.filler.body(self.surfaces[index])
        if counted:
            self.bar.update()
        return Filling(body, body.surface, body.tetrahedra)

    def _carried(self, body: Body, index: int) -> Filling | None:
        """Carry tetrahedra to a key-frame; None if the result is too distorted."""
        with self._stage(index, "carrying tetrahedra"):
            filling = self.filler.carried(body, self.surfaces[index])
        if filling is not None:
            self.bar.update()
        return filling

    def _solved(self, index: int, filling: Filling) -> Solved:
        """The modes of a key-frame."""
        with self._memory.part(len(filling.tetrahedra.vertices)), self._stage(index, "modes"):
            solved = solve(self.n_vertices, filling, self.n_modes, self.form, self.tolerance, self.filler.cache)
        self.bar.update()
        return solved

    @contextlib.contextmanager
    def _stage(self, index: int, what: str) -> Iterator[None]:
        """Report a stage of a key-frame, unless the work was cancelled; its errors name the key-frame."""
        n = len(self.surfaces)
        with naming_keyframe(index, n):
            if self.filler.stop.is_set():
                raise StoppedError
            self.bar.describe(f"key-frame {index + 1}/{n}: {what}")
            yield


@contextlib.contextmanager
def naming_keyframe(index: int, n_keyframes: int) -> Iterator[None]:
    """Prefix error messages with the index of the key-frame if there are several."""
    try:
        yield
    except (MeshError, TetrahedralizationError, ModalAnalysisError) as error:
        if n_keyframes == 1:
            raise
        raise type(error)(f"key-frame {index}: {error}") from error


def solve(n_vertices: int, filling: Filling, n_modes: int, form: HessianForm, tolerance: float, cache: Cache) -> Solved:
    """Modes of the tetrahedra, restricted to the surface, in the caller's units.

    Args:
        n_vertices: Number of vertices of the key-frame, including unreferenced ones.
        filling: The tetrahedra.
        n_modes: Number of elastic modes.
        form: Form of the Hessian.
        tolerance: Residual of the modes, see :func:`~torch_modal.precompute.eigen.lowest_modes`.
        cache: Storage of modes.

    Raises:
        ModalAnalysisError: The modes failed a check.
    """
    tetrahedra, surface = filling.tetrahedra, filling.surface

    def compute() -> dict[str, NDArray[Any]]:
        try:
            larger, vertices, weights = larger_pieces(tetrahedra)
            mass = filling.mass()[vertices][:, vertices]
            n_pieces = loose_pieces(larger).max() + 1
            n_wanted = min(n_modes + N_RIGID * (n_pieces - 1), max(n_modes, larger.vertices.size - N_RIGID))
            solid = lowest_modes(arap_hessian(larger, form), mass, larger.vertices, n_wanted, tolerance)
            modes = _restrict(sp.csr_matrix(filling.weights() @ weights), solid)
            n_zero = min(solid.n_zero - N_RIGID, len(modes))
            modes = np.concatenate([deforming(modes[:n_zero], surface), modes[n_zero:]])
            if len(modes) < n_modes:
                raise ModalAnalysisError(
                    f"only {len(modes)} modes deform the {n_pieces} loose pieces of the tetrahedra, {n_modes} are "
                    "requested; request fewer, or give a smaller edge_length_fac"
                )
            eigenvalues = solid.eigenvalues[len(solid.eigenvalues) - len(modes) :]
        except ModalAnalysisError:
            raise
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise ModalAnalysisError(
                f"the modes cannot be computed: {error}; the tetrahedra are likely degenerate: check the surface for "
                "parts without thickness, or try another mesher"
            ) from error
        return {
            "eigenvalues": eigenvalues[:n_modes],
            "modes": modes[:n_modes],
            "rigid_eigenvalues": solid.rigid_eigenvalues,
            "n_zero": np.array([solid.n_zero]),
            "n_pieces": np.array([n_pieces]),
        }

    result = cache.get(
        "modes", filling.content(), {"n_modes": int(n_modes), "form": form, "tolerance": float(tolerance)}, compute
    )
    modes = np.zeros((n_modes, n_vertices, 3))
    # lambda ~ 1 / length², and phi ~ length^(-3/2) since phi' M phi = 1 with a mass ~ length³.
    modes[:, surface.used] = result["modes"] @ surface.axes * surface.scale**1.5
    return Solved(
        result["eigenvalues"] * surface.scale**2,
        modes,
        result["rigid_eigenvalues"] * surface.scale**2,
        int(result["n_zero"][0]),
        int(result["n_pieces"][0]),
    )


def _restrict(weights: sp.csr_matrix, solid: VolumeModes) -> FloatArray:
    """Modes at the surface points, ``(k, U, 3)``, from columns with interleaved coordinates."""
    n, k = solid.modes.shape[0] // 3, solid.modes.shape[1]
    return (weights @ solid.modes.reshape(n, 3 * k)).reshape(-1, 3, k).transpose(2, 0, 1)
