"""The commands as they are typed: exit codes, files, one-line errors, nothing overwritten unasked."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pygltflib
import pytest
import torch
from conftest import listen_to_ctrl_c
from helpers import gltf_validator

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.errors import ModalAnalysisError
from torch_modal.io.write import save_mesh
from torch_modal.modes import lattice as lattice_module
from torch_modal.modes.extract import MESHERS
from torch_modal.modes.tetwild import TetWild

FAST = ["--modes", "6", "--levels", "1", "--preset", "fast"]


@pytest.fixture(scope="module")
def meshes(capsule: tuple[np.ndarray, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A straight and a bent capsule as OBJ files, which hold float64 exactly."""
    straight, faces = capsule
    x, y, z = (straight - straight.mean(0)).T
    radius = 4.2 / 1.2
    bent = np.stack([radius - (radius - x) * np.cos(z / radius), y, (radius - x) * np.sin(z / radius)], axis=1)
    folder = tmp_path_factory.mktemp("meshes")
    return [str(file) for file in save_mesh(np.stack([straight, bent]), faces, folder, fmt="obj", stem="key")]


@pytest.fixture(autouse=True)
def coarse_tetrahedra(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the mesher's time; nothing here depends on how fine the tetrahedra are."""
    monkeypatch.setitem(MESHERS, "tetwild", lambda: TetWild(edge_length_fac=0.05, epsilon=3e-3))


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails the test if the long part starts."""

    def started(*_: object, **__: object) -> None:
        raise AssertionError("the mesher was started")

    monkeypatch.setattr(TetWild, "fill", started)
    monkeypatch.setattr(lattice_module, "lattice", started)


def fails(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """Run a command that must fail with exit code 1; its message, which must be one line."""
    capsys.readouterr()
    assert cli.main(argv) == 1
    said = capsys.readouterr()
    assert said.out == ""
    lines = said.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("torch-modal: error: ")
    return lines[0].removeprefix("torch-modal: error: ")


def misused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """Run a command that must be refused as wrong usage; the last line it says."""
    with pytest.raises(SystemExit) as left:
        cli.main(argv)
    assert left.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


def run(*argv: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "torch_modal", *argv]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)  # type: ignore[call-overload]


# ------------------------------------------------------------------------------------------------- subdivide
def test_folder_gets_frames_and_animation(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "new" / "out", tmp_path / "picture.png"
    argv = ["subdivide", *meshes, "--out", str(out), *FAST, "--format", "obj", "--picture", str(picture)]
    assert cli.main(argv) == 0
    assert sorted(file.name for file in out.iterdir()) == [
        "animation.glb",
        *(f"frame-{i:03d}.obj" for i in range(3)),
    ]
    frames, faces = tm.load_keyframes(sorted(out.glob("*.obj")))
    keys = tm.load_keyframes(meshes)
    assert torch.equal(faces, keys.faces)
    assert torch.equal(frames[[0, 2]], keys.keyframes)  # bit for bit, in the caller's coordinates
    # What the library gives with the same options; the cache makes the mesher's result the same.
    bases = tm.extract_bases(*keys, 6)
    expected = tm.subdivide(*keys, 1, bases=bases, preset="fast")
    torch.testing.assert_close(frames, expected, rtol=0, atol=1e-8)
    assert picture.read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr()
    assert "2 key-frames" in said.out and str(picture) in said.out and str(out / "animation.glb") in said.out
    assert said.err == ""


def test_glb_alone_cyclic_with_a_number_of_frames(meshes: list[str], tmp_path: Path) -> None:
    out = tmp_path / "a.GLB"
    argv = ["subdivide", *meshes, "--out", str(out), *FAST, "--cyclic", "--frames", "7", "--fps", "10", "--quiet"]
    assert cli.main(argv) == 0
    assert list(tmp_path.iterdir()) == [out]
    gltf = pygltflib.GLTF2().load_binary(str(out))
    (animation,) = gltf.animations
    assert animation.extras == {"fps": 10.0, "frames": list(range(7)), "keyframes": [0, 4]}
    times = gltf.accessors[animation.samplers[0].input]
    assert times.max == [pytest.approx(0.7)]  # seven frames and the step back to the first


def test_options_arrive(
    meshes: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: dict[str, object] = {}

    def interpolate(keyframes: torch.Tensor, *_: object, **options: object) -> torch.Tensor:
        seen.update(options)
        return keyframes

    monkeypatch.setattr(tm, "interpolate", interpolate)
    argv = ["subdivide", *meshes, "--out", str(tmp_path / "a.glb"), "--modes", "6", "--levels", "0"]
    assert cli.main([*argv, "--preset", "paper", "--no-smooth", "--proxy", "0", "--quiet"]) == 0
    assert (seen["preset"], seen["smooth"], seen["proxy"]) == ("paper", False, 0)
    assert seen["bases"].keywords["n_modes"] == 6  # type: ignore[attr-defined]
    assert capsys.readouterr() == ("", "")


def test_nothing_is_overwritten_and_no_work_is_done_for_it(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], no_work: None
) -> None:
    base = ["subdivide", *meshes, *FAST, "--no-cache"]
    glb, folder, picture = tmp_path / "a.glb", tmp_path / "out", tmp_path / "p.png"
    folder.mkdir()
    for existing, argv in (
        (glb, ["--out", str(glb)]),
        (folder / "animation.glb", ["--out", str(folder)]),
        (folder / "frame-017.obj", ["--out", str(folder)]),
        (folder / "frame-017.ply", ["--out", str(folder), "--format", "ply"]),
        (picture, ["--out", str(tmp_path / "other.glb"), "--picture", str(picture)]),
    ):
        existing.write_text("mine")
        assert "exists, and may not be replaced (--overwrite)" in fails(capsys, *base, *argv)
        assert existing.read_text() == "mine"
        existing.unlink()
    bases = tmp_path / "key-000.safetensors"
    bases.write_text("mine")
    assert "exists" in fails(capsys, "modes", *meshes, "--out", str(tmp_path))
    (tmp_path / "hand.png").write_text("mine")
    assert "exists" in fails(capsys, "demo", "--out", str(tmp_path))


def test_overwrite_replaces_and_names_what_is_left_over(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("animation.glb", "frame-000.obj", "frame-009.obj"):
        (tmp_path / name).write_text("old")
    assert cli.main(["subdivide", *meshes, "--out", str(tmp_path), *FAST, "--overwrite", "--quiet"]) == 0
    assert (tmp_path / "animation.glb").read_bytes().startswith(b"glTF")
    assert (tmp_path / "frame-000.obj").read_bytes().startswith(b"v ")
    assert (tmp_path / "frame-009.obj").read_text() == "old"
    said = capsys.readouterr()
    assert said.out == ""
    assert "warning: " in said.err and "1 frames of an earlier run, from frame-009.obj" in said.err


def test_output_that_cannot_be_written_is_refused_before_the_work(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], no_work: None
) -> None:
    (tmp_path / "file").write_text("")
    base = ["subdivide", *meshes, "--no-cache"]
    (tmp_path / "frame-000.obj").write_bytes(Path(meshes[0]).read_bytes())
    own = ["subdivide", str(tmp_path / "frame-000.obj"), meshes[1], "--out", str(tmp_path), "--overwrite"]
    assert "frame-000.obj is one of the meshes" in fails(capsys, *own)
    assert "is a file" in fails(capsys, *base, "--out", str(tmp_path / "file" / "a.glb"))
    assert "is a file" in fails(capsys, *base, "--out", str(tmp_path / "file"))
    (tmp_path / "b.glb").mkdir()
    assert "is a folder" in fails(capsys, *base, "--out", str(tmp_path / "b.glb"), "--overwrite")
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if not os.access(locked, os.W_OK):  # root may write anywhere
        assert "cannot be written" in fails(capsys, *base, "--out", str(locked / "a.glb"))


# ---------------------------------------------------------------------------------------------------- errors
def test_errors_are_one_line_and_debug_shows_the_traceback(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "a.glb")]
    assert fails(capsys, "subdivide", meshes[0], "missing.obj", *out) == "missing.obj: no such file or folder"
    (tmp_path / "bad.obj").write_text("v 0 0\n")
    message = fails(capsys, "subdivide", meshes[0], str(tmp_path / "bad.obj"), *out)
    assert "a line has fewer than 3 numbers: '0 0'" in message
    assert "whole number from 0 to 12" in fails(capsys, "subdivide", *meshes, *out, "--levels", "13")
    assert "ways to deform" in fails(capsys, "modes", meshes[0], "--out", str(tmp_path), "--modes", "100000")
    with pytest.raises(FileNotFoundError):
        cli.main(["subdivide", meshes[0], "missing.obj", *out, "--debug"])
    assert list(tmp_path.iterdir()) == [tmp_path / "bad.obj"]


def test_failed_mesher_is_one_line_and_a_bug_is_not(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = ["modes", meshes[0], "--out", str(tmp_path), "--no-cache", "--mesher", "tetwild", "--method", "solid"]

    def crash(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(TetWild, "fill", crash)
    error: Exception = ModalAnalysisError("cannot fill\nthis")
    assert fails(capsys, *argv) == "cannot fill this"
    error = TypeError("a bug")
    with pytest.raises(TypeError, match="a bug"):
        cli.main(argv)


def test_warnings_are_lines_and_each_is_shown_once(
    capsule: tuple[np.ndarray, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The open capsule is checked several times on the way."""
    files = save_mesh(np.stack([capsule[0], 1.1 * capsule[0]]), capsule[1][1:], tmp_path / "in", fmt="obj")
    assert cli.main(["subdivide", *map(str, files), "--out", str(tmp_path / "a.glb"), *FAST]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("torch-modal: warning: 3 edges belong to one face only: the surface is open")


def test_wrong_usage(meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "a.glb")]
    assert "required: COMMAND" in misused(capsys)
    assert "two key-frames or more" in misused(capsys, "subdivide", meshes[0], *out)
    assert "required: --out" in misused(capsys, "subdivide", *meshes)
    for name in ("a.obj", "a.xyz", "a.GLTF", "a.mp5"):  # not a folder of that name
        assert ".glb, .mp4" in misused(capsys, "subdivide", *meshes, "--out", name)
    for option in ("--ping-pong", "--ease"):
        assert "begin and end" in fails(capsys, "subdivide", *meshes, *out, "--cyclic", option)
    assert "must end in .png or .pdf" in fails(capsys, "subdivide", *meshes, *out, "--picture", "a.jpg")
    assert "one file, but there are 2" in misused(capsys, "modes", *meshes, "--out", "a.safetensors")
    assert "the same file name" in misused(capsys, "modes", meshes[0], meshes[0], "--out", "a")
    for option, value in (("--levels", "-1"), ("--frames", "1"), ("--duration", "0"), ("--fps", "nan")):
        assert value in fails(capsys, "subdivide", *meshes, *out, option, value)
    assert "invalid int value: '1.5'" in misused(capsys, "subdivide", *meshes, *out, "--levels", "1.5")


def test_interrupt_says_one_line_and_leaves_with_130(meshes: list[str], tmp_path: Path) -> None:
    """Ctrl-C while the mesher runs."""
    out, scratch = tmp_path / "out", tmp_path / "scratch"
    scratch.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "torch_modal", "modes", *meshes, "--no-cache", "--mesher", "tetwild", "--out", str(out)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(scratch)},
        preexec_fn=listen_to_ctrl_c,
    )
    end = time.monotonic() + 100
    while not list(scratch.glob("torch_modal-*/log.txt")):
        assert process.poll() is None and time.monotonic() < end, "the mesher was not started"
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert said == "torch-modal: interrupted\n"
    assert not out.exists() and list(scratch.iterdir()) == []


