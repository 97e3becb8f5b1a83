"""A sequence as USD: one mesh whose points change over time. Needs ``usd-core`` (``pip install torch_modal[usd]``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.asset import CLAY, Asset, Polygons
from torch_modal.io.formats import Animation, animation_format

HOLDS = ("polygons", "texcoords", "colors")


@animation_format(".usd", ".usda", ".usdc", modules=("pxr",), extra="usd")
def write_usd(animation: Animation, path: Path) -> None:
    """Positions at the times of the frames; USD interpolates linearly between them.

    A time code is one frame of the timing. Polygons, texture coordinates and colours come from the asset. The suffix
    ``.usda`` is text, the others are binary.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    shapes, faces, timing, name, _, asset, *_ = animation
    if asset is not None:
        asset.warn_lost(name, HOLDS)
    polygons = Polygons(np.full(len(faces), 3), faces.reshape(-1)) if asset is None else asset.polygons()
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


def _vertex_colors(asset: Asset | None, n_vertices: int) -> Any:
    """Linear RGB, float32, or None. *Shape:* ``(V, 3)``."""
    if asset is None or "colors" not in asset.carries:
        return None
    colors = np.ones((n_vertices, 3), np.float32)
    for part in asset.parts():
        if part.colors is not None:
            colors[part.vertices] = part.colors[:, :3]
    return colors
