"""One mesh laid onto another: against known truths, on damaged meshes, and what is said when it cannot be right."""

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from helpers.bodies import limbs
from scipy.spatial import cKDTree

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data.samples import load_sample
from torch_modal.extras import require
from torch_modal.io.write import save_mesh
from torch_modal.registration import register as register_module
from torch_modal.registration.landmarks import landmark_table, read_landmarks
from torch_modal.registration.maps import SpectralShape
from torch_modal.registration.register import register
from torch_modal.registration.report import Registration, measure
from torch_modal.registration.surface import DUST, MeshSurface, drop_unreferenced, largest_pieces, sew

for library in ("robust_laplacian", "potpourri3d", "igl"):
    pytest.importorskip(library, reason=f"{library} is not installed; it is part of the extra 'register'")

Mesh = tuple[np.ndarray, np.ndarray]


def bent(points: np.ndarray, angle: float = 0.5) -> np.ndarray:
    """Turned about z, further the higher: a twist, and a bend on top."""
    x, y, z = points.T
    c, s = np.cos(angle * z / 3), np.sin(angle * z / 3)
    return np.stack([c * x - s * y, s * x + c * y, z + 0.06 * x**2], axis=1)


def shuffled(points: np.ndarray, faces: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices in random order; also which they were."""
    order = np.random.default_rng(seed).permutation(len(points))
    return points[order], np.argsort(order)[faces], order


@pytest.fixture(scope="module")
def pair() -> tuple[Mesh, Mesh, np.ndarray]:
    """A template of 642 vertices; a target of 2562, bent, turned and twice as large; the template's true places."""
    rest, faces = limbs(3)
    fine, fine_faces = limbs(4)
    turn = trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3]

    def posed(points: np.ndarray) -> np.ndarray:
        return 2 * bent(points) @ turn.T + [5, 6, 7]

    # The first vertices of a finer icosphere are those of the coarser one.
    np.testing.assert_allclose(fine[: len(rest)], rest, atol=1e-12)
    there, there_faces, _ = shuffled(posed(fine), fine_faces)
    return (rest, faces), (there, there_faces), posed(rest)


def errors(found: Registration, truth: np.ndarray) -> np.ndarray:
    """In percent of the diagonal."""
    return 100 * np.linalg.norm(found.positions.numpy() - truth, axis=1) / np.linalg.norm(np.ptp(truth, axis=0))


@pytest.fixture(scope="module")
def found(pair: tuple[Mesh, Mesh, np.ndarray]) -> Registration:
    return register(*pair[0], *pair[1], progress=False)


def test_truth_is_met_without_landmarks(pair: tuple[Mesh, Mesh, np.ndarray], found: Registration) -> None:
    off = errors(found, pair[2])
    assert off.mean() < 1.0 and np.percentile(off, 95) < 3.0
    assert not found.doubtful and not found.warnings
    assert found.to_target.mean < 0.12 and found.from_target.mean < 0.5
    assert found.flipped_area < 0.01


@pytest.mark.slow
def test_missing_parts_have_low_confidence(found: Registration) -> None:
    assert float((found.vertex_confidence > 0.5).double().mean()) > 0.99
    sample = load_sample("hand")
    x, y = sample.keyframes[:2].numpy()
    faces = sample.faces.numpy()
    distances = np.linalg.norm(x[faces].mean(1) - x[x[:, 0].argmin()], axis=1)
    kept = faces[distances > np.quantile(distances, 0.13)]
    missing = np.setdiff1d(faces, kept)
    result = register(x, faces, y, kept, progress=False)
    assert result.doubtful and result.warnings
    low = result.vertex_confidence < 0.5
    assert float(low[missing].double().mean()) > 0.8 and float(low[kept].double().mean()) < 0.05


