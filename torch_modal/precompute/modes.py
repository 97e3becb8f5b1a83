"""Public functions that compute modal bases of key-frames."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from torch_modal.io.cache import Cache
from torch_modal.keyframes.check import MeshError, MeshWarning, check_keyframes, require_area, require_solid
from torch_modal.precompute.basis import ModalBasis
from torch_modal.precompute.eigen import ENOUGH, N_RIGID, ModalAnalysisError
from torch_modal.precompute.filling import MESHERS, Filler
from torch_modal.precompute.method import METHODS, Method, why_shell
from torch_modal.precompute.solving import KeyframeSet, Solved, naming_keyframe
from torch_modal.precompute.stiffness import HESSIAN_FORMS, HessianForm
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import Mesher, TetrahedralizationError
from torch_modal.precompute.tetwild import TetrahedraSettings
from torch_modal.progress import Progress, ProgressReport, logger

QUALITIES = {
    "fast": TetrahedraSettings(),
    "fine": TetrahedraSettings(edge_length_fac=0.02, epsilon=1e-3, stop_energy=10.0, max_surface_faces=10_000),
}
"""Named settings (``docs/precompute.md``)."""

TIMEOUT = 600.0
"""Time limit of fTetWild for a key-frame, in seconds."""


def extract_modes(
    vertices: Any,
    faces: Any,
    n_modes: int = 30,
    *,
    method: Method = "auto",
    form: HessianForm = "edge",
    settings: TetrahedraSettings | str = "fast",
    mesher: Mesher | str = "lattice",
    tolerance: float = ENOUGH,
    timeout: float = TIMEOUT,
    cache_dir: str | None = None,
    cache: bool = True,
) -> ModalBasis:
    """Lowest vibration modes of one shape: `extract_bases` for a single key-frame, with the same options.

    Args:
        vertices: Positions, tensor or array, any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: Number of elastic modes, k.
        method: ``"auto"``, ``"solid"`` or ``"shell"``.
        form: Form of the solid's Hessian.
        settings: ``"fast"``, ``"fine"``, or numbers.
        mesher: ``"lattice"``, ``"tetwild"``, or an object.
        tolerance: Largest relative residual of a mode.
        timeout: Time limit of fTetWild, in seconds.
        cache_dir: Folder of the cache.
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
        method=method,
        form=form,
        settings=settings,
        mesher=mesher,
        tolerance=tolerance,
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
    method: Method = "auto",
    form: HessianForm = "edge",
    settings: TetrahedraSettings | str = "fast",
    mesher: Mesher | str = "lattice",
    tolerance: float = ENOUGH,
    carry: bool = True,
    timeout: float = TIMEOUT,
    cache_dir: str | None = None,
    cache: bool = True,
    progress: Progress = None,
) -> list[ModalBasis]:
    """Lowest vibration modes of each key-frame.

    They are the lowest elastic solutions of ``K phi = lambda M phi``, of the solid inside the surface or of the surface
    itself. For the solid, the key-frame of least self-proximity is filled with tetrahedra, which are carried to the
    others; ``K`` is the as-rigid-as-possible stiffness and the density 1. For the surface, ``K`` is the Gauss-Newton
    Hessian of edge lengths and dihedral angles in Eq. 5 at rest, and ``M`` the mass of a sheet whose thickness is a
    hundredth of its size (:func:`~torch_modal.geometry.canonical.size`) at a density of 1. Small loose pieces follow
    the nearest part of the body. Modes contain no relative rigid motions of larger pieces: these have no energy, and
    in-betweens take them from the interpolation of the key-frames. Nothing is differentiated.

    Args:
        keyframes: Positions, tensor or array, any units. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: Number of elastic modes of each, k.
        method: ``"solid"``; ``"shell"``, for the surface itself, which may be open, flat or not manifold; or
            ``"auto"``: the solid, but the shell where a key-frame is open or thin or the solid fails
            (:func:`~torch_modal.precompute.method.why_shell`), which a line of the log says. All key-frames have the
            same.
        form: Form of the solid's Hessian, see :func:`~torch_modal.precompute.stiffness.arap_hessian`.
        settings: How fine the tetrahedra are: ``"fast"``, ``"fine"``, or numbers.
        mesher: What fills the surface: ``"lattice"``, which is deterministic, finer where the body is thin, and accepts
            every surface; ``"tetwild"``, fTetWild in a child process; or a
            :class:`~torch_modal.precompute.tetrahedra.Mesher`, which has settings of its own.
        tolerance: Largest residual ``|K phi - lambda M phi| / (lambda |M phi|)`` of a mode, unless rounding leaves
            more. At 1e-3 modes lie within 1e-4 of the space of the exact ones, at 1e-6 each is one of these.
        carry: Whether the tetrahedra of one key-frame are carried to the others. Otherwise each is meshed.
        timeout: Time limit of fTetWild for a key-frame, in seconds.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Whether results are kept on disk and found there.
        progress: A bar with key-frame and stage: see :data:`torch_modal.progress.Progress`.

    Returns:
        One basis for each key-frame: float64, on the CPU, without gradient.

    Raises:
        MeshError: A mesh cannot work.
        ValueError: ``n_modes`` is more than the shape has, or a setting is out of range.
        TetrahedralizationError: The mesher failed or took too long.
        ModalAnalysisError: The modes failed a check.

    Warns:
        MeshWarning: The warnings of `check_keyframes`; a shape of several loose pieces.
    """
    if method not in METHODS:
        raise ValueError(f"the method is {method!r}; give one of {METHODS}")
    if form not in HESSIAN_FORMS:
        raise ValueError(f"the Hessian form is {form!r}; give one of {HESSIAN_FORMS}")
    if not 0 < tolerance < np.inf:
        raise ValueError(f"the tolerance is {tolerance!r}; give a positive number, {ENOUGH:g} by default")
    filler = Filler(_mesher(mesher, settings), timeout, Cache.at(cache_dir, enabled=cache))
    positions, working_faces = check_keyframes(keyframes, faces)
    return bases_of_checked(
        positions,
        working_faces,
        n_modes,
        filler,
        method=method,
        form=form,
        tolerance=tolerance,
        carry=carry,
        progress=progress,
    )


