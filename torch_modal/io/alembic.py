"""Alembic caches: a motion of one connectivity, read and written by ``alembic3d``."""

import errno
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.extras import require
from torch_modal.io.asset import fans
from torch_modal.io.formats import Animation, resample

SPACE = 2**20  # bytes of a cache besides its arrays, at most


def write_alembic(animation: Animation, path: Path) -> None:
    """Write one mesh with float32 positions at the timing's rate; polygons and texture coordinates of the asset.

    Raises:
        OSError: There is too little space.
    """
    import imath
    from alembic3d import Abc, AbcCoreAbstract, AbcGeom

    frames = resample(animation.shapes, animation.timing.samples()).astype(np.float32)
    triangles = np.full(len(animation.faces), 3), animation.faces.reshape(-1), None
    sizes, corners, texcoords = triangles if animation.asset is None else animation.asset.polygons()
    turned = _turned(sizes)
    # alembic3d ends the process when it cannot write.
    if shutil.disk_usage(path.parent).free < frames.nbytes + 16 * corners.nbytes + SPACE:
        raise OSError(errno.ENOSPC, "too little space for an Alembic cache", str(path))
    archive = Abc.OArchive(str(path))
    rate = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1 / animation.timing.fps, 0.0))
    schema = AbcGeom.OPolyMesh(archive.getTop(), "mesh", rate).getSchema()
    faces = [imath.IntArrayFromBuffer(each.astype(np.int32)) for each in (corners[turned], sizes)]
    if texcoords is not None:
        uvs = imath.V2fArrayFromBuffer(texcoords[turned].astype(np.float32))
        faces.append(AbcGeom.OV2fGeomParamSample(uvs, AbcGeom.GeometryScope.kFacevaryingScope))
    for frame in frames:
        schema.set(AbcGeom.OPolyMeshSchemaSample(imath.V3fArrayFromBuffer(frame), *faces))
        faces = []  # as in the first sample


def read_alembic(path: Path) -> tuple[FloatArray, IntArray, dict[str, Any]]:
    """Samples ``(N, V, 3)`` of all meshes of a cache, with their transforms, faces ``(F, 3)``, and the rate.

    Raises:
        MeshError: There is no mesh, or one whose connectivity changes.
        MissingPackageError: ``alembic3d`` is not installed.
    """
    require("alembic3d", "alembic", path.name)
    from alembic3d import Abc, AbcGeom

    archive = Abc.IArchive(str(path))
    meshes = list(_meshes(archive.getTop(), ()))
    if not meshes:
        raise MeshError(f"{path}: no polygon mesh in this cache")
    if any(mesh.getTopologyVariance() == AbcGeom.MeshTopologyVariance.kHeterogenousTopology for mesh, _ in meshes):
        raise MeshError(f"{path}: the connectivity of a mesh changes; a motion has the same faces at all times")
    schemas = (each for mesh, transforms in meshes for each in (mesh, *transforms))
    longest = max(schemas, key=lambda schema: schema.getNumSamples())
    times = [longest.getTimeSampling().getSampleTime(i) for i in range(max(longest.getNumSamples(), 1))]
    frames: list[FloatArray] = []
    polygons: list[tuple[IntArray, IntArray]] = []
    for mesh, transforms in meshes:
        sample, first = mesh.getValue(0), sum(each.shape[1] for each in frames)
        sizes, corners = np.array(sample.getFaceCounts()), np.array(sample.getFaceIndices())
        polygons.append((sizes, corners[_turned(sizes)] + first))
        frames.append(np.array([_positions(mesh, transforms, Abc.ISampleSelector(time)) for time in times]))
    options = {"fps": (len(times) - 1) / (times[-1] - times[0])} if times[-1] > times[0] else {}
    sizes, corners = map(np.concatenate, zip(*polygons, strict=True))
    return np.concatenate(frames, 1), corners[fans(sizes)], options


def _meshes(parent: Any, transforms: tuple[Any, ...]) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Schemas of the polygon meshes below an object, and of the transforms above each, from the nearest on."""
    from alembic3d import AbcGeom

    for child in (parent.getChild(i) for i in range(parent.getNumChildren())):
        if AbcGeom.IPolyMesh.matches(child.getMetaData()):
            yield AbcGeom.IPolyMesh(parent, child.getName()).getSchema(), transforms
        elif AbcGeom.IXform.matches(child.getMetaData()):
            yield from _meshes(child, (AbcGeom.IXform(parent, child.getName()).getSchema(), *transforms))
        else:
            yield from _meshes(child, transforms)


def _positions(mesh: Any, transforms: tuple[Any, ...], when: Any) -> FloatArray:
    """Transformed positions at a time. *Shape:* ``(V, 3)``."""
    x = np.array(mesh.getPositionsProperty().getValue(when), dtype=np.float64)
    for transform in transforms:
        matrix = transform.getValue(when).getMatrix()
        rows = np.array([[matrix[i][j] for j in range(3)] for i in range(4)])
        x = x @ rows[:3] + rows[3]
    return x


def _turned(sizes: IntArray) -> IntArray:
    """Order of corners with each polygon reversed: Alembic's faces are clockwise."""
    last = np.cumsum(sizes) - 1
    first = last - sizes + 1
    return np.repeat(first + last, sizes) - np.arange(sizes.sum())
