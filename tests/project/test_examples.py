"""The examples do what they say, in a short form."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import trimesh
from helpers.bodies import limbs, twist
from helpers.shapes import apart, edge_lengths

from torch_modal.data.samples import load_sample
from torch_modal.geometry.rigid import align
from torch_modal.io.write import save_mesh
from torch_modal.registration.landmarks import read_landmarks
from torch_modal.registration.load import load_keyframes

EXAMPLES = Path(__file__).parents[2] / "examples"


def load_example(name: str) -> ModuleType:
    """An example as a module, as ``python examples/name.py`` would run it."""
    path = EXAMPLES / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.parent))  # where it finds the examples beside it
    sys.modules[name] = module  # its named tuples look their annotations up there
    spec.loader.exec_module(module)
    return module


def test_train_timing_learns_times_without_labels() -> None:
    layer, linear = load_example("train_timing").main(steps=25)
    # An encoder that has learned nothing says 1/2 to everything: 0.167 off.
    assert layer.timing_error < 0.05
    assert layer.timing_error < 0.8 * linear.timing_error
    # The truth is known whole; the encoder was shown 16 noisy markers. Linear decoding is 3.4 % and 8 % off.
    assert layer.vertex_error < 2.4
    assert layer.vertex_error < 0.7 * linear.vertex_error
    assert layer.edge_error < 0.25 * linear.edge_error
    first, last = layer.losses[0], sum(layer.losses[-5:]) / 5
    assert last < 0.45 * first, (first, last)
    assert last < 0.65 * sum(linear.losses[-5:]) / 5


@pytest.mark.slow
def test_transfer_comes_near_to_the_true_gallop(tmp_path: Path) -> None:
    found = load_example("transfer").main(tmp_path, cell=0.05)
    assert found.confidence > 0.5 and found.error < 0.015 and found.error < 0.8 * found.copied
    assert (tmp_path / "stout.glb").exists() and (tmp_path / "transfer.png").exists()


@pytest.mark.slow
def test_augment_segmentation_learns_more_from_in_betweens() -> None:
    """The short form: one seed, in fewer steps."""
    iou = {arm: float(found) for arm, found in load_example("augment_segmentation").main(seeds=1, steps=300).items()}
    assert iou["in-between"] > iou["linear"] + 0.04
    assert iou["in-between"] > iou["none"] + 0.04


@pytest.mark.slow
def test_autodecoder_interpolates_better_with_in_betweens() -> None:
    """The short form; the losses, which need more steps than this to help, only run."""
    example = load_example("autodecoder")
    found = example.main(steps=200, arms=("plain", "in-betweens"))
    assert found["in-betweens"][2] < 0.85 * found["plain"][2]
    found = example.main(steps=5, arms=("ShellLoss", "LatentElasticity", "path"))
    assert len({tuple(errors) for errors in found.values()}) == 3  # each changes what is learned
    assert torch.tensor(list(found.values())).isfinite().all()


@pytest.mark.slow
def test_few_shot_comes_nearer_than_mixtures_of_vertices(tmp_path: Path) -> None:
    """The short form: fewer shapes, no rounds."""
    ratios = load_example("few_shot").main(tmp_path, n=100, rounds=0)
    assert ratios["given"] > 1 == ratios["mixtures"] > ratios["members"] + 0.2
    assert (tmp_path / "few-shot.png").stat().st_size > 100_000


@pytest.mark.slow
def test_morph_animals_goes_from_one_body_to_another(tmp_path: Path) -> None:
    """The short form, on coarse meshes: legs that swing keep their lengths, which linear interpolation cuts short."""
    found, frames, faces, _ = load_example("morph_animals").main(tmp_path, levels=1, cell=0.042)
    assert not found.doubtful and found.flipped_area < 0.02
    assert found.to_target.mean < 0.12 and found.from_target.mean < 0.12
    assert frames.shape == (3, len(found.positions), 3)
    torch.testing.assert_close(frames[2], found.positions)
    middle, linear, ends = (edge_lengths(x, faces) for x in (frames[1], frames[::2].mean(0), frames[::2]))
    assert (middle / ends.mean(0) - 1).abs().mean() < 0.6 * (linear / ends.mean(0) - 1).abs().mean()
    assert read_landmarks(tmp_path / "landmarks.txt", 2).shape == (8, 2)
    assert (tmp_path / "morph.glb").stat().st_size > 50_000 and (tmp_path / "morph.png").stat().st_size > 30_000
    assert len(load_keyframes([tmp_path / "slender.obj"]).keyframes[0]) == len(frames[0])


@pytest.mark.slow
def test_motion_from_markers_is_nearer_than_pca_and_than_the_path() -> None:
    errors = load_example("motion_from_markers").main()
    assert errors["amplitudes"] < 0.5 * min(errors["path"], errors["PCA"])


@pytest.mark.slow
def test_complete_is_nearer_than_the_path(tmp_path: Path) -> None:
    """The short form: fewer points."""
    errors = load_example("complete").main(tmp_path, n_points=400)
    assert 0 < errors["completed"] <= errors["path"] < 0.05
    assert (tmp_path / "complete.glb").stat().st_size > 50_000 and (tmp_path / "complete.png").stat().st_size > 30_000


@pytest.mark.slow
def test_new_shapes_are_drawn_and_poses_follow_their_markers(tmp_path: Path) -> None:
    errors = load_example("new_shapes").main(tmp_path)
    assert max(errors["fitted"]) < 0.3 * min(errors["linear span"])
    assert all((tmp_path / f"{name}.png").stat().st_size > 50_000 for name in ("shapes", "markers"))


@pytest.mark.slow
def test_train_motion_learns_more_in_amplitudes() -> None:
    """A short run, of half of the frames: the stride that is told from its first two shapes."""
    example = load_example("train_motion")
    example.N_FRAMES //= 2
    found = {name: errors for name, (errors, _) in example.main(2, steps=48, n_modes=16).items()}
    own = found.pop("amplitudes")
    assert own["reconstruction"] < 1
    assert own["stride"] < 0.85 * min(other["stride"] for other in found.values())
    assert own["edges"] < 0.5 * min(other["edges"] for other in found.values())


@pytest.mark.slow
def test_figures_of_the_paper_run_on_its_own_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the user has them; here the sample creature stands in for all three animals."""
    sample = load_sample("creature")
    frames = torch.stack([sample.keyframes, sample.truth], 1).flatten(0, 1)
    for folder, shapes in (("horse-gallop", frames), ("lion-poses", frames[2:4]), ("cat-poses", frames[4:6])):
        for number, shape in enumerate(shapes):
            save_mesh(shape, sample.faces, tmp_path / folder / f"{folder}-{number:02d}.obj")
    run = load_example("paper/run")
    rows: list[tuple[str, ...]] = []
    monkeypatch.setattr(run.Table, "add", lambda table, *cells: rows.append(cells))
    monkeypatch.setattr(sys, "argv", ["run", "--meshes", str(tmp_path), "--only", "linear", "lion"])
    run.main()
    assert [row[0] for row in rows] == ["linear", "linear", "lion", "paper: lion"]
    assert rows[0][1] == "4.04 %"  # as in the page
    monkeypatch.setattr(sys, "argv", ["run", "--meshes", str(tmp_path / "elsewhere"), "--parts", "2"])
    with pytest.raises(SystemExit, match="poses of the lion are needed there"):
        run.main()


