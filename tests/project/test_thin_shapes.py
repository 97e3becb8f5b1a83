"""Sheets all the way: modes of the surface, and everything that is made of them."""

import logging
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.shapes import edge_error, edge_lengths
from helpers.sheets import cylinder, rectangle, rolled
from torch import Tensor

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.data.stored import StoredSet
from torch_modal.geometry.canonical import size
from torch_modal.io.write import save_mesh
from torch_modal.modes.sheet import THICKNESS

pytestmark = pytest.mark.filterwarnings("ignore::torch_modal.keyframes.check.MeshWarning")

LENGTH = 4.0
STRIP, TRIANGLES = rectangle(LENGTH, 1.0, 0.13)
FACES = torch.from_numpy(TRIANGLES)


def roll(time: float, turns: float = 0.8) -> Tensor:
    """A flat strip, which rolls up."""
    return torch.from_numpy(cylinder(STRIP, time, partial(rolled, length=LENGTH, turns=turns)))


def strain(x: Tensor) -> float:
    return edge_error(x, roll(0.0), FACES)


@pytest.fixture(scope="module")
def bases() -> list[tm.ModalBasis]:
    return tm.extract_bases(torch.stack([roll(0.0), roll(1.0)]), FACES, 20, cache=False, progress=False)


def test_encoded_and_decoded(tmp_path: Path) -> None:
    frames = torch.stack([roll(t) for t in np.linspace(0, 1, 9)])
    encoded = tm.encode(frames, FACES, [0, 8], n_modes=20)
    encoded.save(tmp_path / "roll.safetensors")
    decoded = tm.ModalSequence.load(tmp_path / "roll.safetensors").decode()
    assert (decoded - frames).norm(dim=-1).mean() < 0.01 * LENGTH
    basis = tm.extract_modes(frames[0], FACES, 20, cache=False)
    decoder = tm.ModalDecoder(frames[[0, 8]], FACES, [0.0, 1.0], frames[0], basis.modes)
    amplitudes = 0.3 * torch.eye(20, dtype=frames.dtype)
    assert all(strain(shape) < 0.02 for shape in decoder(amplitudes, torch.full((20,), 0.5)))


def test_draws_have_the_strain_of_the_sides(bases: list[tm.ModalBasis]) -> None:
    """Edges keep their lengths to first order: what is given is the strain of a sheet of a certain thickness."""
    space = tm.ShapeSpace(bases[0], FACES)
    flat = roll(0.0)
    for given in (0.005, 0.02):
        transform = tm.RandomModalDeformation(
            given, p=1.0, space=space, generator=torch.Generator().manual_seed(0), max_strain=0.5
        )
        drawn = transform(flat.expand(64, -1, -1))
        meshes = [trimesh.Trimesh(x.numpy(), TRIANGLES, process=False) for x in drawn]
        i, j = meshes[0].face_adjacency.T
        centres = flat[FACES].mean(1).numpy()
        angles = np.stack([mesh.face_adjacency_angles for mesh in meshes])
        curvature = angles / np.linalg.norm(centres[i] - centres[j], axis=1)
        sides = 0.5 * THICKNESS * size(flat.numpy(), TRIANGLES) * curvature
        assert np.sqrt((sides**2).mean()) == pytest.approx(given, rel=0.4)
        assert float((edge_lengths(drawn, FACES) / edge_lengths(flat, FACES) - 1).abs().mean()) < given


def test_commands_and_trees(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    shapes = torch.stack([roll(0.0), roll(1.0)])
    files = save_mesh(shapes.numpy(), TRIANGLES, tmp_path / "in" / "roll", fmt="obj")
    out = ["--out", str(tmp_path / "frames"), "--modes", "8", "--levels", "1", "--no-cache"]
    modal = ["--format", "obj", "--preset", "modal"]
    with caplog.at_level(logging.INFO, "torch_modal"):
        assert cli.main(["subdivide", *map(str, files), *out, *modal]) == 0
    assert "modes of the surface itself, not of a solid: key-frame 0 is open" in caplog.text
    frames, _ = tm.load_keyframes(sorted((tmp_path / "frames").glob("*.obj")))
    assert strain(frames[1]) < 2e-3
    asked = ["--method", "solid", "--overwrite"]
    assert cli.main(["subdivide", *map(str, files), *out, *modal, *asked]) == 1
    assert "the surface is flat" in capsys.readouterr().err

    tree = ["precompute", str(tmp_path / "in"), "--out", str(tmp_path / "bases"), "--modes", "8"]
    assert cli.main([*tree, "--method", "shell"]) == 0
    here = tm.extract_bases(shapes, FACES, 8, method="shell", cache=False)
    for mine, its in zip(here, StoredSet(tmp_path / "bases" / "roll").bases, strict=True):
        torch.testing.assert_close(its.eigenvalues, mine.eigenvalues)
