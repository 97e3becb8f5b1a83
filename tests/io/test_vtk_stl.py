"""STL and VTK files as key-frames: one connectivity, and clear refusals where there is none."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.errors import MeshError, MeshWarning
from torch_modal.io.read import open_asset

BOX = np.array([[x, y, z] for x in (0, 1.0) for y in (0, 1.0) for z in (0, 1.0)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def test_stl_frames_of_one_mesh_have_the_same_vertices(tmp_path: Path) -> None:
    """Real key-frames, in binary and as text, written by us and by trimesh."""
    x, faces, *_ = load_sample("creature")
    paths = tm.save_mesh(x[:2], faces, tmp_path, "stl")
    text = trimesh.exchange.stl.export_stl_ascii(trimesh.Trimesh(x[2].numpy(), faces.numpy(), process=False))
    (tmp_path / "text.stl").write_text(text)
    found, triangles = tm.load_keyframes([*paths, tmp_path / "text.stl"])
    assert found.shape == x[:3].shape
    torch.testing.assert_close(found[:, triangles], x[:3][:, faces], rtol=0, atol=1e-6)
    assert tm.subdivide(found, triangles, 1, progress=False).isfinite().all()
    asset = open_asset(paths[0])
    (again,) = tm.save_mesh(found[1], triangles, tmp_path / "again.stl", asset=asset)
    assert again.read_bytes() == paths[1].read_bytes()


def test_stl_frames_whose_vertices_coincide_are_refused(tmp_path: Path) -> None:
    x, faces, *_ = load_sample("hand")
    touching = x.clone()
    touching[1, 100] = touching[1, 1800]
    paths = tm.save_mesh(touching, faces, tmp_path, "stl")
    with pytest.raises(MeshError, match=r"3781 vertices.*3782.*equal corners are merged: export OBJ or PLY"):
        tm.load_keyframes(paths)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    tm.save_mesh(x[1], faces[order], paths[1])
    with pytest.raises(MeshError, match="equal corners are merged"):
        tm.load_keyframes(paths)


@pytest.mark.parametrize("suffix", ["vtk", "vtp", "vtu"])
def test_vtk_surfaces_keep_polygons_and_arrays(suffix: str, tmp_path: Path) -> None:
    """The second frame is sheared, so that the shorter diagonals are the others."""
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed; it is part of the extra 'vtk'")
    frames = [BOX, BOX + BOX[:, [1, 2, 0]] * (0.4, -0.4, 0.4)]
    for number, points in enumerate(frames):
        mesh = pyvista.PolyData.from_regular_faces(points, QUADS).compute_normals(
            cell_normals=False, split_vertices=False
        )
        mesh["label"] = np.arange(8)
        mesh = mesh if suffix != "vtu" else mesh.cast_to_unstructured_grid()
        mesh.save(tmp_path / f"{number}.{suffix}")
    paths = [tmp_path / f"{number}.{suffix}" for number in range(2)]
    x, faces = tm.load_keyframes(paths)
    assert x.shape == (2, 8, 3) and faces.shape == (12, 3)
    assert trimesh.Trimesh(x[0].numpy(), faces.numpy(), process=False).volume == pytest.approx(1)
    asset = open_asset(paths[0])
    with pytest.warns(MeshWarning, match="without the normals"):
        (path,) = tm.save_mesh(x[1], faces, tmp_path / f"out{asset.suffix}", asset=asset)
    again = pyvista.read(path)
    assert again.n_cells == 6 and "Normals" not in again.point_data
    np.testing.assert_allclose(again.points, x[1], rtol=0, atol=1e-6)
    assert sorted(again["label"]) == list(range(8)) and again.points[again["label"] == 5] == pytest.approx(
        frames[1][5:6]
    )


def test_vtk_files_without_a_surface_are_refused(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="pyvista is not installed; it is part of the extra 'vtk'")
    pyvista.ImageData(dimensions=(3, 3, 3)).save(tmp_path / "image.vtk")
    with pytest.raises(MeshError, match="ImageData is no surface; save polygons"):
        open_asset(tmp_path / "image.vtk")
    pyvista.PolyData(BOX).save(tmp_path / "cloud.vtp")
    with pytest.raises(MeshError, match="point cloud of 8 vertices"):
        open_asset(tmp_path / "cloud.vtp")
    (tmp_path / "junk.vtp").write_text("hello")
    with pytest.raises(MeshError):
        open_asset(tmp_path / "junk.vtp")
