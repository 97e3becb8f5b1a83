"""The benchmark of motions as bones, on a folder in its layout."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import skinning
from test_skin import BENT, FACES

import torch_modal as tm


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of a bending tube, and a reference pose that is no frame."""
    folder = tmp_path_factory.mktemp("gallop")
    for i, frame in enumerate(BENT):
        tm.save_mesh(frame, FACES, folder / f"tube-{i + 1:02d}.obj")
    tm.save_mesh(3 * BENT[0], FACES, folder / "tube-reference.obj")
    return folder


def test_a_folder_is_scored_beside_published_numbers(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--bones", "2", "6", "10", "--keep", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["skinning.py", str(folder), *options])
    monkeypatch.setattr(skinning, "limit_threads", lambda: None)
    skinning.main()
    table = json.loads((tmp_path / "skinning.json").read_text())
    assert table["columns"] == ["", "frames", "vertices", "2 bones", "6 bones", "10 bones", "s"]
    ours, theirs = table["rows"]
    assert ours[:3] == ["`bake`", str(len(BENT)), str(BENT.shape[1])]
    two, six, ten = map(float, ours[3:6])
    assert two > six > ten > 0
    assert theirs == ["Le and Deng 2014, published, of a gallop", "48", "-", "-", "-", "5.65", "-"]
    # Root mean square of distances instead of coordinates, over a diagonal of 1 instead of 2.
    assert six == pytest.approx(2000 / 3**0.5 * tm.bake(BENT, FACES, 6).error_at_frames, abs=0.011)


def test_the_score_is_of_a_body_of_diagonal_two_in_any_units() -> None:
    x = BENT.numpy()
    diagonal = np.linalg.norm(np.ptp(x[0], axis=0))
    moved = x + 0.003 * diagonal / 2 * np.array([0.0, 1.0, 0.0])
    assert skinning.e_rms(moved, x) == pytest.approx(3 / 3**0.5)
    assert skinning.e_rms(1000 * moved, 1000 * x) == pytest.approx(3 / 3**0.5)


def test_a_folder_without_a_motion_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no meshes"):
        skinning.load(tmp_path)
    tm.save_mesh(BENT[0], FACES, tmp_path / "a-1.obj")
    with pytest.raises(SystemExit, match="has one frame"):
        skinning.load(tmp_path)
