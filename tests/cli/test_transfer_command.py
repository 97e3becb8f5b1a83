"""The command that moves another body."""

from pathlib import Path

import pytest
import torch
from helpers.shapes import apart, coarsened
from test_cli import fails

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.geometry.decimation import decimate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of the sample, and a body of other faces, half as large, in the pose of the first."""
    folder = tmp_path_factory.mktemp("transfer")
    x, faces, *_ = tm.load_sample("creature")
    x, faces = coarsened(x[:3], faces, 3000)
    tm.save_mesh(x, faces, folder / "gait", "ply")
    points, own, _ = decimate(x[0].numpy(), faces.numpy(), 2000)
    tm.save_mesh(0.5 * points, own, folder / "camel.obj")
    return folder


@pytest.fixture(scope="module")
def gait(folder: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """The frames as they are in the files, so that their map is found once."""
    return tm.load_keyframes(sorted((folder / "gait").glob("*.ply")))


def test_a_gait_on_another_body(
    folder: Path, gait: tuple[torch.Tensor, torch.Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "camel.glb", tmp_path / "camel.png"
    x, source = gait
    frames = str(folder / "gait" / "*.ply")
    command = ["transfer", frames, "--to", str(folder / "camel.obj"), "--out", str(out), "--picture", str(picture)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert f"3 frames of {x.shape[1]} vertices" in said and "confidence" in said and picture.exists()
    target = tm.open_asset(folder / "camel.obj")
    moved = tm.transfer(x, source, target.positions, target.faces)
    assert apart(tm.load_sequence(out).frames, moved) < 1e-4
    assert "exists" in fails(capsys, *command)


def test_the_same_faces_need_no_map(
    folder: Path, gait: tuple[torch.Tensor, torch.Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = sorted((folder / "gait").glob("*.ply"))[0]
    command = ["transfer", str(folder / "gait"), "--to", str(first), "--out", str(tmp_path / "same"), "--no-anchors"]
    assert main([*command, "--format", "obj"]) == 0
    assert "map:" not in capsys.readouterr().out
    written = tm.load_keyframes(sorted((tmp_path / "same").glob("frame-*.obj"))).keyframes
    assert apart(written, gait[0]) < 1e-5


def test_a_map_that_is_not_trusted(
    folder: Path,
    gait: tuple[torch.Tensor, torch.Tensor],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target = tm.open_asset(folder / "camel.obj")
    x, faces = gait
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
