"""Modal bases of key-frames: from meshes to the modes of their vertices."""

import contextlib
import functools
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
import torch

from torch_modal.arrays import ArrayLike, FloatArray, IntArray
from torch_modal.errors import MeshError, MeshWarning, ModalAnalysisError
from torch_modal.geometry.bodies import bodies
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import OPEN, open_part
from torch_modal.io.cache import Arrays, Cache
from torch_modal.keyframes.check import check_keyframes
from torch_modal.modes.basis import ModalBasis
from torch_modal.modes.carrying import Carrier
from torch_modal.modes.eigen import N_RIGID, ElasticBody, lowest_modes
from torch_modal.modes.lattice import Lattice
from torch_modal.modes.sheet import n_coarse_faces, sheet_body
from torch_modal.modes.solid import Solid
from torch_modal.modes.stiffness import HESSIAN_FORMS, HessianForm
from torch_modal.modes.surface import CanonicalSurface, self_proximity
from torch_modal.modes.tetrahedra import Mesher, MesherError
from torch_modal.modes.tetwild import Auto, TetWild
from torch_modal.progress import Progress, ProgressReport, logger
from torch_modal.threads import StoppedError, one_blas_thread, run

Method = Literal["auto", "solid", "shell"]
METHODS: tuple[Method, ...] = ("auto", "solid", "shell")
MESHERS: dict[str, Callable[[], Mesher]] = {"auto": Auto, "lattice": Lattice, "tetwild": TetWild}
"""Constructors of meshers by name."""

THINNEST_SOLID = 0.01
"""Mean thickness, in roots of the area, below which the shell is taken."""
VERTICES_AT_ONCE = 30_000
"""Total size of concurrent eigenproblems: about 2 GiB."""


def extract_modes(vertices: ArrayLike, faces: ArrayLike, n_modes: int = 30, **options: Any) -> ModalBasis:
    """Lowest vibration modes of one shape: `extract_bases` for a single key-frame, with the same errors and warnings.

    Args:
        vertices: Positions, tensor or array, any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: Number of elastic modes, k.
        options: Further arguments of :func:`extract_bases`; no bar is shown unless ``progress`` is given.

    Returns:
        The basis: float64, on the CPU, without gradient.
    """
    return extract_bases([vertices], faces, n_modes, **{"progress": False, **options})[0]