def test_small_examples_run(tmp_path: Path) -> None:
    """One of each public thing that needs no more than thirty lines."""
    sample = load_sample("creature")
    shapes = load_example("blend").main(tmp_path / "blend")
    assert len(list((tmp_path / "blend").glob("*.obj"))) == len(shapes) == 2
    means = edge_lengths(sample.keyframes, sample.faces).mean(0)
    both = (shapes[0], sample.keyframes.mean(0))
    ours, linear = (float((edge_lengths(x, sample.faces) / means - 1).abs().mean()) for x in both)
    assert ours < 0.3 * linear
    speeds = load_example("path").main(tmp_path / "path.glb")
    assert (tmp_path / "path.glb").stat().st_size > 1e5 and 0.2 < float(speeds.min()) < float(speeds.max()) < 20
    plain, stiffer = load_example("own_term").main()
    assert 1e-4 < float((stiffer - plain).norm(dim=-1).mean()) < 0.1


@pytest.mark.slow
def test_register_folder_leaves_out_a_mesh_that_is_nothing_alike(tmp_path: Path) -> None:
    """Two bent bodies of other vertices, whose true places are known, and a torus."""
    for library in ("robust_laplacian", "potpourri3d", "igl"):
        pytest.importorskip(library, reason=f"{library} is not installed; it is part of the extra 'register'")
    rest, faces = limbs(3)
    poses = [twist(rest, 1.0, angle, -3.0, 3.0) for angle in (0.4, 0.9)]
    order = torch.randperm(len(rest), generator=torch.Generator().manual_seed(0)).numpy()
    for number, pose in enumerate(poses):
        save_mesh(pose[order], order.argsort()[faces], tmp_path / "scans" / f"pose-{number}.ply")
    torus = trimesh.creation.torus(major_radius=2, minor_radius=0.5)
    save_mesh(torus.vertices, torus.faces, tmp_path / "scans" / "torus.ply")
    (template,) = save_mesh(rest, faces, tmp_path / "template.obj")
    space = load_example("register_folder").main(template, tmp_path / "scans", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["pose-0.obj", "pose-1.obj", "report.csv"]
    head, *rows = (tmp_path / "out" / "report.csv").read_text(encoding="utf-8").splitlines()
    assert head.startswith("target,confidence,") and [row.split(",")[0] for row in rows] == [
        "pose-0.ply",
        "pose-1.ply",
        "torus.ply",
    ]
    truth = [torch.from_numpy(rest), *(align(torch.from_numpy(pose), torch.from_numpy(rest)) for pose in poses)]
    assert len(space) == 3 and max(apart(x, y) for x, y in zip(space.keyframes(), truth, strict=True)) < 0.03
