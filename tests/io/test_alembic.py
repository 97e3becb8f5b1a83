"""Alembic caches are written, and read with their transforms."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.data.samples import load_sample
from torch_modal.errors import MeshError

alembic3d = pytest.importorskip("alembic3d", reason="alembic3d is not installed; it is the extra 'alembic'")


def test_a_motion_comes_back(tmp_path: Path) -> None:
    x, faces, *_ = load_sample("creature")
    tm.save_animation(x, faces, tmp_path / "a.abc", fps=30)
    frames, triangles, fps = tm.load_sequence(tmp_path / "a.abc")
    torch.testing.assert_close(frames, x, rtol=0, atol=1e-6)
    assert torch.equal(triangles, faces) and fps == pytest.approx(30)
    main(["bake", str(tmp_path / "a.abc"), "--out", str(tmp_path / "a.glb"), "--bones", "4", "--quiet"])
    assert (tmp_path / "a.glb").stat().st_size > 1e4


def test_a_full_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    x, faces, *_ = load_sample("hand")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 10**5))
    with pytest.raises(OSError, match="too little space"):
        tm.save_animation(x, faces, tmp_path / "a.abc")
    assert not list(tmp_path.iterdir())


def test_polygons_and_texture_coordinates_are_written_clockwise(tmp_path: Path) -> None:
    from alembic3d import Abc, AbcGeom

    points = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "a.obj").write_text(f"{points}f 1/1 2/2 3/3 4/4\nf 2/1 5/2 3/3\n")
    asset = tm.open_asset(tmp_path / "a.obj")
    tm.save_animation(np.stack([asset.positions] * 3), asset.faces, tmp_path / "a.abc", asset=asset)
    schema = AbcGeom.IPolyMesh(Abc.IArchive(str(tmp_path / "a.abc")).getTop(), "mesh").getSchema()
    sample = schema.getValue(0)
    assert np.array(sample.getFaceCounts()).tolist() == [4, 3]
    assert np.array(sample.getFaceIndices()).tolist() == [3, 2, 1, 0, 2, 4, 1]
    uvs = schema.getUVsParam().getExpandedValue(Abc.ISampleSelector(0.0)).getVals()
    assert np.array(uvs).tolist() == [[0, 1], [1, 1], [1, 0], [0, 0], [1, 1], [1, 0], [0, 0]]


def test_moving_transforms_are_applied(tmp_path: Path) -> None:
    import imath
    from alembic3d import Abc, AbcCoreAbstract, AbcGeom

    archive = Abc.OArchive(str(tmp_path / "a.abc"))
    rate = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1 / 25, 0.0))
    node = AbcGeom.OXform(archive.getTop(), "node", rate)
    for number in range(3):
        sample = AbcGeom.XformSample()
        sample.setTranslation(imath.V3d(number, 0, 0))
        node.getSchema().set(sample)
    corners = imath.V3fArrayFromBuffer(np.eye(3, dtype=np.float32))
    indices, counts = (imath.IntArrayFromBuffer(np.array(each, np.int32)) for each in ([2, 1, 0], [3]))
    for name in ("one", "two"):
        AbcGeom.OPolyMesh(node, name).getSchema().set(AbcGeom.OPolyMeshSchemaSample(corners, indices, counts))
    del node, archive
    frames, faces, fps = tm.load_sequence(tmp_path / "a.abc")
    assert faces.tolist() == [[0, 1, 2], [3, 4, 5]] and fps == pytest.approx(25)
    moved = torch.eye(3).double() + torch.arange(3.0)[:, None, None].double() * torch.tensor([1.0, 0, 0])
    torch.testing.assert_close(frames, moved.repeat(1, 2, 1))


def test_files_that_hold_no_motion_are_refused(tmp_path: Path) -> None:
    import imath
    from alembic3d import Abc, AbcGeom

    (tmp_path / "junk.abc").write_text("hello")
    with pytest.raises(MeshError, match=r"junk\.abc: cannot be read as Alembic"):
        tm.load_sequence(tmp_path / "junk.abc")
    Abc.OArchive(str(tmp_path / "empty.abc"))
    with pytest.raises(MeshError, match="no polygon mesh"):
        tm.load_sequence(tmp_path / "empty.abc")
    archive = Abc.OArchive(str(tmp_path / "changing.abc"))
    schema = AbcGeom.OPolyMesh(archive.getTop(), "mesh").getSchema()
    for faces in ([0, 1, 2], [0, 2, 1, 0, 1, 2]):
        arrays = (imath.IntArrayFromBuffer(np.array(each, np.int32)) for each in (faces, [3] * (len(faces) // 3)))
        schema.set(AbcGeom.OPolyMeshSchemaSample(imath.V3fArrayFromBuffer(np.eye(3, dtype=np.float32)), *arrays))
    del schema, archive
    with pytest.raises(MeshError, match="connectivity of a mesh changes"):
        tm.load_sequence(tmp_path / "changing.abc")
