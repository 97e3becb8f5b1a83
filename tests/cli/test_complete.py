"""``torch-modal complete``: which files arrive, what is written and said, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
from PIL import Image
from test_cli import fails, misused

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.completion.complete import Completion


@pytest.fixture
def files(capsule: tuple[np.ndarray, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a template, the same moved by 3, ten scans of it and markers on the way."""
    x, faces = (torch.from_numpy(each) for each in capsule)
    monkeypatch.chdir(tmp_path)
    tm.save_mesh(x, faces, "template.obj")
    tm.save_mesh(x + torch.tensor([3.0, 0, 0]), faces, "later.obj")
    for i in range(10):
        tm.save_mesh(x + torch.tensor([0.3 * i, 0, 0]), faces.flip(0), f"scans/s-{i:02d}.ply")
    rows = [f"{t},{v},{x[v, 0] + t},{x[v, 1]},{x[v, 2]}\n" for t in (0.5, 1.5) for v in range(0, 100, 9)]
    Path("markers.csv").write_text("time,vertex,x,y,z\n" + "".join(rows))
    return tmp_path


@pytest.fixture
def arrived(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What `tm.complete` was called with; in its place stands the first shape, which moves by t."""
    seen: dict[str, Any] = {}

    def complete(rests: torch.Tensor, faces: torch.Tensor, observations: list[tm.Observation], **options: Any) -> Any:
        seen.update(rests=rests, faces=faces, observations=observations, **options)
        at = torch.tensor(sorted({one.time for one in observations}), dtype=torch.float64)
        knots = sorted({*at.tolist(), *(options["times"] or ())})
        first = rests.reshape(-1, *rests.shape[-2:])[0]
        moved = torch.stack([first + torch.tensor([t, 0, 0]).to(first) for t in knots])
        shapes = moved[[knots.index(t) for t in at.tolist()]]
        confidence = torch.ones_like(shapes[..., 0])
        confidence[-1, : len(first) // 2] = 0.1
        errors = 0.02 * (first.amax(0) - first.amin(0)).norm() * (1 - confidence)
        misses = [one.points.new_full((len(one.points),), 0.05) for one in observations]
        path = tm.Path(moved, faces, times=knots) if len(knots) > 1 else None
        return Completion(at, shapes, errors, confidence, misses, [m.new_ones(len(m)) for m in misses], moved, path)

    monkeypatch.setattr(tm, "complete", complete)
    return seen


SCANS = [f"scans/s-{i:02d}.ply" for i in range(10)]


def animation(path: Path) -> tuple[dict[str, Any], float]:
    """The extras and the duration of the animation of a GLB."""
    gltf = pygltflib.GLTF2().load_binary(str(path))
    return gltf.animations[0].extras, gltf.accessors[gltf.animations[0].samplers[0].input].max[0]


def test_template_and_scans(files: Path, arrived: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    times = [str(0.5 * i) for i in range(10)]
    argv = ["complete", "template.obj", *SCANS, "--times", *times, "--out", "motion.glb", "--picture", "seen.png"]
    assert cli.main([*argv, "--noise", "0.01", "--view", "0", "0", "-2", "--estimate-times"]) == 0
    template, faces = tm.load_keyframes(["template.obj"])
    assert torch.equal(arrived["rests"], template[0]) and torch.equal(arrived["faces"], faces)
    assert arrived["times"] is None and arrived["progress"] is None
    assert arrived["estimate_times"] is True and arrived["contact"] is False
    observations = arrived["observations"]
    assert [one.time for one in observations] == [0.5 * i for i in range(10)]
    assert {(one.noise, tuple(one.view.tolist())) for one in observations} == {(0.01, (0, 0, -1))}
    assert all(one.normals is not None and one.points.shape == template[0].shape for one in observations)
    torch.testing.assert_close(
        observations[2].points - template[0],
        torch.tensor([0.6, 0, 0]).expand_as(template[0]),
        atol=1e-6,
        rtol=0,
        check_dtype=False,
    )
    extras, seconds = animation(files / "motion.glb")
    assert extras["keyframes"] == [] and seconds == pytest.approx(36 / 24)  # four for each of nine intervals
    said = capsys.readouterr()
    assert said.err == ""
    diagonal = float((template[0].amax(0) - template[0].amin(0)).norm())
    for text in (
        f"10 observations of {10 * template.shape[1]} points",
        "animation: motion.glb",
        "picture:   seen.png",
        f"points lie {5 / diagonal:.2f} % of the diagonal off",
        "nine of ten vertices are expected within 0.09 %, most at t = 4.5 (0.90 %)",
    ):
        assert text in said.out


def test_exact_keyframes_and_markers(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Through the solver itself; the key-frames come back bit for bit."""
    argv = ["complete", "template.obj", "markers.csv", "--keyframes", "later.obj", "--keyframe-times", "0", "2"]
    assert cli.main([*argv, "--out", "out", "--frames", "5", "--fps", "10", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    written = sorted(file.name for file in (files / "out").iterdir())
    assert written == ["animation.glb", *(f"frame-00{i}.obj" for i in range(5))]
    frames, _ = tm.load_keyframes([f"out/frame-00{i}.obj" for i in range(5)])
    keyframes, _ = tm.load_keyframes(["template.obj", "later.obj"])
    assert torch.equal(frames[[0, -1]], keyframes)
    extras, seconds = animation(files / "out" / "animation.glb")
    assert extras["keyframes"] == [0, 4] and seconds == pytest.approx(0.4)


def test_markers_at_the_time_of_a_keyframe_beside_others(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["complete", "template.obj", "markers.csv", "--keyframes", "later.obj", "--keyframe-times", "0.5", "2"]
    assert cli.main([*argv, "--out", "motion.npz", "--frames", "3", "--quiet", "--estimate-times"]) == 0
    keyframes, _ = tm.load_keyframes(["template.obj", "later.obj"])
    np.testing.assert_array_equal(np.load("motion.npz")["frames"][[0, -1]], keyframes.numpy())


def test_markers_and_keyframes_arrive(files: Path, arrived: dict[str, Any]) -> None:
    argv = ["complete", "template.obj", "markers.csv", SCANS[1], "--keyframes", "later.obj"]
    argv += ["--keyframe-times", "0", "2"]
    assert cli.main([*argv, "--times", "1.75", "--out", "motion.npz", "--quiet"]) == 0
    assert arrived["rests"].shape[0] == 2 and arrived["times"] == [0.0, 2.0]
    first, second, cloud = arrived["observations"]
    assert (first.time, second.time, cloud.time) == (0.5, 1.5, 1.75)
    assert first.vertices.tolist() == list(range(0, 100, 9)) and cloud.is_cloud
    stored = np.load(files / "motion.npz")  # eight frames for each of four intervals, even in each
    assert stored["frames"].shape[0] == 33 and stored["keyframes"].tolist() == [0, 32]
    np.testing.assert_allclose(stored["times"][[0, 8, 16, 24]] / stored["times"][-1], [0, 0.25, 0.75, 0.875])


def test_markers_keep_their_places_where_seams_are_welded(
    files: Path, capsule: tuple[np.ndarray, np.ndarray], arrived: dict[str, Any]
) -> None:
    """A file whose triangles share no vertices: the vertices of the file are those that markers name."""
    x, faces = capsule
    loose = torch.from_numpy(x[faces].reshape(-1, 3))
    tm.save_mesh(loose, torch.arange(len(loose)).reshape(-1, 3), "loose.obj")
    chosen = [5, 100, 300, 301]
    rows = [f"0,{v},{loose[v, 0]},{loose[v, 1]},{loose[v, 2]}\n" for v in chosen]
    Path("m.csv").write_text("time,vertex,x,y,z\n" + "".join(rows))
    assert cli.main(["complete", "loose.obj", "m.csv", "--out", "still.npz", "--quiet"]) == 0
    (one,) = arrived["observations"]
    assert arrived["rests"].shape == x.shape
    torch.testing.assert_close(arrived["rests"][one.vertices], loose[chosen], rtol=1e-8, atol=0)
    assert np.load("still.npz")["frames"].shape == (1, *loose.shape)  # one time alone stands still


def test_picture_has_the_points_above_the_shapes(
    files: Path, arrived: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most eight columns, of the first and the last time too; observations of one time share theirs."""
    drawn: dict[str, Any] = {}
    render = tm.render_sequence
    monkeypatch.setattr(
        tm, "render_sequence", lambda *args, **options: drawn.update(options) or render(*args, **options)
    )
    argv = ["complete", "template.obj", *SCANS, SCANS[9], "--out", "a.glb", "--picture", "p.png", "--quiet"]
    assert cli.main([*argv, "--times", *"01234567899"]) == 0
    times = [float(title.removeprefix("t = ")) for title in drawn["titles"]]
    assert len(times) == 8 and times[0] == 0 and times[-1] == 9
    for time, cloud in zip(times, drawn["points"]["seen"], strict=True):
        assert len(cloud) == len(arrived["rests"]) * (2 if time == 9 else 1)
        assert float(cloud[:, 0].mean() - arrived["rests"][:, 0].mean()) == pytest.approx(0.3 * time, abs=1e-5)
    errors = drawn["colors"]["completed"]
    assert errors[:-1].max() == 0 < errors[-1].max() and Image.open("p.png").format == "PNG"


def test_an_order_of_names_that_is_none_of_numbers_is_warned_of(
    files: Path, arrived: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """As shells have it: s-10 stands before s-9."""
    Path("s-10.ply").write_bytes(Path(SCANS[1]).read_bytes())
    Path("s-9.ply").write_bytes(Path(SCANS[0]).read_bytes())
    argv = ["complete", "template.obj", "s-10.ply", "s-9.ply", "--out", "a.npz", "--overwrite"]
    assert cli.main(argv) == 0
    assert "warning: s-10.ply, s-9.ply, ... were seen at 0, 1" in capsys.readouterr().err
    assert cli.main([*argv, "--times", "10", "9"]) == 0
    assert capsys.readouterr().err == ""


def test_what_cannot_work_is_refused_before_the_work(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def started(*_: object, **__: object) -> None:
        raise AssertionError("the work was started")

    monkeypatch.setattr(tm, "complete", started)
    base, out = ["complete", "template.obj", *SCANS], ["--out", "a.glb"]
    assert "a time for each of template.obj, later.obj; got 0" in misused(
        capsys, *base, *out, "--keyframes", "later.obj"
    )
    argv = [*base, *out, "--keyframes", "later.obj", "--keyframe-times", "3"]
    assert "later.obj; got 1" in misused(capsys, *argv)
    assert "template.obj; got 2" in misused(capsys, *base, *out, "--keyframe-times", "3", "4")
    assert "must be 2 or more, and 100000 at most; got 1" in misused(capsys, *base, *out, "--frames", "1")
    assert "100000 at most; got 100000000" in misused(capsys, *base, *out, "--frames", "100000000")
    assert "required: SEEN" in misused(capsys, "complete", "template.obj", *out)
    assert "noise is a length above 0" in fails(capsys, *base, *out, "--noise", "0")
    assert "2 times for 10 clouds (scans/s-00.ply, " in fails(capsys, *base, *out, "--times", "0", "1")
    assert "view is a direction" in fails(capsys, *base, *out, "--view", "0", "0", "0")
    own = ["--keyframes", "a.glb", "--keyframe-times", "0", "1", "--overwrite"]
    assert "is one of the meshes that are read" in fails(capsys, *base, *out, *own)
    Path("a.glb").write_text("mine")
    assert "a.glb exists, and may not be replaced" in fails(capsys, *base, *out)
    assert Path("a.glb").read_text() == "mine"
    Path("bad.csv").write_text("time,vertex,x,y,z\n0,4000,0,0,0\n")
    assert "bad.csv, line 2: vertex 4000 " in fails(capsys, "complete", "template.obj", "bad.csv", "--out", "b.glb")
    assert "missing.ply: no such file" in fails(capsys, "complete", "template.obj", "missing.ply", "--out", "b.glb")
    assert not Path("b.glb").exists()
