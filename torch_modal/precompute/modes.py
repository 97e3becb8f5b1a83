"""From key-frames to modal bases: tetrahedra, stiffness, lowest modes, restriction to the surface."""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from tqdm import tqdm

from torch_modal.basis import ModalBasis
from torch_modal.keyframes import MeshError, MeshWarning, check_keyframes, require_solid
from torch_modal.precompute.arap import HESSIAN_FORMS, HessianForm, arap_hessian, lumped_mass
from torch_modal.precompute.cache import Cache
from torch_modal.precompute.eigen import N_RIGID, ModalAnalysisError, VolumeModes, lowest_modes
from torch_modal.precompute.embedding import embed_surface
from torch_modal.precompute.tetrahedra import (
    DIAGONAL,
    Tetrahedra,
    TetrahedralizationError,
    TetrahedraSettings,
    outward,
    tetrahedralize,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_DIAGONAL_RANGE = (1e-90, 1e90)


def extract_modes(
    vertices: Any,
    faces: Any,
    n_modes: int = 30,
    *,
    form: HessianForm = "element",
    settings: TetrahedraSettings | None = None,
    timeout: float = 600.0,
    cache_dir: str | None = None,
    cache: bool = True,
) -> ModalBasis:
    """Lowest vibration modes of one shape: `extract_bases` for a single key-frame.

    Args:
        vertices: Positions, tensor or array, any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: Number of elastic modes, k.
        form: Form of the Hessian, see :func:`~torch_modal.precompute.arap.arap_hessian`.
        settings: How fine the tetrahedra are.
        timeout: Seconds that the mesher may take.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Whether results are kept on disk and found there.

    Returns:
        The basis: float64, on the CPU, without gradient.

    Raises:
        MeshError: The mesh cannot work.
        ValueError: ``n_modes`` is more than the shape has, or a setting is out of range.
        TetrahedralizationError: The mesher failed or took too long.
        ModalAnalysisError: The modes failed a check.
    """
    return extract_bases(
        [vertices],
        faces,
        n_modes,
        form=form,
        settings=settings,
        timeout=timeout,
        cache_dir=cache_dir,
        cache=cache,
        progress=False,
    )[0]


def extract_bases(
    keyframes: Any,
    faces: Any,
    n_modes: int = 30,
    *,
    form: HessianForm = "element",
    settings: TetrahedraSettings | None = None,
    timeout: float = 600.0,
    cache_dir: str | None = None,
    cache: bool = True,
    progress: bool | None = None,
) -> list[ModalBasis]:
    """Lowest vibration modes of each key-frame.

    Each key-frame is filled with tetrahedra (in a child process), the as-rigid-as-possible stiffness and a
    lumped mass of density 1 give ``K phi = lambda M phi``, and its lowest elastic modes are restricted to the
    surface. Constants of the autograd graph: nothing here is differentiated.

    Args:
        keyframes: Positions, tensor or array, any units. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: Number of elastic modes of each, k.
        form: Form of the Hessian, see :func:`~torch_modal.precompute.arap.arap_hessian`.
        settings: How fine the tetrahedra are.
        timeout: Seconds that the mesher may take for a key-frame.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Whether results are kept on disk and found there.
        progress: Whether a bar shows key-frame and stage; by default on terminals only.

    Returns:
        One basis for each key-frame: float64, on the CPU, without gradient.

    Raises:
        MeshError: A mesh cannot work.
        ValueError: ``n_modes`` is more than the shape has, or a setting is out of range.
        TetrahedralizationError: The mesher failed or took too long.
        ModalAnalysisError: The modes failed a check.

    Warns:
        MeshWarning: What `check_keyframes` warns about; a shape of several loose pieces.
    """
    if form not in HESSIAN_FORMS:
        raise ValueError(f"the Hessian form is {form!r}; give one of {HESSIAN_FORMS}")
    positions, working_faces = check_keyframes(keyframes, faces)
    shapes = positions.detach().cpu().double().numpy()
    triangles = working_faces.cpu().numpy()
    _check_n_modes(n_modes, len(np.unique(triangles)))
    surfaces = []
    for index, shape in enumerate(shapes):
        with _naming_keyframe(index, len(shapes)):
            require_solid(shape, triangles)
            surfaces.append(_Surface.of(shape, triangles))

    kept = Cache.at(cache_dir, enabled=cache)
    with tqdm(total=2 * len(shapes), disable=None if progress is None else not progress, leave=False) as bar:

        def report(index: int, stage: str) -> None:
            bar.set_description(f"key-frame {index + 1}/{len(shapes)}: {stage}")

        fillings = _fill(surfaces, settings or TetrahedraSettings(), timeout, kept, report, bar.update)
        bases = []
        for index, (shape, surface, tetrahedra) in enumerate(zip(shapes, surfaces, fillings, strict=True)):
            report(index, "modes")
            with _naming_keyframe(index, len(shapes)):
                bases.append(_basis(shape, surface, tetrahedra, n_modes, form, kept))
            bar.update()
    return bases


@contextlib.contextmanager
def _naming_keyframe(index: int, n_keyframes: int) -> Iterator[None]:
    """Say in an error which of several key-frames it is about."""
    try:
        yield
    except (MeshError, TetrahedralizationError, ModalAnalysisError) as error:
        if n_keyframes == 1:
            raise
        raise type(error)(f"key-frame {index}: {error}") from error


@dataclass(frozen=True)
class _Surface:
    """A shape as the pre-computation sees it: used vertices only, centred, a bounding-box diagonal of 100.

    Attributes:
        points: *Shape:* ``(U, 3)``.
        faces: Indices into ``points``, wound counterclockwise seen from outside. *Shape:* ``(F, 3)``.
        used: Which vertices of the shape the points are. *Shape:* ``(U,)``.
        scale: Units here per unit of the caller.
    """

    points: FloatArray
    faces: IntArray
    used: IntArray
    scale: float

    @classmethod
    def of(cls, shape: FloatArray, faces: IntArray) -> "_Surface":
        used, compact = np.unique(faces, return_inverse=True)
        points = shape[used]
        low, high = points.min(axis=0), points.max(axis=0)
        diagonal = float(np.linalg.norm(high - low))
        if not _DIAGONAL_RANGE[0] < diagonal < _DIAGONAL_RANGE[1]:
            raise MeshError(
                f"the bounding-box diagonal is {diagonal:.3g}, at which eigenvalues leave the range of "
                "float64; choose another unit"
            )
        points = (points - (low + high) / 2) * (DIAGONAL / diagonal)
        return cls(points, outward(points, compact.reshape(-1, 3)), used, DIAGONAL / diagonal)

    def normals(self) -> FloatArray:
        """Outward unit normals of the points, zero where the faces have no area. *Shape:* ``(U, 3)``."""
        corners = self.points[self.faces]
        weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        summed = np.stack(
            [np.bincount(self.faces.reshape(-1), np.repeat(c, 3), minlength=len(self.points)) for c in weighted.T],
            axis=1,
        )
        return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-300)


