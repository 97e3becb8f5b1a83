"""Fixtures that several test files share; everything made once per run."""

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.sparse as sp
import torch
import trimesh
from helpers.browsers import NoBrowser, open_browser
from helpers.solids import box, eigenmodes, element_hessian, lumped_mass, surface
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from timing import limit_threads

from torch_modal.data.samples import load_sample
from torch_modal.data.space import ShapeSpace
from torch_modal.elastic.backend import WarpBackend
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.implicit import ConvergenceWarning
from torch_modal.geometry.surface import Surface
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.inbetween.solver import InBetweenSolver
from torch_modal.keyframes.check import Keyframes
from torch_modal.modes.basis import ModalBasis
from torch_modal.modes.extract import extract_bases
from torch_modal.modes.tetrahedra import Tetrahedra
from torch_modal.modes.tetwild import TetWild
from torch_modal.registration.load import load_keyframes

COARSE = TetWild(edge_length_fac=0.08, epsilon=5e-3)
Ball = tuple[np.ndarray, np.ndarray]

limit_threads()  # small problems, and often several processes at once: threads would wait for each other


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The run's own cache, shared by its processes: nothing is taken from the user's, and nothing left there."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_MODAL_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Scanned and modelled meshes, which are not part of the project."""
    folder = Path(__file__).parents[1].parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the folder {folder} with larger meshes is not there")
    return folder


@pytest.fixture(scope="session")
def capsule() -> tuple[np.ndarray, np.ndarray]:
    """A limb-like closed surface, its axis along z and not in the origin: vertices (V, 3), faces (F, 3)."""
    mesh = trimesh.creation.capsule(height=3.0, radius=0.6, count=(12, 12))
    mesh.merge_vertices()
    assert mesh.is_volume
    return np.array(mesh.vertices) + np.array([0.5, -0.2, 1.0]), np.array(mesh.faces, dtype=np.int64)


@pytest.fixture(scope="session")
def capsule_tetrahedra(capsule: tuple[np.ndarray, np.ndarray]) -> Tetrahedra:
    """The capsule filled by the real mesher, once per run: few enough vertices for dense linear algebra."""
    return COARSE.fill(Surface(*capsule), threading.Event())


class Shapes(NamedTuple):
    """Key-frames of one connectivity and a basis for each."""

    keyframes: torch.Tensor
    faces: torch.Tensor
    bases: list[ModalBasis]

    def pick(self, *indices: int) -> "Shapes":
        """Some of them."""
        return Shapes(self.keyframes[list(indices)], self.faces, [self.bases[i] for i in indices])


def bent_bar(cells: tuple[int, int, int], n_modes: int) -> Shapes:
    """A jittered bar of 4 x 1 x 1, straight, bent by 1.4 rad and twisted by 1.2 rad: modes without the mesher."""
    bar = box(cells, (4.0, 1.0, 1.0), jitter=0.15)
    x, y, z = (bar.vertices - bar.vertices.mean(0)).T
    radius = 4.0 / 1.4
    bent = np.stack([(radius - y) * np.sin(x / radius), radius - (radius - y) * np.cos(x / radius), z], 1)
    c, s = np.cos(0.3 * x), np.sin(0.3 * x)
    twisted = np.stack([x, c * y - s * z, s * y + c * z], 1)
    used, faces = np.unique(surface(bar), return_inverse=True)
    poses = [np.stack([x, y, z], 1), bent, twisted]
    bases = []
    for pose in poses:
        solid = Tetrahedra(pose, bar.tets)
        modes = eigenmodes(element_hessian(solid), sp.diags(lumped_mass(solid)), pose, n_modes)
        at_surface = modes.modes.T.reshape(n_modes, -1, 3)[:, used]
        numbers = (pose[used], modes.eigenvalues, at_surface.copy(), modes.rigid_eigenvalues)
        bases.append(ModalBasis(*map(torch.from_numpy, numbers)))
    keyframes = torch.from_numpy(np.stack(poses)[:, used])
    return Shapes(keyframes, torch.from_numpy(faces.reshape(-1, 3)), bases)


@pytest.fixture(scope="session")
def bars() -> Shapes:
    """Straight, bent and twisted bar of 164 vertices and 324 faces, 8 modes each; not a rigid motion apart."""
    return bent_bar((12, 3, 3), 8)


@pytest.fixture(scope="session")
def small_bars() -> Shapes:
    """The same with 30 vertices and 56 faces, 3 modes each: for tests against slow truth."""
    return bent_bar((4, 2, 1), 3)


@pytest.fixture(scope="session")
def layer_named(small_bars: Shapes) -> Callable[[str], Any]:
    """Layers of the table in helpers/every_layer.py, each made once for all checks that leave it as it is."""
    from helpers.every_layer import Made  # it imports this file

    return cache(lambda name: Made(name, small_bars))


@pytest.fixture
def made(name: str, layer_named: Callable[[str], Any]) -> Any:
    """The layer with the test's ``name``."""
    if "contact" in name:
        pytest.importorskip("igl")
    return layer_named(name)


@pytest.fixture(scope="session")
def space(bars: Shapes) -> ShapeSpace:
    """The space of the bars, in float64."""
    return ShapeSpace(bars.bases, bars.faces, dtype=torch.float64)


