"""A sequence as USD: one mesh whose points and normals change over time, with materials."""

import errno
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import IntArray
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.asset import CLAY, Asset
from torch_modal.io.files import write_files
from torch_modal.io.formats import Animation


def write_usd(animation: Animation, path: Path) -> None:
    """Write USD by ``usd-core``: one mesh with positions at the times of the frames, linear between them.

    A time code is one frame of the timing, and a unit is a metre, as in glTF. Polygons, texture coordinates, colours
    and materials come from the asset; textures lie beside the file. The suffix ``.usda`` is text, others are binary.

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
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
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
    single, upright = shapes.astype(np.float32), vertex_normals(shapes, faces)
    points, extent, normals = mesh.CreatePointsAttr(), mesh.CreateExtentAttr(), mesh.CreateNormalsAttr()
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    for code, number in zip(codes.tolist(), shown.tolist(), strict=True):
        at = Usd.TimeCode(code) if len(codes) > 1 else Usd.TimeCode.Default()
        place = Vt.Vec3fArray.FromNumpy(single[number])
        points.Set(place, at)
        normals.Set(Vt.Vec3fArray.FromNumpy(upright[number].astype(np.float32)), at)
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
    if asset is not None and "materials" in asset.carries:
        _write_materials(stage, mesh, asset, sizes, corners, path.with_name(animation.name))
    stage.GetRootLayer().Save()


def _write_materials(stage: Any, mesh: Any, asset: Asset, sizes: IntArray, corners: IntArray, path: Path) -> None:
    """A UsdPreviewSurface for each material, bound to its polygons; textures become files beside the stage's."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    parts = asset.parts()
    part_of = {frozenset(face): i for i, part in enumerate(parts) for face in part.vertices[part.triangles].tolist()}
    each = np.split(corners, np.cumsum(sizes)[:-1])
    # Whatever diagonals cut a polygon, one of its triangles has three neighbouring corners.
    found = [next((part_of[t] for t in _ears(polygon) if t in part_of), 0) for polygon in each]
    for i, (_, _, material, texcoords, *_) in enumerate(parts):
        made = UsdShade.Material.Define(stage, f"/sequence/materials/material_{i}")
        made.GetPrim().SetDisplayName(material.name)
        surface = UsdShade.Shader.Define(stage, made.GetPath().AppendChild("surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        color = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        color.Set(Gf.Vec3f(*map(float, material.color[:3])))
        for name, value in (
            ("metallic", material.metallic),
            ("roughness", material.roughness),
            ("opacity", material.color[3]),
        ):
            surface.CreateInput(name, Sdf.ValueTypeNames.Float).Set(float(value))
        if material.texture is not None and texcoords is not None:
            kind = "png" if material.texture.startswith(b"\x89PNG") else "jpg"
            # Named by its content: nothing else of the folder is replaced.
            picture = path.with_name(f"{path.stem}-{sha256(material.texture).hexdigest()[:8]}.{kind}")
            write_files([(picture, material.texture)])
            reader = UsdShade.Shader.Define(stage, made.GetPath().AppendChild("coordinates"))
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
            texture = UsdShade.Shader.Define(stage, made.GetPath().AppendChild("texture"))
            texture.CreateIdAttr("UsdUVTexture")
            texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{picture.name}")
            places = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
            texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(places)
            texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*map(float, material.color)))
            for axis in ("wrapS", "wrapT"):
                texture.CreateInput(axis, Sdf.ValueTypeNames.Token).Set("repeat")
            color.ConnectToSource(texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
        made.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        own = Vt.IntArray.FromNumpy(np.flatnonzero(np.array(found) == i).astype(np.int32))
        target = UsdGeom.Subset.CreateGeomSubset(mesh, f"material_{i}", "face", own, "materialBind")
        UsdShade.MaterialBindingAPI.Apply(target.GetPrim()).Bind(made)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())


def _ears(polygon: IntArray) -> list[frozenset[int]]:
    """Sets of three neighbouring corners of a polygon."""
    ring = polygon.tolist() * 2
    return [frozenset(ring[i : i + 3]) for i in range(len(polygon))]
