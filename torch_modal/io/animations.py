"""A sequence as positions over time: point caches (MDD, PC2, NPZ) for a mesh that exists already, and USD."""

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

    A time code is one frame of the timing. The suffix ``.usda`` is text, the others are binary.
    """
    from pxr import Gf, Usd, UsdGeom, Vt

    faces, timing = animation.faces, animation.timing
    times, shown = timing.knots()
    codes = times * timing.fps
    stage: Any = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(timing.fps)
    stage.SetFramesPerSecond(timing.fps)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(codes[-1]))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/sequence").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/sequence/mesh")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*CLAY[:3])])
    points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
    for code, number in zip(codes.tolist(), shown.tolist(), strict=True):
        at = Usd.TimeCode(code) if len(codes) > 1 else Usd.TimeCode.Default()
        place = Vt.Vec3fArray.FromNumpy(animation.shapes[number].astype(np.float32))
        points.Set(place, at)
        extent.Set(UsdGeom.PointBased.ComputeExtent(place), at)
    stage.GetRootLayer().Save()