@pytest.fixture(scope="session")
def hand_path(data_dir: Path) -> Keyframes:
    """Frames 00, 02, 04, 06, 08 of a hand that closes: the middle of a span is its reference in-between."""
    return load_keyframes([data_dir / "mh-hand-path" / f"{i:02}.obj" for i in (0, 2, 4, 6, 8)])


@pytest.fixture(scope="session")
def hands(hand_path: Keyframes) -> Shapes:
    """The hand with 30 modes of each frame, by the real mesher (half a minute)."""
    return Shapes(*hand_path, extract_bases(*hand_path, 30, progress=False))


@pytest.fixture(scope="session")
def hand() -> Shapes:
    """The sample, open and closed, 20 modes each: on the way, fingers go through each other."""
    sample = load_sample("hand")
    bases = extract_bases(sample.keyframes, sample.faces, 20, mesher="lattice", progress=False)
    return Shapes(sample.keyframes, sample.faces, bases)


@pytest.fixture(scope="session")
def women(data_dir: Path) -> Shapes:
    """A figure of 13,380 vertices at rest and in two steps of a walk, 30 modes each."""
    shapes = load_keyframes([data_dir / "mh-woman" / f"{n}.obj" for n in ("00-rest", "02-walk-a", "03-walk-b")])
    return Shapes(*shapes, extract_bases(*shapes, 30, progress=False))


@pytest.fixture
def converged() -> Iterator[None]:
    """A minimisation that does not converge fails the test, unless the test expects it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", ConvergenceWarning)
        yield


def seeded(seed: int = 0) -> torch.Generator:
    """A source of random numbers."""
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def generator() -> torch.Generator:
    """The one source of random numbers."""
    return torch.Generator().manual_seed(0)


def modal(local: bool = False, space: str = "joint", **changes: Any) -> dict[str, Objective | Solver]:
    """Settings of the bare modal solve, to the tolerance; what is named here changes them."""
    of_solver = {name: changes.pop(name) for name in set(changes) & set(Solver.__dataclass_fields__)}
    objective = Objective(space=space, **changes)
    return {"objective": objective, "solver": Solver(**{"local_steps": 2 * local, **of_solver})}


def placement_of(core: InBetweenSolver, keyframes: torch.Tensor, weights: torch.Tensor, linear: bool = False) -> Any:
    """What the modal energy of a solver knows of weighted key-frames. *Shape:* ``(B, K, V, 3), (B, K)``.

    Args:
        core: The solver.
        keyframes: In the caller's coordinates.
        weights: They add up to one.
        linear: True for the weighted sum of the key-frames in the place of their blend by local rotations.
    """
    shapes, _, _ = core.alignment(keyframes, weights)
    stiffness = [torch.full_like(weights[:, :1], float(part.term.stiffness)) for part in core.fine.energy.parts]
    base = (weights[..., None, None] * shapes).sum(1)
    if core.blend is not None and not linear:
        base = core.blend(shapes, weights, base)
    return core.space.place(base, RestShapes(shapes, weights, stiffness), torch.ones_like(weights[:, 0]))


def listen_to_ctrl_c() -> None:
    """For ``preexec_fn``: a run in the background of a shell has SIGINT ignored, and its children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def processes(mark: str) -> dict[int, str]:
    """Command lines, by number, of running processes that have a text in them or in their working directory."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            place = os.readlink(folder / "cwd")
        except OSError:
            continue
        if mark in command or mark in place:
            found[int(folder.name)] = command
    return found


def wait_until(holds: Callable[[], bool], seconds: float = 100.0) -> None:
    """Look now and then whether something holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.05)


@pytest.fixture(params=["warp", "torch"])
def backend(request: pytest.FixtureRequest) -> str:
    """Name of each backend, but for Warp where it does not work."""
    if request.param == "warp" and not WarpBackend.works():
        pytest.skip("no Warp")
    return str(request.param)


def random_rotation(generator: torch.Generator) -> torch.Tensor:
    """A rotation matrix, float64, uniform over all of them."""
    q = torch.randn(4, dtype=torch.float64, generator=generator)
    return quaternion_to_rotation_matrix(q / q.norm())


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    """A sphere around (1, 2, 3), of radius 2, with one vertex straight towards +z: vertices (V, 3), faces (F, 3)."""
    mesh = trimesh.creation.uv_sphere(radius=2.0, count=(16, 16))
    assert np.isclose(mesh.vertices[:, 2].max(), 2.0)
    return np.array(mesh.vertices) + np.array([1.0, 2.0, 3.0]), np.array(mesh.faces, dtype=np.int64)


@pytest.fixture(scope="module")
def growing(ball: Ball) -> np.ndarray:
    """Seven frames of the ball: from its size to 1.6 times that, a tenth a frame."""
    vertices, _ = ball
    centre = np.array([1.0, 2.0, 3.0])
    return np.stack([centre + (1 + 0.1 * n) * (vertices - centre) for n in range(7)])


@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    try:
        with open_browser() as browser:
            yield browser
    except NoBrowser as reason:
        pytest.skip(f"no page can be opened: {reason}")