def extract_bases(
    keyframes: ArrayLike,
    faces: ArrayLike,
    n_modes: int = 30,
    *,
    method: Method = "auto",
    form: HessianForm = "edge",
    mesher: Mesher | str = "auto",
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
        n_modes: Number of elastic modes of each, k. Bodies far from each other (docs/input.md) have so many each.
        method: ``"solid"``; ``"shell"``, for the surface itself, which may be open, flat or not manifold; or
            ``"auto"``: the solid, but the shell where a key-frame is open or thin or the solid fails
            (:func:`why_shell`), which a line of the log says. All key-frames have the same.
        form: Form of the solid's Hessian: ``"edge"``, or ``"vertex"``, the paper's
            (:func:`~torch_modal.modes.stiffness.arap_hessian`).
        mesher: Fills the surface with tetrahedra: ``"lattice"``, which is deterministic, finer where the body is thin,
            and accepts every surface; ``"tetwild"``, fTetWild in a child process; ``"auto"``, the lattice unless parts
            of every key-frame touch, which it would fuse; or an object with settings,
            :class:`~torch_modal.modes.lattice.Lattice`, :class:`~torch_modal.modes.tetwild.TetWild` or
            another :class:`~torch_modal.modes.tetrahedra.Mesher`.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Whether results are kept on disk and found there.
        progress: A bar with key-frame and stage: see :data:`torch_modal.progress.Progress`.

    Returns:
        One basis for each key-frame: float64, on the CPU, without gradient.

    Raises:
        MeshError: A mesh cannot work.
        ValueError: ``n_modes`` is more than the shape has, or a setting is out of range.
        ModalAnalysisError: The mesher failed or took too long.
        ModalAnalysisError: The modes failed a check.

    Warns:
        MeshWarning: The warnings of `check_keyframes`; a shape of several loose pieces.
    """
    store = Cache.at(cache_dir, enabled=cache)
    return bases_of_checked(*check_keyframes(keyframes, faces), n_modes, method, form, mesher, store, progress)


def bases_of_checked(
    keyframes: torch.Tensor,
    faces: torch.Tensor,
    n_modes: int,
    method: Method = "auto",
    form: HessianForm = "edge",
    mesher: Mesher | str = "auto",
    cache: Cache | None = None,
    progress: Progress = None,
    stacklevel: int = 3,
) -> list[ModalBasis]:
    """`extract_bases` for the output of :func:`~torch_modal.keyframes.check.check_keyframes`.

    Its warning names the line that is so many calls above.
    """
    for what, choice, choices in (("method", method, METHODS), ("Hessian form", form, HESSIAN_FORMS)):
        if choice not in choices:
            raise ValueError(f"the {what} is {choice!r}; give one of {choices}")
    if isinstance(mesher, str):
        if mesher not in MESHERS:
            raise ValueError(f"the mesher is {mesher!r}; give a Mesher or one of {tuple(MESHERS)}")
        mesher = MESHERS[mesher]()
    shapes, triangles = keyframes.detach().cpu().double().numpy(), faces.cpu().numpy()
    mesh = Connectivity(triangles, shapes.shape[1])
    possible = 3 * len(mesh.used) - N_RIGID
    if type(n_modes) is bool or not isinstance(n_modes, (int, np.integer)) or not 1 <= n_modes <= possible:
        raise ValueError(
            f"n_modes is {n_modes!r}, but a surface of {len(mesh.used)} vertices has at most {possible} ways to "
            f"deform; give a whole number of 1 to {possible}"
        )
    several = bodies(shapes, mesh)
    if len(several) > 1:
        with contextlib.suppress(MeshError, ModalAnalysisError):  # the whole may have modes, nevertheless
            return _bases_of_bodies(several, torch.from_numpy(shapes), n_modes, method, form, mesher, cache, progress)
    with one_blas_thread(), ProgressReport(len(shapes), "vibration modes", progress) as bar:
        extraction = _Extraction(shapes, triangles, int(n_modes), mesher, cache or Cache.at(None), bar)
        results = extraction.by(method, form)
    if n_pieces := [np.max(result["n_pieces"]) for result in results if np.max(result["n_zero"]) > N_RIGID]:
        warnings.warn(
            f"the shape has {max(n_pieces)} loose pieces, or parts hung on an edge or a vertex: modes deform each, and "
            "how they move against each other is left to the interpolation of the key-frames; join them if they "
            "belong together",
            MeshWarning,
            stacklevel=stacklevel,
        )
    bases = []
    for shape, surface, result in zip(shapes, extraction.surfaces, results, strict=True):
        # lambda ~ 1 / length², and phi ~ length^(-3/2) since phi' M phi = 1 with a mass ~ length³.
        modes = np.zeros((n_modes, *shape.shape))
        modes[:, surface.used] = result["modes"] @ surface.axes * surface.scale**1.5
        values = [result[name] * surface.scale**2 for name in ("eigenvalues", "rigid_eigenvalues")]
        bases.append(ModalBasis(*map(torch.from_numpy, (shape.copy(), values[0], modes, values[1]))))
    return bases


def _bases_of_bodies(several: Sequence[Any], keyframes: torch.Tensor, n_modes: int, *options: Any) -> list[ModalBasis]:
    """Bases with the modes of each body, which are zero on the others. *Shape:* ``(K, V, 3)``."""
    bases_of_bodies = []
    for vertices, mesh in several:
        most = min(n_modes, 3 * len(mesh.used) - N_RIGID)
        bases_of_bodies.append(bases_of_checked(keyframes[:, vertices], torch.tensor(mesh.faces), most, *options))
    bases = []
    for shape, *parts in zip(keyframes, *bases_of_bodies, strict=True):
        values, order = torch.cat([basis.eigenvalues for basis in parts]).sort(stable=True)
        each = ((vertices, basis.modes) for (vertices, _), basis in zip(several, parts, strict=True))
        modes = [shape.new_zeros(len(moves), *shape.shape).index_copy(1, vertices, moves) for vertices, moves in each]
        rigid_eigenvalues = torch.stack([basis.rigid_eigenvalues for basis in parts]).amax(0)
        bases.append(ModalBasis(shape, values, torch.cat(modes)[order], rigid_eigenvalues))
    return bases


def why_shell(surfaces: list[CanonicalSurface]) -> str:
    """Reason for which a set of key-frames has modes of the surface itself; empty if of the solid."""
    for index, surface in enumerate(surfaces):
        holes = open_part(surface.vertices, surface.connectivity)
        thickness = surface.thickness / surface.area**0.5
        what = f"key-frame {index} is" if len(surfaces) > 1 else "the shape is"
        if holes > OPEN:
            return f"{what} open: a round hole with its boundary would have {holes:.2g} times its area"
        if thickness < THINNEST_SOLID:
            return f"{what} thin: its mean thickness is {thickness:.2g} times the root of its area"
    return ""


class _Extraction:
    """Modes of all key-frames of a set, as arrays in canonical units; ``stop`` cancels the work."""

    def __init__(
        self, shapes: FloatArray, faces: IntArray, n_modes: int, mesher: Mesher, cache: Cache, bar: ProgressReport
    ) -> None:
        self.n_modes, self.mesher, self.cache, self.bar, self.stop = n_modes, mesher, cache, bar, threading.Event()
        self.n_keyframes, self.surfaces = len(shapes), list[CanonicalSurface]()
        for index, shape in enumerate(shapes):
            with self.stage(index, "checks"):
                self.surfaces.append(CanonicalSurface(shape, faces))

    def by(self, method: Method, form: HessianForm) -> list[Arrays]:
        """Modes by a method; ``"auto"`` takes the shell for shapes that are open or thin or whose solids fail."""
        if method == "auto" and (reason := why_shell(self.surfaces)):
            logger.info("modes of the surface itself, not of a solid: %s", reason)
            return self.shells()
        if method == "shell":
            return self.shells()
        try:
            return self.solids(form)
        except ModalAnalysisError as error:
            if method == "solid" or isinstance(error, MesherError):
                raise
            logger.info("modes of the surface itself, not of a solid: %s", error)
        self.stop.clear()
        self.bar.expect(self.n_keyframes)
        return self.shells()

    def shells(self) -> list[Arrays]:
        """Modes of all surfaces themselves."""

        def compute(index: int) -> Arrays:
            return self._modes_of(index, lambda: sheet_body(self.surfaces[index], self.n_modes))

        return self._all(compute, {}, {"form": "shell"}, n_coarse_faces(self.n_modes) // 2)

    def solids(self, form: HessianForm) -> list[Arrays]:
        """Modes of all solids inside.

        The key-frame of least self-proximity is meshed, as tetrahedra join parts in contact, and its tetrahedra are
        carried to the others. Key-frames that they cannot follow are meshed, too.
        """
        for index, surface in enumerate(self.surfaces):
            with self.stage(index, "checks"):
                surface.require_solid()
        first = min(range(len(self.surfaces)), key=lambda index: self_proximity(self.surfaces[index]))
        solid = self._mesh(first)
        make_carrier = functools.cache(lambda: Carrier(solid))

        def compute(index: int) -> Arrays:
            if index == first:
                return self._modes_of(index, lambda: solid.body(form))
            # A singular system, or modes of tetrahedra that are too distorted.
            with self.stage(index, "carrying tetrahedra"), contextlib.suppress(RuntimeError, np.linalg.LinAlgError):
                carried = make_carrier().carry(self.surfaces[index])
                if carried is not None:
                    return self._modes_of(index, lambda: carried.body(form))
            mesh = self._mesh(index)
            return self._modes_of(index, lambda: mesh.body(form))

        inputs = {"points": solid.surface.vertices, **solid.tetrahedra.arrays()}
        inputs = {f"rest_{name}": array for name, array in inputs.items()}
        return self._all(compute, inputs, {"form": form, **self.mesher.key()}, len(solid.tetrahedra.vertices))

    def _all(
        self, compute: Callable[[int], Arrays], inputs: Arrays, parameters: dict[str, object], n_vertices: int
    ) -> list[Arrays]:
        """Modes of all key-frames, from the cache or computed in as many threads as fit into memory."""

        @one_blas_thread()
        def modes(index: int) -> Arrays:
            surface = self.surfaces[index]
            arrays = {"points": surface.vertices, "faces": surface.faces, **inputs}
            result = self.cache.get("modes", arrays, {"n_modes": self.n_modes, **parameters}, lambda: compute(index))
            self.bar.update()
            return result

        work = [functools.partial(modes, index) for index in range(len(self.surfaces))]
        return run(work, VERTICES_AT_ONCE // n_vertices, self.stop)

    def _mesh(self, index: int) -> Solid:
        with self.stage(index, "tetrahedra"):
            return Solid.from_surface(self.surfaces[index], self.mesher, self.cache, self.stop)

    def _modes_of(self, index: int, make_body: Callable[[], ElasticBody]) -> Arrays:
        """Modes of a body, at the points of its surface. *Shape:* ``modes (k, U, 3)``."""
        with self.stage(index, "modes"):
            try:
                body = make_body()
                result = lowest_modes(body, self.n_modes)
                modes = body.to_surface(result.modes.reshape(len(body.points), 3, -1))
            except ModalAnalysisError:
                raise
            except (RuntimeError, np.linalg.LinAlgError) as error:
                raise ModalAnalysisError(
                    f"the modes cannot be computed: {error}; the mesh is likely degenerate: check the surface, or try "
                    "another method or mesher"
                ) from error
        return {**result._asdict(), "modes": np.ascontiguousarray(modes.transpose(2, 0, 1))}

    @contextlib.contextmanager
    def stage(self, index: int, what: str) -> Iterator[None]:
        """Report a stage of a key-frame, unless the work was cancelled; errors name the key-frame if it has others."""
        if self.stop.is_set():
            raise StoppedError
        self.bar.set_description(f"key-frame {index + 1}/{self.n_keyframes}: {what}")
        try:
            yield
        except (MeshError, ModalAnalysisError) as error:
            if self.n_keyframes == 1:
                raise
            raise type(error)(f"key-frame {index}: {error}") from error