def bases_of_checked(
    keyframes: torch.Tensor,
    faces: torch.Tensor,
    n_modes: int,
    filler: Filler | None = None,
    *,
    method: Method = "auto",
    form: HessianForm = "edge",
    tolerance: float = ENOUGH,
    carry: bool = True,
    progress: Progress = None,
    meanwhile: Callable[[], object] | None = None,
) -> list[ModalBasis]:
    """`extract_bases` for the output of :func:`~torch_modal.keyframes.check.check_keyframes`.

    ``filler`` has the mesher and the cache; ``meanwhile`` is a background task for an idle processor.
    """
    filler = filler or Filler(_mesher("lattice", "fast"), TIMEOUT, Cache.at(None))
    shapes = keyframes.detach().cpu().double().numpy()
    triangles = faces.cpu().numpy()
    _check_n_modes(n_modes, len(np.unique(triangles)))
    surfaces: list[CanonicalSurface] = []
    for index, shape in enumerate(shapes):
        with naming_keyframe(index, len(shapes)):
            require_area(shape, triangles)
            surfaces.append(CanonicalSurface.of(shape, triangles))

    with ProgressReport(2 * len(shapes), "vibration modes", progress) as bar:
        work = KeyframeSet(surfaces, shapes.shape[1], filler, n_modes, tolerance, bar, meanwhile)

        def solids() -> list[Solved]:
            for index, shape in enumerate(shapes):
                with naming_keyframe(index, len(shapes)):
                    require_solid(shape, triangles)
            return work.solids(form, carry)

        solved = _solved(work, method, solids)
    _warn_of_pieces(solved)
    return [
        ModalBasis(
            reference=torch.from_numpy(shape.copy()),
            eigenvalues=torch.from_numpy(one.eigenvalues),
            modes=torch.from_numpy(one.modes),
            rigid_eigenvalues=torch.from_numpy(one.rigid_eigenvalues),
        )
        for shape, one in zip(shapes, solved, strict=True)
    ]


def _solved(work: KeyframeSet, method: Method, solids: Callable[[], list[Solved]]) -> list[Solved]:
    """The modes by a method; if one that was chosen here fails, by the other."""
    if method != "auto":
        return solids() if method == "solid" else work.shells()
    reason = why_shell(work.surfaces)
    if reason:
        logger.info("modes of the surface itself, not of a solid: %s", reason)
    first, second = (work.shells, solids) if reason else (solids, work.shells)
    try:
        return first()
    except (TetrahedralizationError, ModalAnalysisError) as error:
        if isinstance(error, TetrahedralizationError) and np.isfinite(error.fails_until):
            raise  # another attempt may succeed, and the same call should give the same modes
        work.filler.stop.clear()
        logger.info("modes of %s: %s", "a solid" if reason else "the surface itself, not of a solid", error)
        work.bar.expect(2 * len(work.surfaces))
        try:
            return second()
        except (MeshError, TetrahedralizationError, ModalAnalysisError):
            raise error from None


def _mesher(mesher: Mesher | str, settings: TetrahedraSettings | str) -> Mesher:
    if not isinstance(settings, TetrahedraSettings):
        if settings not in QUALITIES:
            raise ValueError(f"settings are {settings!r}; give TetrahedraSettings or one of {tuple(QUALITIES)}")
        settings = QUALITIES[settings]
    if not isinstance(mesher, str):
        return mesher
    if mesher not in MESHERS:
        raise ValueError(f"the mesher is {mesher!r}; give a Mesher or one of {tuple(MESHERS)}")
    return MESHERS[mesher](settings)


def _check_n_modes(n_modes: int, n_used: int) -> None:
    if isinstance(n_modes, bool) or not isinstance(n_modes, (int, np.integer)) or n_modes < 1:
        raise ValueError(f"n_modes is {n_modes!r}; give a whole number of at least 1")
    possible = 3 * n_used - N_RIGID
    if n_modes > possible:
        raise ValueError(
            f"{n_modes} modes requested, but a surface of {n_used} vertices has at most {possible} ways to "
            f"deform; give 1 to {possible}"
        )


def _warn_of_pieces(solved: list[Solved]) -> None:
    """Warn once if a set has loose pieces."""
    loose = [one for one in solved if one.n_zero > N_RIGID]
    if loose:
        n_pieces = max(one.n_pieces for one in loose)
        warnings.warn(
            f"the shape has {n_pieces} loose pieces, or parts hung on an edge or a vertex: modes deform each of them, "
            "and how they move against each other is left to the interpolation of the key-frames; join them if they "
            "belong together",
            MeshWarning,
            stacklevel=4,
        )
