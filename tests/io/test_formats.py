"""Output formats of one's own: one function each, found by its suffix."""

from pathlib import Path

import numpy as np
import pytest
from helpers.textured import bend, textured_obj

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.errors import MeshWarning
from torch_modal.io.asset import Asset
from torch_modal.io.formats import ANIMATION_FORMATS, MESH_FORMATS, Animation, OutputFormat

FACES = np.array([[0, 1, 2]])
FRAMES = np.arange(18.0).reshape(2, 3, 3)


def xyz(vertices: np.ndarray, faces: np.ndarray, asset: Asset | None) -> bytes:
    return "".join(f"{x} {y} {z}\n" for x, y, z in vertices).encode()


def csv(animation: Animation, path: Path) -> None:
    times, shown = animation.timing.knots()
    np.savetxt(path, np.column_stack([times, animation.shapes[shown].reshape(len(times), -1)]), delimiter=",")


@pytest.fixture(autouse=True)
def own_formats(monkeypatch: pytest.MonkeyPatch) -> None:
    """Formats that are registered during one test; one stands in the place of a built-in one."""
    monkeypatch.setitem(MESH_FORMATS, ".xyz", OutputFormat(xyz, holds=("polygons", "texcoords", "normals")))
    monkeypatch.setitem(MESH_FORMATS, ".off", OutputFormat(xyz))
    monkeypatch.setitem(ANIMATION_FORMATS, ".csv", OutputFormat(csv))
    monkeypatch.setitem(ANIMATION_FORMATS, ".needs", OutputFormat(csv, modules=("no_such_module",), extra="none"))


def test_own_formats_write(tmp_path: Path) -> None:
    for fmt in ("xyz", "off"):
        paths = tm.save_mesh(FRAMES, FACES, tmp_path, fmt)
        np.testing.assert_array_equal([np.loadtxt(path) for path in paths], FRAMES)
    rows = np.loadtxt(tm.save_animation(FRAMES, FACES, tmp_path / "a.csv", duration=3), delimiter=",")
    np.testing.assert_array_equal(rows[:, 0], [0, 3])
    np.testing.assert_array_equal(rows[:, 1:], FRAMES.reshape(2, 9))
    with pytest.raises(ImportError, match="no_such_module"):
        tm.save_animation(FRAMES, FACES, tmp_path / "a.needs")
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".csv", ".off", ".off", ".xyz", ".xyz"]
    asset = tm.open_asset(textured_obj(tmp_path / "in", "bar.obj"))
    with pytest.warns(MeshWarning, match=r"frame-000.xyz is without the vertex colours, 2 materials and groups"):
        tm.save_mesh(bend(asset.positions)[None], asset.faces, tmp_path / "out", "xyz", asset=asset)


def test_messages_and_help_list_all_formats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"\.npz or \.csv or \.needs, got 'a\.avi'"):
        tm.save_animation(FRAMES, FACES, tmp_path / "a.avi")
    with pytest.raises(ValueError, match="fmt must be one of ply, obj, off, glb, stl, vtk, vtp, xyz, got 'step'"):
        tm.save_mesh(FRAMES, FACES, tmp_path, "step")
    with pytest.raises(SystemExit):
        cli.main(["subdivide", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "{ply,obj,off,glb,stl,vtk,vtp,xyz}" in said
    assert all(suffix in said for suffix in (".glb", ".mp4", ".usdc", ".npz"))
