"""The mesher and its process: what comes out, and every way in which it can go wrong."""

import signal
import sys
import textwrap
import threading
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import COARSE
from helpers.solids import box, together

from torch_modal.data.samples import load_sample
from torch_modal.errors import ModalAnalysisError
from torch_modal.geometry.surface import Surface
from torch_modal.modes import tetwild
from torch_modal.modes.extract import extract_modes
from torch_modal.modes.lattice import Lattice
from torch_modal.modes.surface import CanonicalSurface
from torch_modal.modes.tetrahedra import (
    MesherError,
    Tetrahedra,
    edge_lengths,
    orient,
    tet_volumes,
    without_debris,
)
from torch_modal.modes.tetwild import EDGE_RANGE, Auto, TetWild

Mesh = tuple[np.ndarray, np.ndarray]


def test_fills_the_capsule(capsule: Mesh, capsule_tetrahedra: Tetrahedra) -> None:
    vertices, faces = capsule
    volumes = tet_volumes(capsule_tetrahedra)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(trimesh.Trimesh(vertices, faces).volume, rel=0.05)
    assert np.array_equal(np.unique(capsule_tetrahedra.tets), np.arange(len(capsule_tetrahedra.vertices)))
    np.testing.assert_allclose(capsule_tetrahedra.vertices.min(axis=0), vertices.min(axis=0), atol=0.1)
    np.testing.assert_allclose(capsule_tetrahedra.vertices.max(axis=0), vertices.max(axis=0), atol=0.1)


def test_inside_out_unreferenced_tiny_and_from_a_thread(capsule: Mesh) -> None:
    vertices, faces = capsule
    scattered = np.concatenate([[[1e3, 0, 0]], vertices]) * 1e-6  # vertex 0 is in no face
    surface = CanonicalSurface(scattered, faces[:, ::-1] + 1)
    found: list[Tetrahedra] = []
    handler = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=lambda: found.append(COARSE.fill(surface, threading.Event())))
    thread.start()
    thread.join()
    volume = (1e-6 * surface.scale) ** 3 * trimesh.Trimesh(vertices, faces).volume
    assert tet_volumes(found[0]).sum() == pytest.approx(volume, rel=0.05)
    assert signal.getsignal(signal.SIGINT) is handler and "pytetwild" not in sys.modules


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Replace the worker's script by other code; ``job`` and ``result`` are its two paths."""

    def replace(code: str) -> None:
        script = tmp_path / "worker.py"
        script.write_text(
            "import os, signal, sys, time\nimport numpy as np\njob, result = sys.argv[1:]\n" + textwrap.dedent(code)
        )
        monkeypatch.setattr(tetwild, "WORKER", script)

    return replace


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", r"signal SIGKILL \(perhaps memory ran out\)"),
        ("os.kill(os.getpid(), signal.SIGXCPU)", r"signal SIGXCPU \(its processor_time is over\)"),
        pytest.param("os.kill(os.getpid(), signal.SIGSEGV)", "signal SIGSEGV", marks=pytest.mark.slow),
        ("print('RuntimeError: no envelope'); sys.exit(3)", r"exit code 3 \(RuntimeError: no envelope\)"),
        ("pass", "No such file"),
        pytest.param("open(result, 'wb').write(b'PK\\x03\\x04')", "File is not a zip file", marks=pytest.mark.slow),
        ("np.savez(result, vertices=np.zeros((0, 3)), tets=np.zeros((0, 4), int))", "the result is empty"),
        (
            "np.savez(result, vertices=np.eye(4)[:, :3] * 1e-3, tets=np.arange(4)[None])",
            "of its vertices are far from the result",
        ),
        (
            "v = np.load(job)['vertices']; v[0] *= 50; i = np.arange(len(v));"
            "np.savez(result, vertices=v, tets=np.stack([0 * i, i, np.roll(i, 5), np.roll(i, 40)], 1))",
            "reaches far beyond",
        ),
    ],
)
def test_failure_says_which_mesh_and_why(worker, capsule: Mesh, code: str, says: str) -> None:
    worker(code)
    with pytest.raises(ModalAnalysisError, match=says) as caught:
        TetWild().fill(Surface(*capsule), threading.Event())
    assert f"a mesh of {len(capsule[0])} vertices and {len(capsule[1])} faces" in str(caught.value)


def test_oriented_drops_flat_and_unused() -> None:
    solid = box((1, 1, 1), (1.0, 1.0, 1.0))
    n = len(solid.vertices)
    vertices = np.concatenate([solid.vertices, [[9.0, 9.0, 9.0]]])
    flat = [[0, 1, 2, 3]]  # four corners of one side
    tets = np.concatenate([flat, solid.tets])
    tets[2] = tets[2][[1, 0, 2, 3]]
    assert tet_volumes(Tetrahedra(vertices, tets))[[0, 2]].tolist() == pytest.approx([0.0, -1 / 6])
    result = orient(Tetrahedra(vertices, tets))
    assert len(result.vertices) == n
    np.testing.assert_allclose(tet_volumes(result), np.full(6, 1 / 6))


