"""Blender extension: in-betweens of an object's shape keys, and any animation of a mesh as bones.

Zip this folder, install the file under Edit > Preferences > Get Extensions > Install from Disk, and name the program
``torch-modal`` in its preferences (of the environment that the package is installed in: Blender's own Python needs
nothing). With a mesh object selected, Object > In-Between Shape Keys adds shapes between its shape keys, as keys of
their own that are animated one after the other. The given keys are muted, and else stay as they are. Object > Bake to
Bones adds an armature with a skinned mesh that moves as the object does in the frames of the scene, whatever moves it:
shape keys, a cache, cloth or other modifiers.
"""

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

PREFIX = "between "

Point = tuple[float, float, float]


def write_mesh(path: Path, points: Sequence[Point], triangles: Sequence[tuple[int, int, int]]) -> None:
    """An OBJ file whose numbers read back the same."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]
    path.write_text("\n".join(lines) + "\n")


def read_points(path: Path) -> list[Point]:
    """The vertices of an OBJ file."""
    rows = (line.split() for line in path.read_text().splitlines() if line.startswith("v "))
    return [(float(x), float(y), float(z)) for _, x, y, z, *_ in rows]


def run_program(program: str, *arguments: str) -> None:
    """Run a command of torch-modal.

    Raises:
        RuntimeError: The program is not there, or says why not.
    """
    try:
        done = subprocess.run([program, *arguments, "--quiet"], capture_output=True, text=True, check=False)
    except OSError as error:
        raise RuntimeError(f"{program} does not start ({error}); name it in the add-on's preferences") from error
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "it gave no reason")


def in_betweens(
    program: str,
    shapes: Sequence[Sequence[Point]],
    triangles: Sequence[tuple[int, int, int]],
    levels: int,
    cyclic: bool = False,
    contact: bool = False,
) -> list[list[Point]]:
    """All frames, the given shapes among them, by the command line. Raises as :func:`run_program`."""
    with tempfile.TemporaryDirectory(prefix="torch_modal-") as name:
        folder = Path(name)
        files = [folder / f"key-{i:03d}.obj" for i in range(len(shapes))]
        for file, points in zip(files, shapes, strict=True):
            write_mesh(file, points, triangles)
        options = ["--levels", str(levels), *["--cyclic"] * cyclic, *["--contact"] * contact]
        run_program(program, "interpolate", *map(str, files), *options, "--out", str(folder / "out"))
        return [read_points(file) for file in sorted((folder / "out").glob("frame-*.obj"))]


def dress(baked: Any, surface: Any) -> None:
    """Give a skinned object the polygons, materials and texture coordinates of a mesh of the same vertices."""
    skinned = baked.data
    if len(skinned.vertices) != len(surface.vertices):
        return  # vertices that no polygon has are not in the file
    surface.name = skinned.name
    for target, source in zip(surface.vertices, skinned.vertices, strict=True):
        target.co = source.co
    weights = [[(each.group, each.weight) for each in vertex.groups] for vertex in skinned.vertices]
    names = [group.name for group in baked.vertex_groups]  # the mesh has them
    baked.data = surface
    baked.vertex_groups.clear()
    for name in names:
        baked.vertex_groups.new(name=name)
    for number, groups in enumerate(weights):
        for group, weight in groups:
            baked.vertex_groups[group].add([number], weight, "REPLACE")
    bpy.data.meshes.remove(skinned)


class Preferences(bpy.types.AddonPreferences):  # type: ignore[misc]
    """Where the program is."""

    bl_idname = __name__

    program: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="torch-modal", default="torch-modal", subtype="FILE_PATH"
    )

    def draw(self, context: Any) -> None:
        """One field."""
        self.layout.prop(self, "program")


class InBetweenKeys(bpy.types.Operator):  # type: ignore[misc]
    """Add shapes between the shape keys of the active object, and animate them."""

    bl_idname = "object.in_between_shape_keys"
    bl_label = "In-Between Shape Keys"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 (Blender reads it so)

    levels: bpy.props.IntProperty(name="Levels", default=3, min=1, max=6)  # type: ignore[valid-type]
    step: bpy.props.IntProperty(name="Frames per Shape", default=2, min=1)  # type: ignore[valid-type]
    cyclic: bpy.props.BoolProperty(name="Cyclic", default=False)  # type: ignore[valid-type]
    contact: bpy.props.BoolProperty(name="Contact", default=False)  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: Any) -> bool:
        """A mesh with two shape keys or more."""
        own = context.active_object
        return own is not None and own.type == "MESH" and own.data.shape_keys is not None

    def execute(self, context: Any) -> set[str]:
        """Compute, add, animate."""
        own = context.active_object
        keys = [key for key in own.data.shape_keys.key_blocks if not key.name.startswith(PREFIX)]
        if len(keys) < 2:
            self.report({"ERROR"}, "two shape keys or more are needed")
            return {"CANCELLED"}
        own.data.calc_loop_triangles()
        triangles = [tuple(part.vertices) for part in own.data.loop_triangles]
        shapes = [[tuple(point.co) for point in key.data] for key in keys]
        program = context.preferences.addons[__name__].preferences.program
        try:
            frames = in_betweens(program, shapes, triangles, self.levels, self.cyclic, self.contact)
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for key in [key for key in own.data.shape_keys.key_blocks if key.name.startswith(PREFIX)]:
            own.shape_key_remove(key)
        # Values of other keys would be added to those below: muted, they stay as they are.
        for key in keys[1:]:
            key.mute = True
        start = context.scene.frame_current
        for i, points in enumerate(frames):
            key = own.shape_key_add(name=f"{PREFIX}{i:04d}", from_mix=False)
            for target, point in zip(key.data, points, strict=True):
                target.co = point
            # Each fades into the next: the sum of both values is one.
            for value, offset in ((0.0, -1), (1.0, 0), (0.0, 1)):
                key.value = value
                key.keyframe_insert("value", frame=start + (i + offset) * self.step)
        context.scene.frame_end = max(context.scene.frame_end, start + (len(frames) - 1) * self.step)
        self.report({"INFO"}, f"{len(frames)} shapes between {len(keys)} shape keys, which are muted now")
        return {"FINISHED"}


class BakeToBones(bpy.types.Operator):  # type: ignore[misc]
    """Add an armature and a skinned mesh that move as the active object does in the frames of the scene."""

    bl_idname = "object.bake_to_bones"
    bl_label = "Bake to Bones"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 (Blender reads it so)

    bones: bpy.props.IntProperty(name="Bones", default=40, min=1)  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: Any) -> bool:
        """A mesh."""
        return context.active_object is not None and context.active_object.type == "MESH"

    def execute(self, context: Any) -> set[str]:
        """Write each frame, fit bones, import them."""
        own, scene, before = context.active_object, context.scene, context.scene.frame_current
        program = context.preferences.addons[__name__].preferences.program
        surface: Any = None
        triangles: list[tuple[int, int, int]] = []
        with tempfile.TemporaryDirectory(prefix="torch_modal-") as name:
            for frame in range(scene.frame_start, scene.frame_end + 1):
                scene.frame_set(frame)
                posed = own.evaluated_get(context.evaluated_depsgraph_get())
                mesh = posed.to_mesh()
                if surface is None:  # quads that deform would be cut along other diagonals in other frames
                    mesh.calc_loop_triangles()
                    triangles = [(*part.vertices,) for part in mesh.loop_triangles]
                    depsgraph = context.evaluated_depsgraph_get()
                    surface = bpy.data.meshes.new_from_object(posed, preserve_all_data_layers=True, depsgraph=depsgraph)
                if len(mesh.vertices) != len(surface.vertices):
                    self.report({"ERROR"}, f"frame {frame} has {len(mesh.vertices)} vertices, the first has others")
                    scene.frame_set(before)
                    return {"CANCELLED"}
                places = [posed.matrix_world @ vertex.co for vertex in mesh.vertices]
                points = [(x, z, -y) for x, y, z in places]  # glTF's Y is up
                write_mesh(Path(name, f"frame-{frame:06d}.obj"), points, triangles)
                posed.to_mesh_clear()
            scene.frame_set(before)
            rate, out = (
                scene.render.fps / scene.render.fps_base,
                Path(name, f"{bpy.path.clean_name(own.name)}-baked.glb"),
            )
            try:
                run_program(program, "bake", name, "--bones", str(self.bones), "--fps", str(rate), "--out", str(out))
            except RuntimeError as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
            bpy.ops.import_scene.gltf(filepath=str(out), disable_bone_shape=True)
        for baked in [each for each in context.selected_objects if each.type == "MESH"]:
            dress(baked, surface)
        for moved in [each for each in context.selected_objects if each.animation_data and each.animation_data.action]:
            data = moved.animation_data  # its keys begin at 0: a strip puts them where the frames were
            data.nla_tracks.new().strips.new("baked", scene.frame_start, data.action)
            data.action = None
        return {"FINISHED"}


def menu(self: Any, context: Any) -> None:
    """The entries of the menu."""
    self.layout.operator(InBetweenKeys.bl_idname)
    self.layout.operator(BakeToBones.bl_idname)


def register() -> None:
    """What Blender calls when the add-on is turned on."""
    bpy.utils.register_class(Preferences)
    bpy.utils.register_class(InBetweenKeys)
    bpy.utils.register_class(BakeToBones)
    bpy.types.VIEW3D_MT_object.append(menu)


def unregister() -> None:
    """And when it is turned off."""
    bpy.types.VIEW3D_MT_object.remove(menu)
    bpy.utils.unregister_class(BakeToBones)
    bpy.utils.unregister_class(InBetweenKeys)
    bpy.utils.unregister_class(Preferences)
