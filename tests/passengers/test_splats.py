"""PLY files of points and splats that follow meshes: positions, axes, scales, harmonics, bytes, the command."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import Shapes
from scipy.spatial.transform import Rotation

from torch_modal.cli import main as cli
from torch_modal.io.ply import PlyFile
from torch_modal.io.points import PointFile, evaluate_harmonics, rotate_harmonics
from torch_modal.io.write import save_mesh

NAMES = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
NAMES += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def write_splats(path: Path, positions: np.ndarray, n_rest: int = 45) -> np.ndarray:
    """A file as trainers write them. Returns its rows."""
    names = [name for name in NAMES if not name.startswith("f_rest_") or int(name[7:]) < n_rest]
    rows = np.zeros(len(positions), dtype=[(name, "<f4") for name in names])
    generator = np.random.default_rng(0)
    for name in names[6:]:
        rows[name] = generator.standard_normal(len(positions))
    for name, column in zip("xyz", positions.T, strict=True):
        rows[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(positions)}"]
    head += [f"property float {name}" for name in names] + ["end_header", ""]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
    return rows


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_turn_with_the_function(degree: int) -> None:
    generator = np.random.default_rng(1)
    n = (degree + 1) ** 2 - 1
    coefficients = generator.standard_normal((40, 3, n))
    turns = Rotation.from_rotvec(generator.standard_normal((40, 3))).as_matrix()
    directions = generator.standard_normal((25, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def seen(values: np.ndarray, at: np.ndarray) -> np.ndarray:
        basis = np.concatenate([evaluate_harmonics(at, d) for d in range(1, degree + 1)], -1)
        return np.asarray(np.einsum("p...j,pcj->pc...", np.broadcast_to(basis, (40, 25, n)), values))

    found = seen(rotate_harmonics(coefficients, turns), directions)
    np.testing.assert_allclose(found, seen(coefficients, directions @ turns), atol=1e-12)


def columns(path: Path) -> dict[str, np.ndarray]:
    return dict(zip(NAMES, PlyFile(path).columns(*NAMES).T, strict=True))


def test_a_splat_is_the_same_seen_from_a_body_that_turned(tmp_path: Path, bars: Shapes) -> None:
    rows = write_splats(tmp_path / "scene.ply", bars.keyframes[0].numpy()[:50])
    given = PointFile(tmp_path / "scene.ply")
    assert given.is_splats
    turn = Rotation.from_rotvec([0.3, -2.0, 1.0])
    many = np.broadcast_to(turn.as_matrix(), (50, 3, 3))
    (tmp_path / "moved.ply").write_bytes(given.move(given.positions @ turn.as_matrix().T, many, 2 * many))
    moved = columns(tmp_path / "moved.ply")

    def covariance(own: np.ndarray) -> np.ndarray:
        axes = Rotation.from_quat(np.stack([own[f"rot_{i}"] for i in (1, 2, 3, 0)], 1)).as_matrix()
        scaled = axes * np.exp(np.stack([own[f"scale_{i}"] for i in range(3)], 1))[:, None]
        return np.asarray(scaled @ scaled.transpose(0, 2, 1))

    expected = 4 * turn.as_matrix() @ covariance(rows) @ turn.as_matrix().T
    np.testing.assert_allclose(covariance(moved), expected, rtol=1e-4, atol=1e-4)
    quaternions = np.stack([moved[f"rot_{i}"] for i in range(4)], 1)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    for name in ("opacity", "f_dc_0", "f_dc_2"):
        assert np.array_equal(moved[name], rows[name])
    back = PointFile(tmp_path / "moved.ply").move(given.positions, many.transpose(0, 2, 1), 0.5 * many)
    (tmp_path / "back.ply").write_bytes(back)
    for name in NAMES[9:54]:
        np.testing.assert_allclose(columns(tmp_path / "back.ply")[name], rows[name], atol=1e-5)


def test_files_that_are_no_points(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text("no ply")
    with pytest.raises(ValueError, match="no PLY file of points"):
        PointFile(tmp_path / "a.ply")
    write_splats(tmp_path / "b.ply", np.zeros((3, 3)), n_rest=10)
    with pytest.raises(ValueError, match="have 0, 9, 24 or 45"):
        PointFile(tmp_path / "b.ply")


class TestCarry:
    @pytest.fixture
    def meshes(self, bars: Shapes, tmp_path: Path) -> list[str]:
        frames = bars.keyframes[:2].numpy()
        return [str(file) for file in save_mesh(frames, bars.faces.numpy(), tmp_path / "meshes", fmt="obj")]

    def test_splats_and_points_follow(
        self, meshes: list[str], bars: Shapes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        write_splats(tmp_path / "scene.ply", bars.keyframes[0].numpy())
        out = tmp_path / "out"
        command = ["carry", *meshes, "--points", str(tmp_path / "scene.ply"), "--out", str(out)]
        assert cli.main(command) == 0
        assert "164 splats" in capsys.readouterr().out
        before = (out / "scene-0001.ply").read_bytes()
        assert cli.main(command) == 1, "nothing is overwritten"
        assert (out / "scene-0001.ply").read_bytes() == before
        found = trimesh.load(out / "scene-0001.ply")
        np.testing.assert_allclose(found.vertices, bars.keyframes[1], atol=1e-5)
        scan = trimesh.PointCloud(bars.keyframes[0].numpy() * 1.01)
        (tmp_path / "scan.ply").write_bytes(scan.export(file_type="ply", encoding="ascii"))
        assert cli.main(["carry", *meshes, "--points", str(tmp_path / "scan.ply"), "--out", str(out)]) == 0
        assert len(trimesh.load(out / "scan-0000.ply").vertices) == 164

    def test_a_file_without_points(self, meshes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "scene.ply").write_text("nothing")
        out = ["--out", str(tmp_path / "out")]
        assert cli.main(["carry", *meshes, "--points", str(tmp_path / "scene.ply"), *out]) == 1
        assert "no PLY file of points" in capsys.readouterr().err
        assert cli.main(["carry", *meshes, "--points", "none.ply", *out]) == 1
        assert "none.ply: no such file" in capsys.readouterr().err
