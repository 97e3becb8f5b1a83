"""A sequence as positions over time: point caches (MDD, PC2, NPZ) for a mesh that exists already, and USD."""

import errno
import struct
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.asset import CLAY
from torch_modal.io.formats import Animation, resample


def write_point_cache(animation: Animation, path: Path) -> None:
    """Write float32 positions at the timing's rate, as LightWave's cache (MDD) or 3ds Max's (PC2, version 1).

    MDD is big-endian and has times in seconds; PC2 is little-endian, one sample a frame from frame 0 on.
    """
    sampled = resample(animation.shapes, animation.timing.samples())
    n, n_vertices = sampled.shape[:2]
    if path.suffix.lower() == ".mdd":
        order = ">"
        head = struct.pack(">2i", n, n_vertices) + (np.arange(n) / animation.timing.fps).astype(">f4").tobytes()
    else:
        order = "<"
        head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, n_vertices, 0.0, 1.0, n)
    path.write_bytes(head + sampled.astype(f"{order}f4").tobytes())


def write_npz(animation: Animation, path: Path) -> None:
    """Write arrays ``frames`` (N, V, 3), ``faces`` (F, 3), ``times`` (N,) in seconds, and ``keyframes``."""
    shapes, keyframes = animation.shapes, np.asarray(animation.keyframes, np.int64)
    times = animation.timing.knots()[0][: len(shapes)]
    np.savez_compressed(path, frames=shapes, faces=animation.faces, times=times, keyframes=keyframes)


def write_usd(animation: Animation, path: Path) -> None:
    """Write USD by ``usd-core``: one mesh with positions at the times of the frames, linear between them.

    A time code is one frame of the timing. Polygons, texture coordinates and colours come from the asset. The suffix
    ``.usda`` is text, the others are binary.

    Raises:
        OSError: The file cannot be written.
    """
    from pxr import Tf

    try:
        _write_stage(animation, path)
    except Tf.ErrorException as error:  # "Error in ... : 'reason'", line by line
        reason = str(error).partition(" : '")[2].partition("'")[0]
        raise OSError(errno.EIO, f"usd-core: {reason}", str(path)) from None


def _write_stage(animation: Animation, path: Path) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    shapes, faces, timing, asset = animation.shapes, animation.faces, animation.timing, animation.asset
    triangles = np.full(len(faces), 3), faces.reshape(-1), None
    sizes, corners, texcoords = triangles if asset is None else asset.polygons()
    times, shown = timing.knots()
    codes = times * timing.fps
    stage: Any = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(timing.fps)
    stage.SetFramesPerSecond(timing.fps)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(codes[-1]))
    root = UsdGeom.Xform.Define(stage, "/sequence")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/sequence/mesh")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(sizes.astype(np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners.astype(np.int32)))
    single = shapes.astype(np.float32)
    points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
    for code, number in zip(codes.tolist(), shown.tolist(), strict=True):
        at = Usd.TimeCode(code) if len(codes) > 1 else Usd.TimeCode.Default()
        place = Vt.Vec3fArray.FromNumpy(single[number])
        points.Set(place, at)
        extent.Set(UsdGeom.PointBased.ComputeExtent(place), at)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    if texcoords is not None:
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(texcoords.astype(np.float32)))
    colors = None
    if asset is not None and "colors" in asset.carries:
        colors = np.ones((shapes.shape[1], 3), np.float32)
        for surface in asset.parts():
            if surface.colors is not None:
                colors[surface.vertices] = surface.colors[:, :3]
    shade = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant if colors is None else UsdGeom.Tokens.vertex)
    shade.Set([Gf.Vec3f(*CLAY[:3])] if colors is None else Vt.Vec3fArray.FromNumpy(colors))
    stage.GetRootLayer().Save()
