"""The add-on for Blender against a fake of the calls that it makes."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from conftest import Shapes
from test_examples import load_example

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
    found = load_example("blender/in_between_keys")
    found.register()
    assert len(registered) == 2 and len(menu) == 1
    found.unregister()
    assert not registered and not menu
    return found


def run(addon: ModuleType, body: Body, program: str = PROGRAM) -> tuple[set[str], Any]:
    operator = addon.InBetweenKeys()
    operator.levels, operator.step, operator.cyclic, operator.contact, operator.said = 1, 2, False, False, []
    preferences = {addon.__name__: SimpleNamespace(preferences=SimpleNamespace(program=program))}
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
