"""The command that moves another body."""

from pathlib import Path

import pytest
import torch
from helpers.shapes import apart
from test_cli import fails

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.geometry.decimation import decimate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of the sample, and a body of other faces, half as large, in the pose of the first."""
    folder = tmp_path_factory.mktemp("transfer")
    x, faces, *_ = tm.load_sample("creature")
    tm.save_mesh(x[:3], faces, folder / "gait", "ply")
    points, own, _ = decimate(x[0].numpy(), faces.numpy(), 3000)
    tm.save_mesh(0.5 * points, own, folder / "camel.obj")
    return folder


def test_a_gait_on_another_body(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, picture = tmp_path / "camel.glb", tmp_path / "camel.png"
    gait = str(folder / "gait" / "*.ply")
    command = ["transfer", gait, "--to", str(folder / "camel.obj"), "--out", str(out), "--picture", str(picture)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "3 frames of 4840 vertices" in said and "confidence" in said and picture.exists()
    frames = tm.load_sequence(out).frames
    target = tm.open_asset(folder / "camel.obj")
    x, source, *_ = tm.load_sample("creature")
    moved = tm.transfer(x[:3], source, target.positions, target.faces)
    assert apart(frames, moved) < 1e-4
    assert "exists" in fails(capsys, *command)


def test_the_same_faces_need_no_map(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = sorted((folder / "gait").glob("*.ply"))[0]
    command = ["transfer", str(folder / "gait"), "--to", str(first), "--out", str(tmp_path / "same"), "--no-anchors"]
    assert main([*command, "--format", "obj"]) == 0
    assert "map:" not in capsys.readouterr().out
    written = tm.load_keyframes(sorted((tmp_path / "same").glob("frame-*.obj"))).keyframes
    assert apart(written, tm.load_sample("creature").keyframes[:3]) < 1e-5


def test_a_map_that_is_not_trusted(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tm.open_asset(folder / "camel.obj")
    x, faces, *_ = tm.load_sample("creature")
    found = tm.register(target.positions, target.faces, x[0], faces, same_subject=False)
    doubtful = found._replace(confidence=0.1, warnings=("another map fits nearly as well",))
    monkeypatch.setattr("torch_modal.motion.transfer.register", lambda *_, **__: doubtful)
    command = ["transfer", str(folder / "gait"), "--to", str(folder / "camel.obj"), "--out", str(tmp_path / "a.npz")]
    said = fails(capsys, *command, "--quiet")
    assert all(text in said for text in ("another map fits nearly as well", "--landmarks", "--keep-doubtful"))
    assert "=" not in said  # no Python
    assert not (tmp_path / "a.npz").exists()
    assert main([*command, "--keep-doubtful"]) == 0
    assert torch.isfinite(tm.load_sequence(tmp_path / "a.npz").frames).all()
