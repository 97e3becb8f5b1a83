"""The extension for Blender: against a fake of the calls that it makes, and in Blender where bpy is installed."""

import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from conftest import Shapes
from test_examples import load_example

import torch_modal as tm

EXTENSION = Path(__file__).parents[2] / "examples" / "blender" / "in_between_keys"
PROGRAM = str(Path(sys.executable).with_name("torch-modal"))


class Body:
    """A mesh object with shape keys."""

    type = "MESH"

    def __init__(self, shapes: Shapes) -> None:
        self.keys: list[Any] = []
        for name, x in zip("abc", shapes.keyframes, strict=False):
            self.shape_key_add(name, False, x.tolist())
        triangles = [SimpleNamespace(vertices=tuple(face)) for face in shapes.faces.tolist()]
        blocks = SimpleNamespace(key_blocks=self.keys)
        self.data = SimpleNamespace(shape_keys=blocks, loop_triangles=triangles, calc_loop_triangles=lambda: None)
        self.shape_key_remove = self.keys.remove

    def shape_key_add(self, name: str, from_mix: bool, points: Any = ()) -> Any:
        data = [SimpleNamespace(co=point) for point in points or [point.co for point in self.keys[0].data]]
        key = SimpleNamespace(name=name, data=data, value=0.0, mute=False, inserted=[])
        key.keyframe_insert = lambda path, frame: key.inserted.append((path, frame, key.value))
        self.keys.append(key)
        return key


