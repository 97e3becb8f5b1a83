"""A sequence as USD: one mesh whose points change over time. Needs ``usd-core`` (``pip install torch_modal[usd]``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.asset import CLAY, Asset, FloatArray, IntArray, Polygons
from torch_modal.io.files import temporary_beside
from torch_modal.io.timing import Timing

HOLDS = ("polygons", "texcoords", "colors")


def save_usd(shapes: FloatArray, faces: IntArray, path: Path, timing: Timing, asset: Asset | None = None) -> Path:
    """Write positions at the times of the frames, between which USD interpolates linearly.

    Args:
        shapes: *Shape:* ``(N, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        path: The file, ``.usd``, ``.usdc`` (binary) or ``.usda`` (text), which is replaced.
        timing: How it is played; a time code is ``1 / fps`` seconds.
        asset: Gives polygons, texture coordinates and colours.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    if asset is not None:
        asset.say_lost(path, HOLDS)
    polygons = Polygons(np.full(len(faces), 3), faces.reshape(-1)) if asset is None else asset.polygons()
    times, shown = timing.knots(np.arange(len(shapes)), len(shapes))
    codes = times * timing.fps
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_beside(path, path.suffix.lower()) as temporary:
        stage: Any = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        stage.SetTimeCodesPerSecond(timing.fps)
        stage.SetFramesPerSecond(timing.fps)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(float(codes[-1]))
        root = UsdGeom.Xform.Define(stage, "/sequence")
        stage.SetDefaultPrim(root.GetPrim())
        mesh = UsdGeom.Mesh.Define(stage, "/sequence/mesh")
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(polygons.sizes.astype(np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(polygons.corners.astype(np.int32)))
        single = shapes.astype(np.float32)
        points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
        for code, number in zip(codes.tolist(), shown.tolist(), strict=True):
            at = Usd.TimeCode(code) if len(codes) > 1 else Usd.TimeCode.Default()
            points.Set(Vt.Vec3fArray.FromNumpy(single[number]), at)
            bounds = np.stack([single[number].min(axis=0), single[number].max(axis=0)])
            extent.Set(Vt.Vec3fArray.FromNumpy(bounds), at)
        primvars = UsdGeom.PrimvarsAPI(mesh)
        if polygons.texcoords is not None:
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            st = primvars.CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
            st.Set(Vt.Vec2fArray.FromNumpy(polygons.texcoords.astype(np.float32)))
        colors = _vertex_colors(asset, shapes.shape[1])
        shade = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant if colors is None else UsdGeom.Tokens.vertex)
        shade.Set([Gf.Vec3f(*CLAY[:3])] if colors is None else Vt.Vec3fArray.FromNumpy(colors))
        stage.GetRootLayer().Save()
    return path


def _vertex_colors(asset: Asset | None, n_vertices: int) -> Any:
    """Linear RGB, float32, or None. *Shape:* ``(V, 3)``."""
    if asset is None or "colors" not in asset.carries:
        return None
    colors = np.ones((n_vertices, 3), np.float32)
    for part in asset.parts():
        if part.colors is not None:
            colors[part.vertices] = part.colors[:, :3]
    return colors