def test_debris_is_dropped_and_pieces_are_kept() -> None:
    body, hinged, loose = (
        box((4, 4, 4), (1.0, 1.0, 1.0)),
        box((1, 1, 1), (0.1, 0.1, 0.1)),
        box((1, 1, 1), (0.1,) * 3),
    )
    hinged.vertices[:] -= 0.1  # its last vertex lies on the first of the body
    loose.vertices[:] -= 9.0
    everything = together(body, hinged, loose)
    tets = everything.tets.copy()
    tets[tets == len(body.vertices) + 7] = 0
    result = without_debris(Tetrahedra(everything.vertices, tets))
    assert len(result.tets) == len(body.tets) + len(loose.tets)
    assert tet_volumes(result).sum() == pytest.approx(1.001)
    assert len(np.unique(result.tets)) == len(result.vertices) == len(body.vertices) + len(loose.vertices)


def test_settings_out_of_range() -> None:
    settings = {"epsilon": 0.0, "edge_length_fac": -1.0, "stop_energy": np.nan, "timeout": -1.0, "processor_time": -1.0}
    for name, value in settings.items():
        with pytest.raises(ValueError, match=name):
            TetWild(**{name: value})  # type: ignore[arg-type]


def test_auto_takes_the_lattice_unless_parts_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Surface] = []

    def fails(self: TetWild, surface: Surface, stop: threading.Event) -> Tetrahedra:
        asked.append(surface)
        raise MesherError("it failed")

    monkeypatch.setattr(TetWild, "fill", fails)
    keyframes, faces, *_ = load_sample("hand")
    for x, touching in zip(keyframes.numpy(), (False, True), strict=True):
        surface = CanonicalSurface(x, faces.numpy())
        filled, lattice = (mesher.fill(surface, threading.Event()) for mesher in (Auto(), Lattice()))
        assert [one is surface for one in asked] == [True] * touching
        np.testing.assert_array_equal(filled.vertices, lattice.vertices)
        np.testing.assert_array_equal(filled.tets, lattice.tets)


def test_auto_bounds_the_time_of_the_mesher(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """The lattice follows; with these edges fTetWild would take minutes."""
    resource = pytest.importorskip("resource", reason="Windows has no limit of the processor time")
    monkeypatch.setattr(tetwild, "PATIENCE", 1.0)
    monkeypatch.setattr(tetwild, "EDGE_RANGE", (2e-3, 2e-3))
    keyframes, faces, *_ = load_sample("hand")
    surface = CanonicalSurface(keyframes[1].numpy(), faces.numpy())
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    with caplog.at_level("INFO"):
        filled = Auto().fill(surface, threading.Event())
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 4
    assert "its processor_time is over" in caplog.text
    np.testing.assert_array_equal(filled.tets, Lattice().fill(surface, threading.Event()).tets)


def test_a_result_whose_edges_were_not_split_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """fTetWild stops before it splits edges where its first mesh has the quality, in two of ten runs on a fist."""
    cube = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    surface = Surface(cube.vertices, cube.faces)
    long, short = (box((n, n, n), (1.0, 1.0, 1.0)) for n in (4, 6))
    results, energies = [long, short, short], []

    def run(surface: Surface, settings: TetWild, stop: threading.Event) -> Tetrahedra:
        energies.append(settings.stop_energy)
        return results.pop(0)

    monkeypatch.setattr(tetwild, "_run_worker", run)
    mesher = TetWild(edge_length_fac=float(edge_lengths(short).mean()) / 3**0.5)
    for _ in range(2):
        assert len(mesher.fill(surface, threading.Event()).tets) == len(short.tets)
    assert energies == [200.0, 20.0, 200.0]


@pytest.mark.slow
def test_eigenvalues_of_a_fist_hardly_vary() -> None:
    keyframes, faces, *_ = load_sample("hand")
    values = np.stack([extract_modes(keyframes[1], faces, 3, cache=False).eigenvalues for _ in range(6)])
    assert (values.max(0) < 1.05 * values.min(0)).all()


def test_edges_follow_the_thinnest_part(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[float] = []

    def stopped(surface: Surface, settings: TetWild, stop: threading.Event) -> Tetrahedra:
        given.append(settings.edge_length_fac)  # type: ignore[arg-type]
        raise ValueError("stopped")

    monkeypatch.setattr(tetwild, "_run_worker", stopped)
    ball = trimesh.creation.icosphere(subdivisions=3)
    wire = trimesh.creation.cylinder(0.05, 4.0, sections=16).apply_translation([2.0, 0, 0])  # a tenth of the area
    for mesh in (ball, trimesh.util.concatenate([ball, wire])):
        with pytest.raises(ModalAnalysisError, match="stopped"):
            TetWild().fill(CanonicalSurface(mesh.vertices, mesh.faces), threading.Event())
    assert given == [EDGE_RANGE[1], EDGE_RANGE[0]]
