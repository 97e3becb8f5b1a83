"""The add-on for Blender, in Blender where that is installed, and against a fake of the calls that it makes."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes

ADDON = Path(__file__).parents[2] / "examples" / "blender" / "in_between_keys.py"
PROGRAM = str(Path(sys.executable).with_name("torch-modal"))


class Key:
    """A shape key."""

    def __init__(self, name: str, points: Any) -> None:
        self.name, self.value, self.mute = name, 0.0, False
        self.data = [SimpleNamespace(co=tuple(map(float, point))) for point in points]
        self.inserted: list[tuple[float, float]] = []

    def keyframe_insert(self, path: str, frame: float) -> None:
        assert path == "value"
        self.inserted.append((frame, self.value))


class Body:
    """A mesh object with shape keys."""

    type = "MESH"

    def __init__(self, shapes: Shapes) -> None:
        self.keys = [Key(name, x.tolist()) for name, x in zip("abc", shapes.keyframes, strict=False)]
        parts = [SimpleNamespace(vertices=tuple(face)) for face in shapes.faces.tolist()]
        blocks = SimpleNamespace(key_blocks=self.keys)
        self.data = SimpleNamespace(shape_keys=blocks, loop_triangles=parts, calc_loop_triangles=lambda: None)

    def shape_key_add(self, name: str, from_mix: bool) -> Key:
        self.keys.append(Key(name, [point.co for point in self.keys[0].data]))
        return self.keys[-1]

    def shape_key_remove(self, key: Key) -> None:
        self.keys.remove(key)


@pytest.fixture
def addon(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    registered: list[type] = []
    menu: list[Any] = []
    fake: Any = ModuleType("bpy")
    operator = type("Operator", (), {"report": lambda self, kind, text: self.said.append((kind, text))})
    fake.types = SimpleNamespace(
        AddonPreferences=type("AddonPreferences", (), {}),
        Operator=operator,
        VIEW3D_MT_object=SimpleNamespace(append=menu.append, remove=menu.remove),
    )
    fake.props = SimpleNamespace(
        **{name: lambda **options: options for name in ("StringProperty", "IntProperty", "BoolProperty")}
    )
    fake.utils = SimpleNamespace(register_class=registered.append, unregister_class=registered.remove)
    monkeypatch.setitem(sys.modules, "bpy", fake)
    spec = importlib.util.spec_from_file_location("in_between_keys", ADDON)
    assert spec is not None and spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    found.register()
    assert len(registered) == 2 and len(menu) == 1
    found.unregister()
    assert not registered and not menu
    return found


def run(addon: ModuleType, body: Body, program: str = PROGRAM) -> tuple[set[str], Any]:
    operator = addon.InBetweenKeys()
    operator.levels, operator.step, operator.cyclic, operator.contact, operator.said = 1, 2, False, False, []
    preferences = {"in_between_keys": SimpleNamespace(preferences=SimpleNamespace(program=program))}
    context = SimpleNamespace(
        active_object=body,
        preferences=SimpleNamespace(addons=preferences),
        scene=SimpleNamespace(frame_current=10),
    )
    assert addon.InBetweenKeys.poll(context)
    return operator.execute(context), operator.said


def test_shapes_are_added_and_animated(addon: ModuleType, bars: Shapes) -> None:
    body = Body(bars)
    for _ in range(2):  # a second run replaces those of the first
        assert run(addon, body)[0] == {"FINISHED"}
        own = body.keys[3:]
        assert [key.name for key in own] == [f"between {i:04d}" for i in range(5)]
    points = torch.tensor([[point.co for point in key.data] for key in own], dtype=torch.float64)
    assert torch.equal(points[::2], bars.keyframes)
    straight = 0.5 * (bars.keyframes[0] + bars.keyframes[1])
    assert 1e-3 < float((points[1] - straight).abs().max()) < 1
    assert own[2].inserted == [(12, 0.0), (14, 1.0), (16, 0.0)]
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


IN_BLENDER = """
import sys
import bpy, numpy as np
bpy.ops.preferences.addon_install(filepath=sys.argv[1])
bpy.ops.preferences.addon_enable(module="in_between_keys")
bpy.context.preferences.addons["in_between_keys"].preferences.program = sys.argv[2]
keyframes, faces = np.load(sys.argv[3]), np.load(sys.argv[4])
mesh = bpy.data.meshes.new("body")
mesh.from_pydata(keyframes[0].tolist(), [], faces.tolist())
body = bpy.data.objects.new("body", mesh)
bpy.context.collection.objects.link(body)
bpy.context.view_layer.objects.active = body
for x in keyframes:
    key = body.shape_key_add(name="given", from_mix=False)
    key.value = 1.0
    for point, place in zip(key.data, x.tolist()):
        point.co = place
bpy.context.scene.frame_set(10)
assert bpy.ops.object.in_between_shape_keys(levels=1, step=2) == {"FINISHED"}
frames = []
for frame in range(10, 19, 2):
    bpy.context.scene.frame_set(frame)
    shown = body.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    frames.append([tuple(vertex.co) for vertex in shown.vertices])
np.save(sys.argv[5], frames)
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="pip install bpy: Blender as a module")
def test_in_blender(bars: Shapes, tmp_path: Path) -> None:
    """Played there, the animation goes through the key-frames, and through the in-betweens of the command line."""
    files = [tmp_path / f"{name}.npy" for name in ("keyframes", "faces", "played")]
    for file, given in zip(files, (bars.keyframes, bars.faces), strict=False):
        np.save(file, given.numpy())
    command = [sys.executable, "-c", IN_BLENDER, str(ADDON), PROGRAM, *map(str, files)]
    env = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    played = torch.from_numpy(np.load(files[2])).double()
    assert (played[::2] - bars.keyframes).abs().max() < 1e-5
    straight = 0.5 * (bars.keyframes[:-1] + bars.keyframes[1:])
    assert (played[1::2] - straight).abs().amax((1, 2)).min() > 1e-3
