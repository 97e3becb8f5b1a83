"""The table of volumes and strains that ``torch-modal check --table`` writes."""

import csv
from pathlib import Path

import numpy as np
import pytest
from helpers.solids import as_mesh, box

from torch_modal.cli.main import main
from torch_modal.io.write import save_mesh

STRETCH = np.diag([1.2, 0.9, 1.0])


def test_strains_and_volumes_of_a_stretched_box_are_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Faces across x have strains -0.1 and 0, across y 0 and 0.2, across z -0.1 and 0.2; a turn changes nothing."""
    points, faces = as_mesh(box((3, 3, 3), (2.0, 1.0, 1.0)))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shapes = np.stack([points, points @ turn.T, points @ STRETCH @ turn.T])
    files = [str(path) for path in save_mesh(shapes, faces, tmp_path, "obj")]
    table = tmp_path / "strains.csv"
    assert main(["check", *files, "--table", str(table)]) == 0
    assert f"table:   {table}" in capsys.readouterr().out
    rows = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 3 * len(faces) and [row["shape"] for row in rows[:: len(faces)]] == files
    volume, face, area, least, largest = (
        np.array([float(row[name]) for row in rows]).reshape(3, -1)
        for name in ("volume", "face", "area", "least strain", "largest strain")
    )
    np.testing.assert_allclose(volume, np.broadcast_to([[2], [2], [2 * 1.2 * 0.9]], volume.shape), rtol=1e-6)
    assert (face == np.arange(len(faces))).all()
    np.testing.assert_allclose([least[:2], largest[:2]], 0, atol=2e-6)
    normals = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    axis = np.abs(normals).argmax(1)
    np.testing.assert_allclose(least[2], np.array([-0.1, 0, -0.1])[axis], atol=2e-6)
    np.testing.assert_allclose(largest[2], np.array([0, 0.2, 0.2])[axis], atol=2e-6)
    np.testing.assert_allclose(area[0], np.linalg.norm(normals, axis=1) / 2, rtol=1e-5)
    assert main(["check", *files, "--table", str(table)]) == 1  # it exists
    assert "--overwrite" in capsys.readouterr().err
    assert main(["check", *files, "--table", str(tmp_path / "strains.txt")]) == 1
    assert ".csv" in capsys.readouterr().err