@pytest.mark.parametrize(
    "direction",
    [pytest.param((1, 0.2, 0.1), id="tip"), pytest.param((0.6, -0.5, -0.6), id="side", marks=pytest.mark.slow)],
)
def test_a_hole_is_not_covered_and_what_is_left_is_as_good(
    pair: tuple[Mesh, Mesh, np.ndarray], found: Registration, direction: tuple[float, float, float]
) -> None:
    """A tenth of the surface is cut out: a limb, or a piece between limbs."""
    (rest, faces), _, truth = pair
    fine, fine_faces = limbs(4)
    turn = trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3]
    surface = MeshSurface(fine, fine_faces)
    order = np.argsort(-surface.face_centres @ direction / np.linalg.norm(surface.face_centres, axis=1) ** 0.5)
    kept = fine_faces[order[np.cumsum(surface.face_areas[order]) > 0.1 * surface.area]]
    there = np.isin(np.arange(len(rest)), kept)
    target, _ = drop_unreferenced(2 * bent(fine) @ turn.T + [5, 6, 7], kept)
    result = register(rest, faces, target.vertices, target.faces, progress=False)
    assert errors(result, truth)[there].mean() < 1.2 * errors(found, truth)[there].mean()
    low = result.vertex_confidence.numpy() < 0.5
    assert low[~there].mean() > 0.95 and low[there].mean() < 0.08
    assert [line for line in result.warnings if "% of the template have no counterpart" in line]
    assert result.unsupported_area == pytest.approx(0.1, abs=0.03)


def test_report_measures_what_it_says(pair: tuple[Mesh, Mesh, np.ndarray], found: Registration) -> None:
    """The places on the target are exact, and the report has their largest distance, and the mean by area."""
    there = trimesh.Trimesh(*pair[1], process=False)
    below = (found.barycentric.numpy()[..., None] * pair[1][0][found.target_corners.numpy()]).sum(1)
    exact = np.linalg.norm(found.positions.numpy() - below, axis=1)
    # The nearest of many samples of the target is an upper bound, nearly met.
    sampled = cKDTree(trimesh.sample.sample_surface(there, 200_000, seed=0)[0]).query(found.positions.numpy())[0]
    size = np.linalg.norm(np.ptp(pair[1][0], axis=0))
    assert (exact <= sampled + 1e-9).all() and (sampled < exact + 0.01 * size).all()
    assert found.to_target.max == pytest.approx(100 * exact.max() / size)
    areas = MeshSurface(found.positions.numpy(), pair[0][1]).vertex_areas
    assert found.to_target.mean == pytest.approx(100 * np.average(exact, weights=areas) / size)
    assert found.to_target.mean != pytest.approx(100 * exact.mean() / size, rel=1e-3)


def test_dtype_and_units_follow_the_inputs(pair: tuple[Mesh, Mesh, np.ndarray]) -> None:
    (rest, faces), (there, there_faces), truth = pair
    marks = np.array([[v, np.linalg.norm(there - truth[v], axis=1).argmin()] for v in (0, 50, 200, 400, 600)])
    single = register(torch.from_numpy(rest).float(), faces, 1e-3 * there, there_faces, landmarks=marks, progress=False)
    assert single.positions.dtype == torch.float32
    double = register(rest, faces, there, there_faces, landmarks=torch.from_numpy(marks), progress=False)
    assert double.positions.dtype == torch.float64
    assert errors(double, truth).mean() < 1.0
    np.testing.assert_allclose(1e3 * single.positions.numpy(), double.positions.numpy(), atol=0.05)
    assert double.landmark_errors.shape == (5,) and float(double.landmark_errors.max()) < 2.0


