"""STL files: triangles without shared vertices."""

from pathlib import Path

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.io.asset import Asset


class StlAsset(Asset):
    """An STL file. Corners at equal positions become one vertex, in the order in which they come first.

    Files of one mesh have the same vertices then, unless two vertices of one of them coincide.
    """

    suffix = ".stl"

    def __init__(self, path: Path) -> None:
        import trimesh

        super().__init__(path)
        mesh = trimesh.load_mesh(path, process=False)
        corners = np.array(mesh.triangles, dtype=np.float64).reshape(-1, 3) + 0.0  # -0 is 0
        _, first, vertex = np.unique(corners, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        self.positions = corners[first[order]]
        self.faces = np.argsort(order)[vertex.reshape(-1)].reshape(-1, 3)

    def with_positions(self, positions: FloatArray) -> bytes:
        """The mesh with other positions."""
        return stl_bytes(positions, self.faces)


def stl_bytes(vertices: FloatArray, faces: IntArray, asset: Asset | None = None) -> bytes:
    """A binary STL file of vertices and faces, float32."""
    import trimesh
    from trimesh.exchange.stl import export_stl

    return export_stl(trimesh.Trimesh(vertices, faces, process=False))