def test_closed_pipe_is_quiet() -> None:
    """Nobody reads what --help prints."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "torch_modal", "--help"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    os.close(write)
    assert done.stderr == ""


# ------------------------------------------------------------------------------------------- help, modes, demo
def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version").stdout == f"torch-modal {tm.__version__}\n"
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert "torch-modal demo" in capsys.readouterr().out


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_has_an_example_that_the_parser_accepts(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([command, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    examples = [line.split()[1:] for line in text.splitlines() if line.strip().startswith("torch-modal ")]
    assert examples
    assert command in {argv[0] for argv in examples}
    for argv in examples:
        cli.build_parser().parse_args(argv)
    assert "None" not in text


def test_modes_writes_bases(meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["modes", *meshes, "--out", str(tmp_path / "bases"), "--modes", "6"]) == 0
    bases = [tm.ModalBasis.load(tmp_path / "bases" / f"key-00{i}.safetensors") for i in range(2)]
    keyframes = tm.load_keyframes(meshes).keyframes
    for basis, shape in zip(bases, keyframes, strict=True):
        assert torch.equal(basis.reference, shape)
        assert basis.n_modes == 6
    assert capsys.readouterr().out.endswith("key-000.safetensors to key-001.safetensors\n")
    assert cli.main(["modes", meshes[0], "--out", str(tmp_path / "one.safetensors"), "--modes", "6", "--quiet"]) == 0
    assert tm.ModalBasis.load(tmp_path / "one.safetensors").n_modes == 6


def test_a_doubtful_registration_is_written_if_it_is_kept(
    meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    positions = tm.load_keyframes(meshes).keyframes[1]
    result = SimpleNamespace(doubtful=True, warnings=("far",), positions=positions, summary=lambda: "a summary")
    monkeypatch.setattr(tm, "register", lambda *_, **__: result)
    argv = ["register", *meshes, "--out", str(tmp_path / "a.obj"), "--quiet"]
    assert "the result is doubtful: far. To help it" in fails(capsys, *argv)
    assert cli.main([*argv, "--keep-doubtful"]) == 0
    assert "warning: the result is doubtful: far" in capsys.readouterr().err
    assert torch.equal(tm.load_keyframes([tmp_path / "a.obj"]).keyframes[0], positions)


def test_demo_on_the_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    assert cli.main(["demo", "--sample", "hand", "--levels", "2", "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["hand.glb", "hand.png"]
    assert not gltf_validator.issues(out / "hand.glb")
    assert capsys.readouterr().out.splitlines()[-1] == f"picture:   {out / 'hand.png'}"


def test_times_of_keyframes_are_respected(meshes: list[str], tmp_path: Path) -> None:
    """In the frames, and in the animation."""
    three = [*meshes, meshes[0]]
    argv = ["subdivide", *three, "--modes", "6", "--preset", "fast", "--frames", "9", "--quiet", "--times", *"014"]
    assert cli.main([*argv, "--out", str(tmp_path / "a.npz"), "--duration", "2"]) == 0
    stored = np.load(tmp_path / "a.npz")
    assert stored["keyframes"].tolist() == [0, 2, 8]
    np.testing.assert_allclose(stored["times"], np.r_[0, 0.25, np.linspace(0.5, 2, 7)])
    pair = [*argv[:4], *argv[4:8], "--levels", "1", "--quiet"]
    for number, option in enumerate(([], ["--no-smooth"])):
        assert cli.main([*pair, *option, "--out", str(tmp_path / f"{number}.npz")]) == 0
    smooth, straight = (np.load(tmp_path / f"{number}.npz")["frames"] for number in range(2))
    assert np.abs(smooth - straight).max() > 1e-6
