"""The command that makes one file of a sequence."""

import re
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
from helpers import gltf_validator
from helpers.textured import bend, textured_obj, triangles_of_tube
from test_cli import fails

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.data.sequence import smooth_in_time

X, FACES = triangles_of_tube()
FRAMES = np.stack([bend(X, turn) for turn in np.linspace(0.01, 0.9, 9)])
DIAGONAL = np.linalg.norm(np.ptp(FRAMES[0], axis=0))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    tm.save_mesh(FRAMES, FACES, tmp_path / "frames", "obj")
    return tmp_path / "frames"


def errors(text: str) -> list[float]:
    """Errors of the report, as parts of the diagonal."""
    return [0.01 * float(number) for number in re.findall(r"([\d.]+) %", text.split("error:")[1])]


def rms(x: torch.Tensor, frames: np.ndarray) -> float:
    return float((x - torch.tensor(frames)).square().sum(-1).mean().sqrt() / DIAGONAL)


def test_a_folder_becomes_a_skin(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.glb"
    assert main(["bake", str(folder), "--bones", "6", "--fps", "12", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert not gltf_validator.issues(out)
    frames, faces, fps = tm.load_sequence(out)
    skin = tm.bake(FRAMES, FACES, 6)
    assert fps == pytest.approx(12) and np.array_equal(faces, FACES)
    assert (frames - skin.shapes()).abs().max() < 1e-4 * DIAGONAL
    assert f"9 frames of {len(X)} vertices, 12 a second" in said and f"{skin.weights.shape[1]} bones" in said
    at, between = errors(said)
    assert at == pytest.approx(rms(frames, FRAMES), abs=1e-4)
    assert between == pytest.approx(skin.error_between_frames, abs=1e-5)
    # The skin is a sequence again: here as a point cache, at another rate.
    assert main(["bake", str(out), "--fps", "24", "--out", str(tmp_path / "b.npz"), "--quiet"]) == 0
    assert tm.load_sequence(tmp_path / "b.npz").frames[::2].sub(frames).abs().max() < 1e-5 * DIAGONAL


def test_key_frames_alone_and_the_path_between_them(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.npz"
    assert main(["bake", str(folder / "*.obj"), "--every", "3", "--out", str(out)]) == 0
    (between,) = errors(capsys.readouterr().out)
    frames = tm.load_sequence(out).frames
    kept = torch.tensor(FRAMES[[0, 3, 6, 8]])
    torch.testing.assert_close(frames[[0, 3, 6, 8]], kept, rtol=1e-8, atol=1e-12)  # nine digits
    others = [1, 2, 4, 5, 7]
    assert between == pytest.approx(rms(frames[others], FRAMES[others]), abs=1e-5) and between < 2e-3
    assert main(["bake", str(folder), "--every", "4", "--cyclic", "--out", str(out), "--overwrite", "--quiet"]) == 0
    again = tm.load_sequence(out).frames
    torch.testing.assert_close(again[[0, 4]], torch.tensor(FRAMES[[0, 4]]), rtol=1e-8, atol=1e-12)


def test_trembling_is_taken_out(folder: Path, tmp_path: Path) -> None:
    t = torch.arange(48, dtype=torch.float64)
    for cyclic in (False, True):
        slow, fast = (torch.sin(2 * torch.pi * t / period)[:, None, None] for period in (48, 4))
        found = smooth_in_time(slow + fast, 4, cyclic)
        inside = slice(12, 36)
        torch.testing.assert_close(found[inside], (slow + 0.5 * fast)[inside], atol=1e-3, rtol=0)
    straight = t[:, None, None] * torch.ones(1, 2, 3, dtype=torch.float64) + 5
    torch.testing.assert_close(smooth_in_time(straight, 8), straight)
    out = tmp_path / "a.npz"
    assert main(["bake", str(folder), "--smooth", "4", "--out", str(out), "--quiet"]) == 0
    torch.testing.assert_close(tm.load_sequence(out).frames, smooth_in_time(torch.tensor(FRAMES), 4))


def test_materials_come_from_the_first_mesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    moved = np.stack([bend(asset.positions, turn) for turn in (0.01, 0.4, 0.8)])
    files = tm.save_mesh(moved, asset.faces, tmp_path / "in", asset=asset)
    with pytest.warns(tm.MeshWarning, match="quads"):
        tm.save_animation(moved, asset.faces, tmp_path / "a.glb", asset=asset)
    assert main(["bake", *map(str, files), "--bones", "4", "--out", str(tmp_path / "b.glb")]) == 0
    assert errors(capsys.readouterr().out)[0] < 0.01
    one, two = (pygltflib.GLTF2().load(str(tmp_path / name)).materials for name in ("a.glb", "b.glb"))
    assert [material.to_json() for material in one] == [material.to_json() for material in two]


def test_meshes_of_different_connectivity_are_registered(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = {}

    def load(paths: object, **options: object) -> tuple[torch.Tensor, torch.Tensor]:
        seen.update(options)
        return torch.tensor(FRAMES), torch.tensor(FACES)

    monkeypatch.setattr("torch_modal.data.sequence.load_keyframes", load)
    out = ["--out", str(tmp_path / "a.npz"), "--quiet"]
    assert main(["bake", str(folder), "--register", "--across", "--no-cache", *out]) == 0
    assert seen["register"] and not seen["same_subject"] and not seen["cache"]


def test_nothing_is_overwritten_and_one_shape_is_no_motion(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.glb"
    out.write_text("mine")
    bake = ["bake", str(folder), "--out"]
    assert "exists, and may not be replaced (--overwrite)" in fails(capsys, *bake, str(out))
    assert out.read_text() == "mine"
    np.savez(tmp_path / "a.npz", frames=FRAMES, faces=FACES)
    assert main(["bake", str(tmp_path / "a.npz"), "--targets", "2", "--out", str(out), "--overwrite", "--quiet"]) == 0
    assert 1e-5 < rms(tm.load_sequence(out).frames, FRAMES) < 0.05
    own = ["bake", str(out), "--bones", "3", "--out", str(out), "--overwrite"]
    assert "is one of the meshes that are read" in fails(capsys, *own)
    alone = ["bake", str(folder / "frame-000.obj"), "--out", str(tmp_path / "b.glb")]
    assert "is one shape; a motion has two frames or more" in fails(capsys, *alone)
    assert "must end in" in fails(capsys, *bake, str(tmp_path / "b.obj"))
    assert "two forms of a .glb file" in fails(capsys, *bake, "b.usda", "--bones", "3")
    assert "smooth must be a positive number" in fails(capsys, *bake, "b.glb", "--smooth", "0", "--quiet")
    assert "ask for it too (--register)" in fails(capsys, *bake, "b.glb", "--across")
