"""Modes of all key-frames of a set, computed in parallel threads."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray
from torch_modal.errors import MeshError
from torch_modal.io.cache import Arrays, Cache
from torch_modal.precompute.eigen import N_RIGID, ModalAnalysisError, Scale, lowest_modes
from torch_modal.precompute.filling import Body, Filler, Filling, meshing_order
from torch_modal.precompute.following import Larger, deforming, larger_pieces
from torch_modal.precompute.parallel import Budget, StoppedError, run_all
from torch_modal.precompute.proximity import separation
from torch_modal.precompute.shell import Sheet
from torch_modal.precompute.stiffness import HessianForm, arap_hessian
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import TetrahedralizationError, loose_pieces
from torch_modal.progress import ProgressReport

MAX_SEPARATION = 0.014
"""Largest separation of parts in contact at which carrying is tried
(:func:`~torch_modal.precompute.proximity.separation`). On the samples and five data sets carrying worked up to 0.0105,
never from 0.0127 on."""
VERTICES_AT_ONCE = 30_000
"""Total size of concurrent eigenproblems: about 2 GiB."""


class Solved(NamedTuple):
    """Modes of a key-frame in the caller's units.

    Attributes:
        eigenvalues: Ascending. *Shape:* ``(k,)``.
        modes: Displacements of all vertices, zero at unreferenced ones. *Shape:* ``(k, V, 3)``.
        rigid_eigenvalues: Zero up to rounding. *Shape:* ``(6,)``.
        n_zero: Number of zero eigenvalues, including the six rigid ones.
        n_pieces: Number of loose pieces, without small ones.
    """

    eigenvalues: FloatArray
    modes: FloatArray
    rigid_eigenvalues: FloatArray
    n_zero: int
    n_pieces: int = 1


class Elastic(Protocol):
    """An elastic body whose modes are computed, with ``N`` vertices."""

    @property
    def surface(self) -> CanonicalSurface:
        """The key-frame."""
        ...

    @property
    def size(self) -> int:
        """About the number of vertices."""
        ...

    def inputs(self) -> tuple[Arrays, dict[str, Any]]:
        """Everything that the modes depend on."""
        ...

    @property
    def points(self) -> FloatArray:
        """Vertices. *Shape:* ``(N, 3)``."""
        ...

    @property
    def n_pieces(self) -> int:
        """Number of loose pieces."""
        ...

    @property
    def scale(self) -> Scale | None:
        """Orders of eigenvalues, as for :func:`~torch_modal.precompute.eigen.lowest_modes`."""
        ...

    def stiffness(self) -> sp.csc_matrix:
        """*Shape:* ``(3N, 3N)``."""
        ...

    def mass(self) -> sp.csr_matrix:
        """*Shape:* ``(N, N)``."""
        ...

    def carried(self, motions: FloatArray) -> FloatArray:
        """Motions at the points of the surface. *Shape:* ``(N, 3, k) -> (U, 3, k)``."""
        ...


@dataclass(frozen=True)
class Solid:
    """The solid inside a surface, see :class:`Elastic`.

    Attributes:
        filling: Its tetrahedra.
        form: Form of the Hessian.
    """

    filling: Filling
    form: HessianForm
    scale: Scale | None = None

    @property
    def surface(self) -> CanonicalSurface:
        """The key-frame."""
        return self.filling.surface

    @property
    def size(self) -> int:
        """Number of vertices of the tetrahedra."""
        return len(self.filling.tetrahedra.vertices)

    def inputs(self) -> tuple[Arrays, dict[str, Any]]:
        """Everything that the modes depend on."""
        return self.filling.content(), {"form": self.form}

    @cached_property
    def _larger(self) -> Larger:
        return larger_pieces(self.filling.tetrahedra)

    @property
    def points(self) -> FloatArray:
        """Vertices of the larger pieces. *Shape:* ``(N, 3)``."""
        return self._larger.tetrahedra.vertices

    @cached_property
    def n_pieces(self) -> int:
        """Number of larger pieces."""
        return int(loose_pieces(self._larger.tetrahedra).max()) + 1

    def stiffness(self) -> sp.csc_matrix:
        """As-rigid-as-possible stiffness. *Shape:* ``(3N, 3N)``."""
        return arap_hessian(self._larger.tetrahedra, self.form)

    def mass(self) -> sp.csr_matrix:
        """Mass of a density of 1. *Shape:* ``(N, N)``."""
        return self.filling.mass()[self._larger.vertices][:, self._larger.vertices]

    def carried(self, motions: FloatArray) -> FloatArray:
        """Motions at the points of the surface, embedded in the tetrahedra. *Shape:* ``(N, 3, k) -> (U, 3, k)``."""
        weights = sp.csr_matrix(self.filling.weights() @ self._larger.weights)
        return (weights @ motions.reshape(len(motions), -1)).reshape(-1, *motions.shape[1:])


@dataclass(frozen=True)
class KeyframeSet:
    """Key-frames whose modes are computed.

    Attributes:
        surfaces: Canonical surfaces.
        n_vertices: Number of vertices of each, including unreferenced ones.
        filler: Mesher and cache.
        n_modes: Number of elastic modes of each.
        tolerance: Residual of the modes.
        bar: Updated twice for each key-frame.
        meanwhile: Background task, see :func:`~torch_modal.precompute.parallel.run_all`.
    """

    surfaces: list[CanonicalSurface]
    n_vertices: int
    filler: Filler
    n_modes: int
    tolerance: float
    bar: ProgressReport
    meanwhile: Callable[[], object] | None = None
    _memory: Budget = field(default_factory=lambda: Budget(VERTICES_AT_ONCE))

    def shells(self) -> list[Solved]:
        """Modes of all surfaces themselves."""

        def solve_one(index: int) -> Solved:
            sheet = Sheet(self.surfaces[index], self.n_modes)
            self.bar.update()
            return self._solved(index, sheet)

        return run_all(solve_one, len(self.surfaces), self.filler.stop, self.meanwhile)

    def solids(self, form: HessianForm, carry: bool) -> list[Solved]:
        """Modes of the solids inside, with separate tetrahedra, or with carried ones where possible.

        Args:
            form: Form of the Hessian.
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
                return self._solved(index, Solid(own[index], form))
            carried = self._carried(own[first].body, index) if own else None
            if carried is not None:
                with contextlib.suppress(ModalAnalysisError):  # too distorted: mesh separately
                    return self._solved(index, Solid(carried, form))
            return self._solved(index, Solid(self._own(index, counted=carried is None), form))

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

    def _solved(self, index: int, body: Elastic) -> Solved:
        """The modes of a key-frame."""
        with self._memory.part(body.size), self._stage(index, "modes"):
            solved = solve(self.n_vertices, body, self.n_modes, self.tolerance, self.filler.cache)
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
        named = type(error)(f"key-frame {index}: {error}")
        named.__dict__.update(error.__dict__)  # how long a failure lasts
        raise named from error