def test_the_second_time_is_from_the_cache(
    pair: tuple[Mesh, Mesh, np.ndarray], found: Registration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the content of both meshes and of the landmarks, which are vertices or points."""
    (rest, faces), (there, there_faces), _ = pair
    calls: list[int] = []

    def solved(problem: object) -> Registration:
        calls.append(len(calls))
        return found._replace(confidence=0.25, warnings=("one, with a comma", "two"))

    monkeypatch.setattr(register_module._RegistrationProblem, "solve", solved)

    def again(target: np.ndarray, marks: object = None, cache: bool = True) -> Registration:
        options = {"landmarks": marks, "cache_dir": tmp_path, "cache": cache, "progress": False}
        return register(rest, faces, target, there_faces, **options)

    again(there)
    second = again(there)
    assert calls == [0] and second.warnings == ("one, with a comma", "two") and second.doubtful
    assert second.to_target == found.to_target and isinstance(second.to_target, type(found.to_target))
    for name in ("barycentric", "target_corners", "landmark_errors"):
        assert torch.equal(getattr(second, name), getattr(found, name)), name
    again(there + 1e-9)
    marks = np.array([[3, 5], [40, 70]])
    again(there, marks)
    again(there, np.stack([rest[marks[:, 0]], there[marks[:, 1]]], axis=1))
    again(there, cache=False)
    assert calls == [0, 1, 2, 3]


@pytest.mark.slow
def test_results_are_repeatable(pair: tuple[Mesh, Mesh, np.ndarray], found: Registration) -> None:
    again = register(*pair[0], *pair[1], cache=False, progress=False)
    assert torch.equal(again.positions, found.positions) and again.confidence == found.confidence


def test_vertices_of_no_face_come_along(pair: tuple[Mesh, Mesh, np.ndarray], found: Registration) -> None:
    (rest, faces), (there, there_faces), truth = pair
    more = register(np.vstack([rest, 1.02 * rest[:1]]), faces, there, there_faces, progress=False)
    assert more.positions.shape == (len(rest) + 1, 3)
    torch.testing.assert_close(more.positions[:-1], found.positions)
    assert np.linalg.norm(more.positions[-1].numpy() - truth[0]) < 0.05 * np.linalg.norm(np.ptp(truth, axis=0))


def test_seams_are_no_cuts(pair: tuple[Mesh, Mesh, np.ndarray], found: Registration) -> None:
    """Each face of a half with vertices of its own, as exporters split them: the result is the whole one's."""
    (rest, faces), target, _ = pair
    half = rest[faces].mean(1)[:, 2] > 0
    copies = np.unique(faces[half])
    number = np.arange(len(rest))
    number[copies] = len(rest) + np.arange(len(copies))
    split = np.where(half[:, None], number[faces], faces)
    result = register(np.vstack([rest, rest[copies]]), split, *target, progress=False)
    assert result.positions.shape == (len(rest) + len(copies), 3)
    lower = np.unique(faces[~half])
    # The order of vertices is another one, and so the rounding.
    torch.testing.assert_close(result.positions[lower], found.positions[lower], atol=0.02, rtol=0)
    torch.testing.assert_close(result.positions[len(rest) :], found.positions[copies], atol=0.02, rtol=0)
    assert len(result.sample(torch.from_numpy(target[0]))) == len(result.positions)


@pytest.mark.parametrize(
    "flaw", [*(pytest.param(flaw, marks=pytest.mark.slow) for flaw in ("hole", "noise")), "fins and dust, inside out"]
)
def test_flaws_of_the_target(pair: tuple[Mesh, Mesh, np.ndarray], flaw: str) -> None:
    (rest, faces), (there, there_faces), truth = pair
    random = np.random.default_rng(0)
    size = np.linalg.norm(np.ptp(there, axis=0))
    if flaw == "hole":
        there_faces = there_faces[np.linalg.norm(there[there_faces].mean(1) - there[17], axis=1) > 0.05 * size]
    elif flaw == "noise":
        there = there + 0.002 * size * random.normal(size=there.shape)
    else:
        tops, speck = there[there_faces[:9]].mean(1) * 1.01, truth[3] + 0.001 * size * np.eye(3)
        fins = np.column_stack([there_faces[:9, :2], len(there) + np.arange(9)])
        there_faces = np.vstack([there_faces, fins, len(there) + 9 + np.arange(3)])[:, ::-1]
        there = np.vstack([there, tops, speck])
    result = register(rest, faces, there, there_faces, progress=False)
    assert result.doubtful or errors(result, truth).mean() < 2.0
    assert not result.doubtful or result.warnings
    assert torch.isfinite(result.positions).all()


def test_mirrored_landmarks_are_doubtful(pair: tuple[Mesh, Mesh, np.ndarray]) -> None:
    """The template and its mirror image: the map of right distances turns the surface over."""
    rest, faces = pair[0]
    mirrored, turned = rest * [1, 1, -1], faces[:, ::-1]
    marks = np.stack([np.arange(0, 600, 60)] * 2, axis=1)
    assert register(rest, faces, mirrored, turned, landmarks=marks, progress=False).doubtful


def test_a_stray_sphere_beside_the_target_changes_nothing(
    pair: tuple[Mesh, Mesh, np.ndarray], found: Registration
) -> None:
    (rest, faces), (there, there_faces), truth = pair
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1 * np.linalg.norm(np.ptp(there, axis=0)))
    points = np.concatenate([there, np.array(ball.vertices) + there.mean(0) + 1.2 * np.ptp(there, axis=0)])
    both = np.concatenate([there_faces, np.array(ball.faces) + len(there)])
    result = register(rest, faces, points, both, progress=False)
    assert abs(result.confidence - found.confidence) < 0.1
    assert errors(result, truth).mean() < 1.2 * errors(found, truth).mean() + 0.1
    assert result.from_target.max < 2 * found.from_target.max