@pytest.fixture
def addon(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    fake = MagicMock()
    fake.types.AddonPreferences = type("AddonPreferences", (), {})
    fake.types.Operator = type("Operator", (), {"report": lambda self, kind, text: self.said.append((kind, text))})
    monkeypatch.setitem(sys.modules, "bpy", fake)
    module = load_example("blender/in_between_keys/__init__")
    module.register()
    module.unregister()
    utils, menu = fake.utils, fake.types.VIEW3D_MT_object
    assert utils.register_class.call_count == utils.unregister_class.call_count == 3
    assert menu.append.call_args_list == menu.remove.call_args_list and menu.append.call_count == 1
    return module


def run(addon: ModuleType, body: Body, program: str = PROGRAM) -> tuple[set[str], Any]:
    operator = addon.InBetweenKeys()
    operator.levels, operator.step, operator.cyclic, operator.contact, operator.said = 1, 2, False, False, []
    preferences = {addon.__name__: SimpleNamespace(preferences=SimpleNamespace(program=program))}
    context = SimpleNamespace(
        active_object=body,
        preferences=SimpleNamespace(addons=preferences),
        scene=SimpleNamespace(frame_current=10, frame_end=17),
    )
    assert addon.InBetweenKeys.poll(context)
    ended = operator.execute(context)
    assert context.scene.frame_end == (18 if ended == {"FINISHED"} else 17)
    return ended, operator.said


def test_shapes_are_added_and_animated(addon: ModuleType, bars: Shapes) -> None:
    body = Body(bars)
    for _ in range(2):  # a second run replaces those of the first
        assert run(addon, body)[0] == {"FINISHED"}
        own = body.keys[3:]
        assert [key.name for key in own] == [f"between {i:04d}" for i in range(5)]
    points = torch.tensor([[point.co for point in key.data] for key in own], dtype=torch.float64)
    torch.testing.assert_close(points[::2], bars.keyframes, rtol=1e-8, atol=1e-12)  # nine digits
    straight = 0.5 * (bars.keyframes[0] + bars.keyframes[1])
    assert 1e-3 < float((points[1] - straight).abs().max()) < 1
    assert own[2].inserted == [("value", 12, 0.0), ("value", 14, 1.0), ("value", 16, 0.0)]
    assert [key.mute for key in body.keys] == [False, True, True, *[False] * 5]


def test_what_is_wrong_is_reported(addon: ModuleType, bars: Shapes) -> None:
    ended, said = run(addon, Body(bars), "no-such-program")
    assert ended == {"CANCELLED"} and "name it in the add-on's preferences" in said[0][1]
    body = Body(bars)
    body.keys[1].data = body.keys[1].data[:-4]
    ended, said = run(addon, body)
    assert ended == {"CANCELLED"} and said[0][0] == {"ERROR"} and said[0][1]
    body.keys[1:] = []
    assert run(addon, body)[1] == [({"ERROR"}, "two shape keys or more are needed")]


def test_the_manifest_names_what_blender_asks_for() -> None:
    text = (EXTENSION / "blender_manifest.toml").read_text()
    found = dict(re.findall(r'^(\w+) = "(.*)"$', text, re.M))
    wanted = {"schema_version", "id", "version", "name", "tagline", "maintainer", "type", "blender_version_min"}
    assert wanted <= set(found) and found["id"] == EXTENSION.name and found["type"] == "add-on"
    assert len(found["tagline"]) <= 64 and not found["tagline"].endswith(".")
    assert len(found["files"]) <= 64 and not found["files"].endswith(".")


# ------------------------------------------------------------------------------------------------------- in Blender
@pytest.fixture
def blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Blender with the extension, and a program that runs this package."""
    bpy = pytest.importorskip("bpy", reason="bpy is not installed")
    monkeypatch.syspath_prepend(str(EXTENSION.parent))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    import addon_utils

    addon_utils.enable(EXTENSION.name, default_set=True)
    program = tmp_path / "torch-modal"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m torch_modal "$@"\n')
    program.chmod(0o755)
    bpy.context.preferences.addons[EXTENSION.name].preferences.program = str(program)
    yield bpy
    addon_utils.disable(EXTENSION.name, default_set=True)


def body_in(blender: Any, shapes: Shapes) -> Any:
    """An active object with shape keys, turned and moved."""
    mesh = blender.data.meshes.new("bars")
    mesh.from_pydata(shapes.keyframes[0].tolist(), [], shapes.faces.tolist())
    own = blender.data.objects.new("bars", mesh)
    own.location, own.rotation_euler = (1, 2, 3), (0.1, 0.2, 0.3)
    blender.context.collection.objects.link(own)
    blender.context.view_layer.objects.active = own
    for number, x in enumerate(shapes.keyframes[:2].tolist()):
        key = own.shape_key_add(name=f"key {number}", from_mix=False)
        for target, point in zip(key.data, x, strict=True):
            target.co = point
    return own


def posed(blender: Any, own: Any) -> torch.Tensor:
    """The vertices of an object in the world, at the frame of the scene."""
    evaluated = own.evaluated_get(blender.context.evaluated_depsgraph_get())
    return torch.tensor([list(evaluated.matrix_world @ vertex.co) for vertex in evaluated.data.vertices])


def test_shape_keys_and_bones_in_blender(blender: Any, bars: Shapes) -> None:
    own, scene = body_in(blender, bars), blender.context.scene
    scene.frame_start, scene.frame_end = 1, 3
    scene.frame_set(1)
    assert blender.ops.object.in_between_shape_keys(levels=2, step=2) == {"FINISHED"}
    assert len(own.data.shape_keys.key_blocks) == 2 + 5 and scene.frame_end == 9
    assert blender.ops.object.bake_to_bones(bones=12) == {"FINISHED"}
    baked = next(each for each in blender.data.objects if each.type == "MESH" and each.find_armature())
    assert len(baked.find_armature().data.bones) > 2
    for frame in range(1, 10):
        scene.frame_set(frame)
        expected, found = posed(blender, own), posed(blender, baked)
        diagonal = (expected.amax(0) - expected.amin(0)).norm()
        assert (expected - found).norm(dim=1).max() < 0.004 * diagonal


def test_quads_that_deform_keep_polygons_materials_and_coordinates(blender: Any) -> None:
    """A grid of quads under a wave: the diagonal of a quad that bends is another one in other frames."""
    blender.ops.mesh.primitive_grid_add(x_subdivisions=12, y_subdivisions=8, size=2)
    own, scene = blender.context.active_object, blender.context.scene
    for color in ("red", "blue"):
        own.data.materials.append(blender.data.materials.new(color))
    for polygon in own.data.polygons:
        polygon.material_index = polygon.index % 2
    own.shape_key_add(name="flat", from_mix=False)
    bent = own.shape_key_add(name="bent", from_mix=False)
    for point in bent.data:
        x, y, _ = point.co
        point.co = (x, y, 0.4 * x * y + 0.2 * x * x)
    scene.frame_start, scene.frame_end = 1, 5
    for frame, value in ((1, 0.0), (3, 1.0), (5, -1.0)):
        bent.slider_min, bent.value = -1.0, value
        bent.keyframe_insert("value", frame=frame)
    there = set(blender.data.objects)
    assert blender.ops.object.bake_to_bones(bones=8) == {"FINISHED"}
    added = set(blender.data.objects) - there
    assert sorted(each.type for each in added) == ["ARMATURE", "MESH"]  # and no Icosphere
    baked = next(each for each in added if each.type == "MESH")
    assert [p.vertices[:] for p in baked.data.polygons] == [p.vertices[:] for p in own.data.polygons]
    assert [m.name for m in baked.data.materials] == ["red", "blue"]
    assert [p.material_index for p in baked.data.polygons] == [p.material_index for p in own.data.polygons]
    ours, theirs = (np.array([d.uv[:] for d in each.data.uv_layers[0].data]) for each in (baked, own))
    assert np.array_equal(ours, theirs)
    for frame in range(1, 6):
        scene.frame_set(frame)
        assert (posed(blender, own) - posed(blender, baked)).norm(dim=1).max() < 0.02


def test_usd_and_glb_have_one_size(blender: Any, bars: Shapes, tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core is not installed")
    sizes = []
    for suffix in ("glb", "usdc"):
        path = tm.save_animation(bars.keyframes[:2], bars.faces, tmp_path / f"a.{suffix}")
        there = set(blender.data.objects)
        load = blender.ops.import_scene.gltf if suffix == "glb" else blender.ops.wm.usd_import
        load(filepath=str(path))
        mesh = next(each for each in set(blender.data.objects) - there if each.type == "MESH")
        blender.context.view_layer.update()
        points = torch.tensor([list(mesh.matrix_world @ vertex.co) for vertex in mesh.data.vertices])
        sizes.append(float((points.amax(0) - points.amin(0)).norm()))
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-3)


def test_blender_accepts_the_extension(blender: Any) -> None:
    tool = Path(blender.utils.system_resource("SCRIPTS"), "addons_core", "bl_pkg", "cli", "blender_ext.py")
    command = [sys.executable, str(tool), "validate", str(EXTENSION)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