def solve(n_vertices: int, body: Elastic, n_modes: int, tolerance: float, cache: Cache) -> Solved:
    """Modes of a body at the points of its surface, in the caller's units.

    Args:
        n_vertices: Number of vertices of the key-frame, including unreferenced ones.
        body: The body.
        n_modes: Number of elastic modes.
        tolerance: Residual of the modes, see :func:`~torch_modal.precompute.eigen.lowest_modes`.
        cache: Storage of modes.

    Raises:
        ModalAnalysisError: The modes failed a check.
    """
    surface = body.surface

    def compute() -> dict[str, NDArray[Any]]:
        try:
            n_wanted = min(n_modes + N_RIGID * (body.n_pieces - 1), max(n_modes, body.points.size - N_RIGID))
            found = lowest_modes(body.stiffness(), body.mass(), body.points, n_wanted, tolerance, body.scale)
            columns = found.modes.reshape(len(body.points), 3, -1)
            modes = np.ascontiguousarray(body.carried(columns).transpose(2, 0, 1))
            n_zero = min(found.n_zero - N_RIGID, len(modes))
            modes = np.concatenate([deforming(modes[:n_zero], surface), modes[n_zero:]])
            if len(modes) < n_modes:
                raise ModalAnalysisError(
                    f"only {len(modes)} modes deform the {body.n_pieces} loose pieces, {n_modes} are requested; "
                    "request fewer, or give a smaller edge_length_fac"
                )
            eigenvalues = found.eigenvalues[len(found.eigenvalues) - len(modes) :]
        except ModalAnalysisError:
            raise
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise ModalAnalysisError(
                f"the modes cannot be computed: {error}; the mesh is likely degenerate: check the surface, or try "
                "another method or mesher"
            ) from error
        return {
            "eigenvalues": eigenvalues[:n_modes],
            "modes": modes[:n_modes],
            "rigid_eigenvalues": found.rigid_eigenvalues,
            "n_zero": np.array([found.n_zero]),
            "n_pieces": np.array([body.n_pieces]),
        }

    inputs, parameters = body.inputs()
    result = cache.get("modes", inputs, {"n_modes": int(n_modes), "tolerance": float(tolerance), **parameters}, compute)
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