def _fill(
    surfaces: list[_Surface],
    settings: TetrahedraSettings,
    timeout: float,
    cache: Cache,
    report: Callable[[int, str], None],
    done: Callable[[], object],
) -> list[Tetrahedra]:
    """Tetrahedra of every key-frame, in the units of the surfaces.

    Each key-frame has its own; nothing outside this function depends on that.
    """
    fillings = []
    for index, surface in enumerate(surfaces):
        report(index, "tetrahedra")

        def compute(surface: _Surface = surface) -> dict[str, NDArray[Any]]:
            return tetrahedralize(surface.points, surface.faces, settings, timeout=timeout)._asdict()

        with _naming_keyframe(index, len(surfaces)):
            inputs = {"points": surface.points, "faces": surface.faces}
            fillings.append(Tetrahedra(**cache.get("tetrahedra", inputs, asdict(settings), compute)))
        done()
    return fillings


def _basis(
    shape: FloatArray,
    surface: _Surface,
    tetrahedra: Tetrahedra,
    n_modes: int,
    form: HessianForm,
    cache: Cache,
) -> ModalBasis:
    """Modes of the tetrahedra, restricted to the surface, in the caller's units."""

    def compute() -> dict[str, NDArray[Any]]:
        solid = lowest_modes(arap_hessian(tetrahedra, form), lumped_mass(tetrahedra), tetrahedra.vertices, n_modes)
        weights = embed_surface(surface.points, tetrahedra, surface.normals())
        return {
            "eigenvalues": solid.eigenvalues,
            "modes": _restrict(weights, solid),
            "rigid_eigenvalues": solid.rigid_eigenvalues,
            "n_zero": np.array(solid.n_zero),
        }

    inputs = {"points": surface.points, "faces": surface.faces, **tetrahedra._asdict()}
    result = cache.get("modes", inputs, {"n_modes": n_modes, "form": form}, compute)
    if result["n_zero"] > N_RIGID:
        _warn_of_loose_pieces(tetrahedra, int(result["n_zero"]))
    modes = np.zeros((n_modes, *shape.shape))
    # lambda ~ 1 / length², and phi ~ length^(-3/2) since phi' M phi = 1 with a mass ~ length³.
    modes[:, surface.used] = result["modes"] * surface.scale**1.5
    return ModalBasis(
        reference=torch.from_numpy(shape.copy()),
        eigenvalues=torch.from_numpy(result["eigenvalues"] * surface.scale**2),
        modes=torch.from_numpy(modes),
        rigid_eigenvalues=torch.from_numpy(result["rigid_eigenvalues"] * surface.scale**2),
    )


def _restrict(weights: sp.csr_matrix, solid: VolumeModes) -> FloatArray:
    """Modes at the surface points, ``(k, U, 3)``, from columns with interleaved coordinates."""
    n, k = solid.modes.shape[0] // 3, solid.modes.shape[1]
    return (weights @ solid.modes.reshape(n, 3 * k)).reshape(-1, 3, k).transpose(2, 0, 1)


def _check_n_modes(n_modes: int, n_used: int) -> None:
    if isinstance(n_modes, bool) or not isinstance(n_modes, (int, np.integer)) or n_modes < 1:
        raise ValueError(f"n_modes is {n_modes!r}; give a whole number of at least 1")
    possible = 3 * n_used - N_RIGID
    if n_modes > possible:
        raise ValueError(
            f"{n_modes} modes asked for, but a surface of {n_used} vertices has at most {possible} ways to "
            f"deform; give 1 to {possible}"
        )


def _warn_of_loose_pieces(tetrahedra: Tetrahedra, n_zero: int) -> None:
    n, t = len(tetrahedra.vertices), len(tetrahedra.tets)
    pairs = (np.ones(3 * t), (np.repeat(tetrahedra.tets[:, 0], 3), tetrahedra.tets[:, 1:].reshape(-1)))
    n_pieces = connected_components(sp.coo_matrix(pairs, shape=(n, n)), directed=False)[0]
    warnings.warn(
        f"the shape has {n_pieces} loose pieces, or parts hung on an edge or a vertex: {n_zero - N_RIGID} "
        "of its first modes move them without deforming them; join them, or ask for that many more modes",
        MeshWarning,
        stacklevel=4,
    )