@pytest.mark.parametrize("marked", [True, False])
def test_across_shapes(pair: tuple[Mesh, Mesh, np.ndarray], marked: bool) -> None:
    (rest, faces), (there, there_faces), truth = pair
    stout = there * [1.0, 1.25, 0.9]
    marks = np.stack([rest[::80], (truth * [1.0, 1.25, 0.9])[::80]], axis=1) if marked else None
    result = register(rest, faces, stout, there_faces, landmarks=marks, same_subject=False, progress=False)
    assert errors(result, truth * [1.0, 1.25, 0.9]).mean() < 2.0
    assert result.to_target.mean < 0.12 and result.flipped_area < 0.02 and not result.doubtful


def test_attributes_are_sampled(pair: tuple[Mesh, Mesh, np.ndarray], found: Registration) -> None:
    there = torch.from_numpy(pair[1][0])
    below = found.sample(there)  # positions are an attribute too
    assert float((below - found.positions).norm(dim=1).mean()) < 0.002 * float(
        np.linalg.norm(np.ptp(pair[1][0], axis=0))
    )
    labels = found.sample(torch.arange(len(there)))
    assert labels.dtype == torch.int64
    assert (found.target_corners == labels[:, None]).any(1).all()
    assert found.sample(np.ones((len(there), 2, 2), dtype=np.float32)).shape == (len(found.positions), 2, 2)
    with pytest.raises(tm.MeshError, match="one row for each vertex"):
        found.sample(torch.zeros(3))


