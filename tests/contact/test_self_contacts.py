"""What passes through itself: against a slow search, in shapes whose depth is known, and from the command line."""

import itertools
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from conftest import random_rotation

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data.samples import load_sample, sample_files
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import Crossings, triangles_cross

pytest.importorskip("igl")


def two_boxes(overlap: float, levels: int = 2, width: float = 0.613) -> tuple[torch.Tensor, torch.Tensor]:
    """A cube of side 1 and a thinner box that overlap along x by so much: one mesh of two pieces."""
    first, second = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, width, 0.587))
    for _ in range(levels):
        first, second = first.subdivide(), second.subdivide()
    second.apply_translation((1 - overlap, 0.031, 0.017))
    points = np.concatenate([first.vertices, second.vertices])
    faces = np.concatenate([first.faces, second.faces + len(first.vertices)])
    return torch.from_numpy(points), torch.from_numpy(faces.astype(np.int64))


def cross_by_fractions(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two triangles cross, in exact arithmetic: the segments that the planes cut out overlap by a length."""
    ends, exact = [], np.vectorize(lambda x: Fraction(float(x)), otypes=[object])
    triangles = [exact(one), exact(other)]
    normals = [np.cross(b - a, c - a) for a, b, c in triangles]
    line = np.cross(*normals)
    for corners, plane, normal in zip(triangles, triangles[::-1], normals[::-1], strict=True):
        heights, places = (corners - plane[0]) @ normal, corners @ line
        if min(heights) >= 0 or max(heights) <= 0:
            return False
        met = list(places[heights == 0])
        for i, j in itertools.combinations(range(3), 2):
            if heights[i] * heights[j] < 0:
                met.append(places[i] + (places[j] - places[i]) * heights[i] / (heights[i] - heights[j]))
        ends.append((min(met), max(met)))
    return max(ends[0][0], ends[1][0]) < min(ends[0][1], ends[1][1])


def pairs_by_fractions(x: np.ndarray, faces: np.ndarray) -> set[tuple[int, int]]:
    """All pairs that cross, one after the other; boxes that do not meet are left out."""
    low, high = x[faces].min(1), x[faces].max(1)
    return {
        (f, g)
        for f, g in itertools.combinations(range(len(faces)), 2)
        if not set(faces[f]) & set(faces[g])
        and (low[f] <= high[g]).all()
        and (low[g] <= high[f]).all()
        and cross_by_fractions(x[faces[f]], x[faces[g]])
    }


def test_pairs_are_those_of_a_slow_search(generator: torch.Generator) -> None:
    x, faces = two_boxes(0.3, levels=1)
    x = x + 0.01 * torch.randn(x.shape, dtype=x.dtype, generator=generator)
    wanted = pairs_by_fractions(x.numpy(), faces.numpy())
    assert len(wanted) > 10
    found = tm.self_contacts(x, faces)
    assert {tuple(pair) for pair in found.pairs.tolist()} == wanted
    assert bool(found.new.all()) and bool(found.far.all())  # of two pieces: nothing leads from one to the other


def test_triangles_on_a_grid_cross_as_fractions_say() -> None:
    rng = np.random.default_rng(0)
    # Small whole numbers: vertices lie in planes and on edges, edges meet edges, and triangles share planes.
    one, other = rng.integers(-2, 3, (2, 1500, 3, 3)).astype(float)
    wanted = np.array([cross_by_fractions(a, b) for a, b in zip(one, other, strict=True)])
    assert wanted.sum() > 150
    np.testing.assert_array_equal(triangles_cross(one, other), wanted)
    np.testing.assert_array_equal(triangles_cross(other[:, [1, 0, 2]], one[:, [2, 0, 1]]), wanted)
    # Coordinates that no longer are exact: a tenth of them rounds differently at each vertex.
    one, other = one / 10 + 0.3, other / 10 + 0.3
    wanted = np.array([cross_by_fractions(a, b) for a, b in zip(one, other, strict=True)])
    np.testing.assert_array_equal(triangles_cross(one, other), wanted)


@pytest.mark.parametrize("apart", [0.0, 0.25], ids=["face on face", "edge on face"])
@pytest.mark.parametrize("search", ["igl", "warp"])
def test_what_only_touches_does_not_cross(apart: float, search: str) -> None:
    # Two boxes with a common plane: their faces touch, partly in one plane, and edges meet edges.
    box = trimesh.creation.box((1, 1, 1)).subdivide()
    second = np.array(box.vertices) + np.array([1, 0.3125, apart])
    points, faces = np.concatenate([box.vertices, second]), np.concatenate([box.faces, box.faces + len(second)])
    assert int(tm.self_contacts(points, faces).number) == 0
    mesh = Connectivity(faces, len(points))
    kernels = None
    if search == "warp":
        pytest.importorskip("warp")
        from torch_modal.elastic.crossings import WarpPairs

        kernels = WarpPairs(mesh, points)
    assert len(Crossings(mesh, points[None], search=kernels).pairs(points)) == 0
    # As deep as a quarter of an edge, the edges of both meet, and each pair is counted once.
    points[len(second) :, 0] -= 0.0625
    pairs = Crossings(mesh, points[None], search=kernels).pairs(points)
    wanted = pairs_by_fractions(points, faces)
    assert len(wanted) > 10 and set(map(tuple, pairs.tolist())) == wanted


@pytest.mark.parametrize("n_faces", [1, 2, 3, 20, 500])
def test_kernels_find_the_triangles_that_cross(n_faces: int, generator: torch.Generator) -> None:
    pytest.importorskip("warp")
    from torch_modal.elastic.crossings import FIRST_ROOM, WarpPairs

    corners = torch.stack([torch.randperm(n_faces + 3, generator=generator)[:3] for _ in range(n_faces)]).numpy()
    mesh = Connectivity(corners, n_faces + 3)
    first, x = torch.rand(2, n_faces + 3, 3, dtype=torch.float64, generator=generator).numpy()
    wanted = Crossings(mesh, first[None]).pairs(x)
    assert n_faces < 500 or len(wanted) > FIRST_ROOM  # which has to be made larger
    np.testing.assert_array_equal(Crossings(mesh, first[None], search=WarpPairs(mesh, first)).pairs(x), wanted)
    if n_faces < 500:
        assert set(map(tuple, wanted.tolist())) == pairs_by_fractions(x, corners)


def test_pairs_do_not_depend_on_pose_and_size(generator: torch.Generator) -> None:
    x, faces = two_boxes(0.3)
    x = x + 0.01 * torch.randn(x.shape, dtype=x.dtype, generator=generator)
    moved = 1e3 * x @ random_rotation(generator).T + torch.tensor([1e5, -2e4, 0.0])
    here, there = (tm.self_contacts(shape, faces) for shape in (x, moved))
    assert torch.equal(here.pairs, there.pairs)
    torch.testing.assert_close(1e3 * here.depth, there.depth, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("overlap", [0.1, 0.2])
def test_depth_is_that_of_the_overlap(overlap: float) -> None:
    x, faces = two_boxes(overlap)
    found = tm.self_contacts(x, faces)
    # The end face of the thinner one lies so deep behind the side of the other.
    assert float(found.depth.max()) == pytest.approx(overlap, abs=1e-9)
    apart = tm.self_contacts(two_boxes(-0.01)[0], faces)
    assert int(apart.number) == 0 and float(apart.depth.max()) == 0


def test_depth_is_not_the_thickness_of_what_went_in() -> None:
    """The corners at its end face its own sides, which are nearer than the surface that they went through."""
    x, faces = two_boxes(0.065, levels=1, width=0.05)
    place = torch.where(torch.arange(len(x)) < len(x) // 2, torch.nan, x[:, 0] - 0.435)  # along the thin one
    x[(place - 0.5).abs() < 1e-9, 0] = 0.435 + 0.063  # a row of its faces is inside as a whole
    end = place.abs() < 1e-9
    assert int(end.sum()) == 9
    torch.testing.assert_close(tm.self_contacts(x, faces).depth[end], torch.full_like(x[end, 0], 0.065))


def test_what_crosses_in_a_keyframe_is_not_new() -> None:
    x, faces = two_boxes(0.2)
    deeper = two_boxes(0.23)[0]  # the same faces cross, and some of their neighbours
    found = tm.self_contacts(torch.stack([x, deeper]), faces, ignore=x)
    assert int(found.n_new[0]) == 0 and int(found.n_far.sum()) == 0 and found.number.tolist()[0] > 0
    assert int(tm.self_contacts(x, faces, ignore=two_boxes(-0.5)[0]).n_far) == int(found.number[0])


def test_a_fold_is_not_far() -> None:
    n, m = 321, 21
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij")
    flat = np.stack([u, v, 0 * u], -1).reshape(-1, 3)
    i = np.arange(n * m).reshape(n, m)[:-1, :-1].reshape(-1)
    faces = np.concatenate([np.stack([i, i + m, i + m + 1], 1), np.stack([i, i + m + 1, i + 1], 1)])
    # A curtate wave, whose loop passes through itself; slanted, so that edges do not meet edges.
    size, turn = 0.02 * np.exp(-(((u - 0.5) / 0.04) ** 2)), 20 * np.pi * (u - 0.5)
    folded = np.stack([u - size * np.sin(turn + 0.1 * v), v + 0.1 * u, -size * np.cos(turn + 0.1 * v)], -1)
    found = tm.self_contacts(folded.reshape(-1, 3), faces, ignore=flat)
    assert int(found.n_new) > 20
    assert int(found.n_far) == 0
    assert int(tm.self_contacts(folded.reshape(-1, 3), faces).n_far) == 0


def test_batches_keep_their_shape(generator: torch.Generator) -> None:
    x, faces = two_boxes(0.2)
    apart = two_boxes(-0.2)[0]
    x = x + 0.01 * torch.randn(x.shape, dtype=x.dtype, generator=generator)
    batch = torch.stack([torch.stack([x, apart, x]), torch.stack([apart, apart, x])]).float()
    found = tm.self_contacts(batch, faces)
    assert found.number.shape == (2, 3) and found.depth.shape == batch.shape[:-1] and found.depth.dtype == torch.float32
    assert (found.number > 0).tolist() == [[True, False, True], [False, False, True]]
    first, third = (found.pairs[found.shape == i] for i in (0, 2))
    assert torch.equal(first, third) and len(first) == int(found.number[0, 0])


def test_linear_hand_goes_through_itself_and_its_keyframes_do_not() -> None:
    sample = load_sample("hand")
    middle = torch.lerp(*sample.keyframes, 0.5)
    found = tm.self_contacts(torch.cat([sample.keyframes, middle[None]]), sample.faces, ignore=sample.keyframes)
    assert found.number.tolist()[:2] == [0, 0]
    assert int(found.n_new[2]) == int(found.number[2]) > 20 and int(found.n_far[2]) > 0
    assert int(found.n_far[2]) < int(found.n_new[2])  # most of it are folds


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x, f: (x * float("nan"), f, None), "NaN or infinite"),
        (lambda x, f: (x, f + 1, None), "do not exist"),
        (lambda x, f: (x[:, :2], f, None), "V, 3"),
        (lambda x, f: (x, f[:0], None), "triangles, at least one"),
        (lambda x, f: (x, f, x[:-1]), "must be equal"),
        (lambda x, f: (x * 0, f, None), "no size"),
    ],
)
def test_what_cannot_be_is_said(change: object, said: str) -> None:
    x, faces, ignore = change(*two_boxes(0.2))  # type: ignore[operator]
    with pytest.raises(tm.MeshError, match=said):
        tm.self_contacts(x, faces, ignore)


def test_missing_package_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(ImportError, match=r"pip install 'torch_modal\[contact\]'"):
        tm.self_contacts(*two_boxes(0.2))


# -------------------------------------------------------------------------------------------------------- command line
def test_check_says_what_crosses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = load_sample("hand")
    keys = [str(file) for file in sample_files("hand")]
    assert cli.main(["check", *keys]) == 0
    assert "pairs" in capsys.readouterr().out
    middle = torch.lerp(*sample.keyframes, 0.5)
    (file,) = tm.save_mesh(middle[None], sample.faces, tmp_path, "obj")
    picture = tmp_path / "marked.png"
    assert cli.main(["check", str(file), "--keyframes", *keys, "--picture", str(picture)]) == 3
    line = next(line for line in capsys.readouterr().out.splitlines() if file.name in line)
    found = tm.self_contacts(middle, sample.faces, ignore=sample.keyframes)
    assert line.split()[1:4] == [str(int(n)) for n in (found.number, found.n_new, found.n_far)]
    assert picture.stat().st_size > 5000
    assert cli.main(["check", str(file), "--picture", str(picture)]) == 1  # it exists
    assert "--overwrite" in capsys.readouterr().err


def test_check_of_the_shapes_between(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = load_sample("hand")
    keys = [str(file) for file in sample_files("hand")]
    assert cli.main(["check", *keys, "--between"]) == 3
    said = capsys.readouterr().out
    frames = tm.subdivide(sample.keyframes, sample.faces, 3, progress=False)
    found = tm.self_contacts(frames, sample.faces, ignore=sample.keyframes)
    for i in (0, 6, 8):
        line = next(line for line in said.splitlines() if line.startswith(f"t = {i / 8:g} "))
        assert line.split()[3:6] == [str(int(n[i])) for n in (found.number, found.n_new, found.n_far)]
    shell = tm.losses.ShellLoss(sample.faces)
    assert f"shell energy of the motion: {float(8 * shell(frames[1:], frames[:-1]).sum()):.4g}, of linear" in said
    assert cli.main(["check", *keys, "--between", "--contact", "--quiet"]) == 0
    with pytest.raises(SystemExit):
        cli.main(["check", *keys, "--contact"])
    assert cli.main(["check", keys[0], "--between"]) == 1
    assert "at least 2 are needed" in capsys.readouterr().err
