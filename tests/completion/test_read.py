"""Observations as files hold them: what arrives, and what is refused with the file's name."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import torch_modal as tm
from torch_modal.completion.read import load_observations

BALL = trimesh.creation.icosphere(1)
HEADER = "time,vertex,x,y,z\n"


def write_cloud(path: Path, *columns: np.ndarray, binary: bool = False) -> Path:
    """A PLY file of points, with normals where these are given."""
    table = np.concatenate(columns, axis=1)
    names = ["x", "y", "z", "nx", "ny", "nz"][: table.shape[1]]
    kind = "binary_little_endian" if binary else "ascii"
    properties = "".join(f"property float {name}\n" for name in names)
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(table)}\n{properties}end_header\n"
    rows = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    path.write_bytes(head.encode() + (table.astype("<f4").tobytes() if binary else rows))
    return path


def write_table(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("binary", [False, True])
def test_clouds_arrive_with_their_normals_and_times(tmp_path: Path, binary: bool) -> None:
    points, normals = np.arange(12.0).reshape(4, 3), np.tile([[0.0, 0.0, 2.0]], (4, 1))
    files = [write_cloud(tmp_path / "a.ply", points, normals, binary=binary)]
    files.append(write_cloud(tmp_path / "B.PLY", points + 1, binary=binary))
    a, b = load_observations(files, 10, [0.5, 3], noise=0.1, view=torch.tensor([0.0, 0.0, 2.0]))
    assert (a.time, b.time) == (0.5, 3.0) and a.noise == b.noise == 0.1
    torch.testing.assert_close(a.points, torch.from_numpy(points))
    torch.testing.assert_close(b.points, torch.from_numpy(points + 1))
    assert a.normals is not None and a.normals[:, 2].eq(1).all() and b.normals is None
    assert b.view is not None and b.view.tolist() == [0, 0, 1]
    assert [one.time for one in load_observations(files, 10)] == [0, 1]


def test_missing_points_are_left_out_and_normals_that_are_zero_are_none(tmp_path: Path) -> None:
    """Depth cameras write NaN where they saw nothing; splats have normals of length zero."""
    points = np.arange(15.0).reshape(5, 3)
    points[1] = np.nan
    (found,) = load_observations([write_cloud(tmp_path / "a.ply", points, np.zeros((5, 3)))], 10)
    assert found.points[:, 0].tolist() == [0, 6, 9, 12] and found.normals is None


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".glb", ".stl", ".vtk"])
def test_meshes_are_clouds_of_their_vertices_with_outward_normals(tmp_path: Path, suffix: str) -> None:
    if suffix == ".vtk":
        pytest.importorskip("pyvista", reason="pyvista is not installed; it is part of the extra 'vtk'")
    stray = np.array([[9.0, 9.0, 9.0]])  # a vertex without a face is no point of the surface
    x = torch.from_numpy(
        np.concatenate([BALL.vertices, stray]) if suffix not in (".glb", ".stl") else np.asarray(BALL.vertices)
    )
    (path,) = tm.save_mesh(x, torch.tensor(np.asarray(BALL.faces)), tmp_path / f"ball{suffix}")
    (found,) = load_observations([path], 3)
    assert found.normals is not None and len(found.points) == len(BALL.vertices)
    torch.testing.assert_close(found.points.norm(dim=1), torch.ones(len(BALL.vertices)).double(), rtol=0, atol=1e-6)
    assert bool(((found.normals * found.points).sum(1) > 0.99).all())


def test_markers_come_by_time_and_lost_ones_are_left_out(tmp_path: Path) -> None:
    text = "\ufeffvertex, Z ,x,y,Time,name\n"
    text += '4,3,1,2,0.5,"knee"\n5.0,6,4,5,0.5,hip\n6,,,,0.5,\n7,9,7,8,0.5,\n\n'
    text += "4,1,nan,1,1,knee\n4,1,1,1,1\n5,1,1,1,1\n7,1,1,1,1\n,,,,,\n6\n"
    first, second = load_observations([write_table(tmp_path / "m.csv", text)], 8, noise=0.2, view=torch.ones(3))
    assert (first.time, second.time, first.noise, first.view) == (0.5, 1.0, 0.2, None)
    assert first.vertices is not None and first.vertices.tolist() == [4, 5, 7]
    assert first.points.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert second.vertices is not None and second.vertices.tolist() == [4, 5, 7]


def test_times_are_those_of_the_clouds_alone(tmp_path: Path) -> None:
    table = write_table(tmp_path / "m.csv", HEADER + "7,0,0,0,0\n7,1,1,0,0\n7,2,2,0,0\n")
    a, b = (write_cloud(tmp_path / name, np.eye(3)) for name in ("a.ply", "b.ply"))
    assert [one.time for one in load_observations([a, table, b], 3, [1, 4])] == [1, 7, 4]
    for times in ([1], [1, 7, 4]):
        with pytest.raises(ValueError, match=rf"{len(times)} times for 2 clouds .*a\.ply.*one for each"):
            load_observations([a, table, b], 3, times)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"m\.csv: the first line names the columns, time,vertex,x,y,z; got ''"),
        ("time;vertex;x;y;z\n", r"m\.csv: the first line .*; got 'time;vertex;x;y;z'"),
        ("0,1,0,0,0\n0,2,0,0,0\n", r"m\.csv: the first line"),
        (HEADER, r"m\.csv.*: 0 points; an observation needs 3 or more"),
        (HEADER + "0,1,,,\n", r"m\.csv.*: 0 points"),
        (HEADER + "5,1,0,0,0\n5,2,0,0,0\n5,3,,,\n", r"m\.csv, time 5: 2 points; an observation needs 3 or more"),
        (HEADER + "0,1,0,0,0\n0,8,0,0,0\n", r"m\.csv, line 3: vertex 8 at the time 0; vertices are 0 to 7"),
        (HEADER + "0,-1,0,0,0\n", r"line 2: vertex -1 "),
        (HEADER + "0,1.5,0,0,0\n", r"line 2: vertex 1\.5 "),
        (HEADER + ",1,0,0,0\n", r"line 2: vertex 1 at the time nan; .*times are finite"),
        (HEADER + "0,,0,0,0\n", r"line 2: vertex nan "),
        (HEADER + "0,knee,0,0,0\n", r"m\.csv, line 2: could not convert.*'knee'; leave coordinates of lost"),
    ],
)
def test_tables_that_cannot_be_used_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_observations([write_table(tmp_path / "m.csv", text)], 8)


def test_clouds_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    def refused(path: Path, message: str) -> None:
        with pytest.raises(ValueError, match=message):
            load_observations([path], 8)

    for binary in (False, True):
        refused(write_cloud(tmp_path / "none.ply", np.zeros((0, 3)), binary=binary), r"none\.ply: 0 points; an obser")
        refused(
            write_cloud(tmp_path / "two.ply", np.zeros((2, 3)), binary=binary), r"two\.ply: 2 points; .*leave it out"
        )
    refused(write_cloud(tmp_path / "nan.ply", np.full((9, 3), np.nan)), r"nan\.ply: 0 points")
    refused(write_cloud(tmp_path / "flat.ply", np.zeros((9, 2))), r"flat\.ply is no PLY file of points with x, y and z")
    refused(write_table(tmp_path / "a.xyz", "0 0 0\n"), r"a\.xyz: unknown extension '\.xyz'")
    refused(write_table(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"), r"a\.obj: no faces.*point cloud of 3")
    for name in ("missing.ply", "missing.csv", "missing.obj"):
        with pytest.raises(FileNotFoundError, match="missing"):
            load_observations([tmp_path / name], 8)
