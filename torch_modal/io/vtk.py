"""Surfaces of VTK files, read and written by PyVista."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.extras import require
from torch_modal.io.asset import Asset, fans


class VtkAsset(Asset):
    """A VTK file: polygons, or the surface of a grid. Written again it has the arrays of its points and cells."""

    keeps = frozenset({"polygons", "properties"})

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        pyvista = require("pyvista", "vtk", path.name)
        mesh = pyvista.read(path)
        if isinstance(mesh, pyvista.UnstructuredGrid):
            mesh = mesh.extract_surface(pass_pointid=False, pass_cellid=False, algorithm=None)
        if not isinstance(mesh, pyvista.PolyData):
            raise MeshError(f"{path}: {type(mesh).__name__} is no surface; save polygons (PolyData)")
        if mesh.n_strips:
            mesh = mesh.triangulate()
        self.suffix = ".vtk" if path.suffix.lower() == ".vtk" else ".vtp"
        self._mesh = mesh
        self.positions = np.array(mesh.points, dtype=np.float64)
        polygons = mesh.irregular_faces
        corners = np.concatenate([np.zeros(0, np.int64), *polygons])
        # Not by VTK, which cuts along the shorter diagonal of each frame.
        self.faces = corners[fans(np.array([len(polygon) for polygon in polygons], dtype=np.int64))]
        self._note("polygons", "polygons", len(self.faces) > len(polygons))
        self._note("normals", "normals", mesh.point_data.active_normals is not None)
        arrays = [*mesh.point_data, *mesh.cell_data]
        self._note("properties", f"arrays {', '.join(arrays)}", arrays)

    def with_positions(self, positions: FloatArray) -> bytes:
        """The mesh with other positions, without normals."""
        mesh = self._mesh.copy()
        mesh.points = positions
        for data in (mesh.point_data, mesh.cell_data):
            if data.active_normals_name is not None:
                data.remove(data.active_normals_name)
        return _saved(mesh, self.suffix)


def vtp_bytes(vertices: FloatArray, faces: IntArray, asset: Asset | None = None) -> bytes:
    """A VTP file of vertices and faces, float64."""
    return _saved(require("pyvista", "vtk", "VTP").PolyData.from_regular_faces(vertices, faces), ".vtp")


def vtk_bytes(vertices: FloatArray, faces: IntArray, asset: Asset | None = None) -> bytes:
    """A legacy VTK file of vertices and faces, binary, float64."""
    return _saved(require("pyvista", "vtk", "VTK").PolyData.from_regular_faces(vertices, faces), ".vtk")


def _saved(mesh: Any, suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"mesh{suffix}")
        mesh.save(path)
        return path.read_bytes()