def test_bad_input_is_refused(pair: tuple[Mesh, Mesh, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    (rest, faces), target, _ = pair
    with pytest.raises(tm.MeshError, match="need 5 landmarks"):
        register(rest, faces, *target, landmarks=[[0, 0]], same_subject=False, progress=False)
    with pytest.raises(tm.MeshError, match="NaN"):
        register(np.full_like(rest, np.nan), faces, *target, progress=False)
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(ImportError, match=r"torch_modal\[register\]"):
        require("igl", "register", "registration")


# ------------------------------------------------------------------------------------------------------------- parts


def cut_through(vertices: np.ndarray, faces: np.ndarray, gap: float) -> tuple[MeshSurface, np.ndarray]:
    """Without the faces of a band across the first bump, and which of the vertices that are left lie beyond it."""
    along = vertices @ (direction := np.array([1, 0.2, 0.1]) / np.linalg.norm([1, 0.2, 0.1]))
    at = 0.6 * along.max()
    kept = np.abs(vertices[faces].mean(1) @ direction - at) > gap
    surface, used = drop_unreferenced(vertices, faces[kept])
    return surface, along[used] > at


def test_what_a_cut_has_parted_is_sewn_on() -> None:
    """Sewn up, a tip that is cut off is as far from the rest as before; dust and distant pieces are left alone."""
    rest, faces = limbs(5)
    cut, beyond = cut_through(rest, faces, 0.15)
    assert cut.connectivity.vertex_pieces.max() == 1 and 200 < beyond.sum() < 0.2 * len(beyond)
    whole = largest_pieces(sew(cut))
    assert len(whole.vertices) == len(cut.vertices)
    shape, before = SpectralShape(cut), SpectralShape(MeshSurface(rest, faces))
    tip, far = rest[(rest @ [1, 0.2, 0.1]).argmax()], rest[(rest @ [1, 0.2, 0.1]).argmin()]
    lengths = []
    for one in (shape, before):
        ends = [int(np.linalg.norm(one.placed.vertices - place, axis=1).argmin()) for place in (tip, far)]
        lengths.append(one.geodesics_from(np.array(ends[:1]))[ends[1], 0] * one.scale)
    assert lengths[0] == pytest.approx(lengths[1], rel=0.08)
    assert sew(cut, 0.001).connectivity.vertex_pieces.max() == 1, "the gap is wider"
    speck = MeshSurface(
        np.vstack([rest, rest[0] + 0.1 * np.eye(3)]), np.vstack([faces, len(rest) + np.arange(3)[None]])
    )
    assert len(largest_pieces(speck, DUST).vertices) == len(rest)


def test_a_limb_that_is_cut_off_stays_where_it_belongs(pair: tuple[Mesh, Mesh, np.ndarray]) -> None:
    (rest, faces), _, _ = pair
    cut, _ = cut_through(*limbs(5), 0.15)
    moved = MeshSurface(bent(cut.vertices), cut.faces)
    result = register(rest, faces, moved.vertices, moved.faces, progress=False)
    assert not result.doubtful and errors(result, bent(rest)).mean() < 1.0


def test_spectrum_of_the_sphere() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    shape = SpectralShape(MeshSurface(np.array(ball.vertices), np.array(ball.faces)))
    # l (l + 1), each 2 l + 1 times, on a sphere of area one: radius^2 = 1 / 4 pi.
    expected = 4 * np.pi * np.array([0] + [2] * 3 + [6] * 5)
    np.testing.assert_allclose(shape.eigenvalues[:9], expected, rtol=0.02, atol=1e-6)
    gram = shape.functions.T @ (shape.mass[:, None] * shape.functions)
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-6)


def test_measures_of_a_turned_flap() -> None:
    rest, faces = limbs(3)
    surface = MeshSurface(rest, faces)
    same, support = measure(surface, rest, surface)
    assert (support == 1).all()
    assert same.to_target.max < 1e-9 and same.flipped_area == 0 and same.stretch == 0
    twice = MeshSurface(2 * rest, faces)
    assert measure(surface, 2 * rest, twice)[0].stretch < 1e-12, "the scale of the whole is no stretch"
    inside_out = MeshSurface(rest, faces[:, ::-1])
    assert measure(surface, rest, inside_out)[0].flipped_area > 0.9


# --------------------------------------------------------------------------------------------------- landmarks, files
def test_landmark_files(tmp_path: Path) -> None:
    file = tmp_path / "pairs.txt"
    file.write_text("# nose\n1 2\n\n3, 4  # tail\n")
    np.testing.assert_array_equal(read_landmarks(file, 2), [[1, 2], [3, 4]])
    file.write_text("0 0 0  1 1 1\n0 1 0  1 2 1\n")
    assert read_landmarks(file, 2).shape == (2, 2, 3)
    for text, what in (
        ("1 2 3\n", "line 1"),
        ("1 -2\n", "count from 0"),
        ("a b\n", "no landmark"),
        ("# no\n", "no landm"),
    ):
        file.write_text(text)
        with pytest.raises(tm.MeshError, match=what):
            read_landmarks(file, 2)
    with pytest.raises(FileNotFoundError):
        read_landmarks(tmp_path / "none.txt", 2)
    for marks, what in (
        ([[0, 9]], "names vertex 9 of mesh 1"),
        ([[0, 1, 2]], r"vertex numbers \(n, 2\) or finite points"),
        ([[0.5, 1.0]], "vertex numbers"),
        (np.full((2, 2, 3), np.nan), "finite points"),
    ):
        with pytest.raises(tm.MeshError, match=what):
            landmark_table(np.array(marks), [np.zeros((3, 3)), np.zeros((3, 3))])


@pytest.fixture(scope="module")
def files(pair: tuple[Mesh, Mesh, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The template, the target, and the template in another pose."""
    folder = tmp_path_factory.mktemp("register")
    (rest, faces), target, _ = pair
    meshes = [(rest, faces), target, (bent(rest, -0.3), faces)]
    return [save_mesh(*mesh, folder / f"{name}.obj")[0] for name, mesh in zip("abc", meshes, strict=True)]


def test_key_frames_of_any_connectivity(files: list[Path], found: Registration) -> None:
    lines: list[str] = []
    keyframes, _ = tm.load_keyframes(files, register=True, progress=False, report=lines.append)
    assert keyframes.shape == (3, len(found.positions), 3) and len(lines) == 1
    # OBJ has nine digits, and registration amplifies what is lost, at single vertices.
    off = (keyframes[1] - found.positions).norm(dim=1)
    assert float(off.mean()) < 1e-3 and float(off.max()) < 0.05
    assert torch.equal(keyframes[2], tm.load_keyframes(files[2:]).keyframes[0]), "it has the first one's faces already"
    with pytest.raises(tm.MeshError, match="vertices"):
        tm.load_keyframes(files)
    with pytest.raises(tm.MeshError, match="--register"):
        tm.load_keyframes(files, landmarks=np.zeros((1, 3), dtype=int))


def test_each_mesh_is_registered_from_the_one_before(
    pair: tuple[Mesh, Mesh, np.ndarray],
    files: list[Path],
    found: Registration,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the landmarks of these two meshes."""
    points, faces, _ = shuffled(pair[1][0] + 1, pair[1][1], seed=1)
    paths, asked = [*files[:2], *save_mesh(points, faces, tmp_path / "d.obj")], []

    def recorded(template: np.ndarray, faces: np.ndarray, target: np.ndarray, *_: np.ndarray, **options: Any) -> Any:
        asked.append((template, target, options["landmarks"]))
        return found

    monkeypatch.setattr(register_module, "register", recorded)
    marks = np.array([[0, 7, 3], [50, 9, 200], [4, 5, 6]])
    tm.load_keyframes(paths, register=True, landmarks=marks, progress=False)
    meshes = [tm.load_keyframes([path]).keyframes[0].numpy() for path in paths]
    assert len(asked) == 2
    for k, (template, target, landmarks) in enumerate(asked):
        np.testing.assert_array_equal(template, found.positions if k else meshes[0])
        np.testing.assert_array_equal(target, meshes[k + 1])
        places = [meshes[i][marks[:, i]] for i in (k, k + 1)]
        np.testing.assert_array_equal(landmarks, np.stack(places, axis=1))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh that is nothing like the template."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return save_mesh(np.array(mesh.vertices), np.array(mesh.faces), tmp_path_factory.mktemp("ball") / "ball.ply")[0]


def test_doubtful_key_frames_are_refused(files: list[Path], ball: Path) -> None:
    with pytest.raises(tm.MeshError, match=r"doubtful.*landmarks"):
        tm.load_keyframes([files[0], ball], register=True, progress=False)


def test_register_command_writes_the_registered_mesh(
    files: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], found: Registration
) -> None:
    out = tmp_path / "wrapped.obj"
    assert cli.main(["register", *map(str, files[:2]), "--out", str(out)]) == 0
    assert "confidence" in capsys.readouterr().out
    # Files have nine digits, and the fit is sensitive to them at a few vertices.
    assert float((tm.load_keyframes([out]).keyframes[0] - found.positions).abs().mean()) < 1e-3
    with pytest.raises(SystemExit):
        cli.main(["register", *map(str, files[:2])])


def test_register_command_of_a_folder_writes_a_table(
    files: list[Path], ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], found: Registration
) -> None:
    """The one of the pair is trusted; a ball is no pose of it, and is left out."""
    scans, out = tmp_path / "scans", tmp_path / "out"
    scans.mkdir()
    for file in (ball, files[1]):
        shutil.copy(file, scans)
    assert cli.main(["register", str(files[0]), str(scans), "--out", str(out), "--quiet"]) == 3
    result = out / files[1].with_suffix(files[0].suffix).name
    assert float((tm.load_keyframes([result]).keyframes[0] - found.positions).abs().mean()) < 1e-3
    head, *rows = (out / "report.csv").read_text().splitlines()
    assert head.startswith("target,confidence") and [row.split(",")[0] for row in rows] == [files[1].name, "ball.ply"]
    assert float(rows[1].split(",")[1]) < 0.5 < float(rows[0].split(",")[1])
    assert sorted(path.name for path in out.iterdir()) == sorted([result.name, "report.csv"])
    assert cli.main(["register", str(files[0]), str(scans), "--out", str(out)]) == 1
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("flaw", ["none", "mirrored", "mirrored pose"])
def test_confidence_in_a_hand(data_dir: Path, flaw: str) -> None:
    keyframes, triangles = tm.load_keyframes(sorted((data_dir / "mh-hand").glob("*.obj")))
    rest, there = keyframes.numpy()[[0, 0 if flaw == "mirrored" else 1]]
    target, target_faces, _ = shuffled(there, triangles.numpy())
    if flaw != "none":
        target, target_faces = target * [-1, 1, 1], target_faces[:, ::-1]
    result = register(rest, triangles.numpy(), target, target_faces, progress=False)
    if flaw == "none":
        assert result.confidence > 0.9 and not result.warnings
        assert errors(result, there).mean() < 0.6
    else:
        assert result.doubtful and any("mirror image" in line for line in result.warnings)
