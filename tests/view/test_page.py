"""The page: its data, its input, its file, and what it refuses."""

from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from conftest import Ball
from helpers.pages import NASTY, data_of, unpacked

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.data.sequence import read_shapes
from torch_modal.errors import MeshError
from torch_modal.view.page import Page
from torch_modal.view.page_data import GRID_STEPS, pack_group, pack_integers


# ---------------------------------------------------------------------------------------------------------- the data
def test_frames_come_back_within_half_a_step(generator: torch.Generator) -> None:
    # Jumps over the whole range: differences wrap.
    frames = 1e3 * torch.rand(5, 40, 3, generator=generator, dtype=torch.float64).numpy() - 700
    frames[1, 0], frames[2, 0] = 300.0, -700.0
    group = pack_group({"a": frames}, np.array([[0, 1, 2]]))
    residual = unpacked(group["sequences"][0]["frames"], 2).reshape(5, 3, 40).transpose(0, 2, 1)
    numbers = np.zeros_like(residual)
    for n in range(5):
        guess = 2 * numbers[n - 1] - numbers[n - 2] if n > 1 else numbers[0] if n else 0
        numbers[n] = (guess + residual[n]) % 2**16
    assert np.abs(group["origin"] + group["step"] * numbers - frames).max() <= 0.5001 * group["step"]
    assert group["step"] == pytest.approx(np.ptp(frames, axis=(0, 1)).max() / GRID_STEPS)


def test_faces_come_back(ball: Ball) -> None:
    many = np.concatenate([ball[1], ball[1] + 70_000])  # more than 16 bits
    np.testing.assert_array_equal(np.cumsum(unpacked(pack_integers(many), 4)), many.reshape(-1))


def test_points_at_one_place_are_one_key_frame() -> None:
    data = data_of(tm.show(np.full((1, 4, 3), 5.0), np.array([[0, 1, 2]])))
    assert data["keyframes"] == [0] and data["groups"][0]["step"] == 1.0


def test_what_the_page_is_told(ball: Ball, growing: np.ndarray) -> None:
    faces = ball[1]
    page = tm.show({"a": torch.from_numpy(growing).float(), "b": growing}, torch.from_numpy(faces), cyclic=True)
    data = data_of(page)
    (group,) = data["groups"]
    assert [one["name"] for one in group["sequences"]] == ["a", "b"]
    assert data["times"] == list(range(8)) and data["keyframes"] == [0, 6] and data["fps"] == 24.0
    centre = group["origin"] + group["step"] * np.array(group["view"]["centre"])
    np.testing.assert_allclose(centre, [1, 2, 3], atol=0.05)
    there_and_back = np.concatenate([growing, growing[-2::-1]])
    assert len(data_of(tm.show(there_and_back, faces, cyclic=True))["times"]) == 13, "its last frame is the first"
    (group,) = data_of(tm.show(growing[:, :, [0, 2, 1]], faces, up="z"))["groups"]
    assert group["view"]["world_up"] == [0, 0, 1]


def test_page_needs_nothing_else(ball: Ball, growing: np.ndarray) -> None:
    page = tm.show({NASTY: growing}, ball[1], title=NASTY)
    references, titles = [], []

    class Parser(HTMLParser):
        last = ""

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            references.extend(value for name, value in attrs if name in ("src", "href", "srcset", "action"))
            assert not [name for name, _ in attrs if name.startswith("on") or name == "style"]
            self.last = tag

        def handle_data(self, text: str) -> None:
            if self.last in ("title", "h1"):
                titles.append(text.strip())

    Parser().feed(page.html)
    assert references == ["data:,"]
    assert [title for title in titles if title] == [NASTY, NASTY]
    assert "connect-src" not in page.html.split("<style>")[0], "default-src 'none' stands for it"
    assert page.html.count("<script") == 3


def test_save_and_notebook(tmp_path: Path, ball: Ball, growing: np.ndarray) -> None:
    page = tm.show(growing, ball[1], height=321)
    path = page.save(tmp_path / "new" / "page.html")
    assert path.read_text(encoding="utf-8") == page.html
    with pytest.raises(ValueError, match=r"\.html"):
        page.save(tmp_path / "page.png")
    assert "height: 321px" in page._repr_html_()
    assert len(repr(page)) < 100
    assert page.save(path) == path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sequences": {"a": np.zeros((2, 4, 3)), "b": np.zeros((3, 4, 3))}}, r"'a' \(2, 4, 3\), 'b' \(3, 4, 3\)"),
        ({"faces": np.array([[0, 1, 9]])}, "index the 4 vertices"),
        ({"times": [0.0]}, "2 ascending numbers, one for each frame"),
        ({"times": [1.0, 1.0]}, "got 1 at place 1, after 1"),
        ({"fps": 0.0}, "fps"),
        ({"height": 0}, "height"),
        ({"view": (0.0, float("inf"))}, "view"),
    ],
)
def test_what_cannot_be_shown(changes: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"sequences": np.zeros((2, 4, 3)), "faces": np.array([[0, 1, 2]])} | changes
    with pytest.raises(ValueError, match=message):
        tm.show(**given)


# -------------------------------------------------------------------------------------------------------- its input
def test_animation_is_read_back(tmp_path: Path, ball: Ball, growing: np.ndarray) -> None:
    path = tm.save_animation(growing, ball[1], tmp_path / "a.glb", fps=12, keyframe_indices=[0, 4], cyclic=True)
    frames, faces, options = read_shapes([path])
    np.testing.assert_allclose(frames, growing, atol=1e-6)
    np.testing.assert_array_equal(faces, ball[1])
    assert options == {"keyframe_indices": [0, 4], "fps": 12.0, "cyclic": True}
    tm.save_animation(growing[:1], ball[1], path)
    assert read_shapes([path])[0].shape == (1, *growing[0].shape)


def test_folders_without_a_sequence_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="no meshes"):
        read_shapes([tmp_path])
    for name in ("a1.obj", "a2.ply"):
        (tmp_path / name).write_text("")
    with pytest.raises(MeshError, match="several kinds"):
        read_shapes([tmp_path])


def test_damaged_animations_are_refused(tmp_path: Path, ball: Ball, growing: np.ndarray) -> None:
    path = tm.save_animation(growing, ball[1], tmp_path / "a.glb")
    written = path.read_bytes()
    path.write_bytes(written.replace(b'"keyframes":[]', b'"keyfrmaes":[]'))
    with pytest.raises(MeshError, match="its animation cannot be read"):
        read_shapes([path])
    path.write_bytes(written[:4000])
    with pytest.raises(MeshError, match=r"a\.glb"):
        read_shapes([path])


def test_view_command_writes_a_page(
    tmp_path: Path, ball: Ball, growing: np.ndarray, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    glb = tm.save_animation(growing, ball[1], tmp_path / "grow.glb", keyframe_indices=[0, 6])
    tm.save_mesh(growing, ball[1], tmp_path / "frames")
    out = tmp_path / "page.html"
    arguments = ["view", str(glb), "--compare", str(tmp_path / "frames"), "--linear", "--page", str(out)]
    assert main(arguments) == 0
    assert f"page: {out}" in capsys.readouterr().out
    data = data_of(Page(out.read_text(encoding="utf-8")))
    names, packed = zip(*[(one["name"], one["frames"]) for one in data["groups"][0]["sequences"]], strict=True)
    assert names == ("grow", "frames", "linear")
    assert len(set(packed)) == 1, "the ball grows linearly"
    assert main(arguments) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main([*arguments, "--overwrite", "--keyframes", "0", "3", "6", "--up", "z", "--quiet"]) == 0
    data = data_of(Page(out.read_text(encoding="utf-8")))
    assert data["groups"][0]["view"]["world_up"] == [0, 0, 1]
    assert [one["name"] for one in data["groups"][0]["sequences"]] == list(names)
    assert data["keyframes"] == [0, 3, 6]

    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: bool(opened.append(address)))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["view", str(glb)]) == 0
    assert "no browser was found" in capsys.readouterr().out
    assert Path(opened[0].removeprefix("file://")).is_file()


def test_command_says_what_is_wrong(
    tmp_path: Path,
    ball: Ball,
    growing: np.ndarray,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    tm.save_animation(growing, ball[1], "grow.glb", keyframe_indices=[0, 6])
    tm.save_mesh(growing[:3], ball[1], "short")
    trimesh.creation.box().export("cube.ply")
    for arguments, message in (
        (["--compare", "short"], "(3, "),
        (["--compare", "cube.ply"], "vertices"),
        (["--linear", "--keyframes", "0", "7"], "from 0 to 6"),
        (["--keyframes", "7"], "from 0 to 6"),
        (["--fps", "0"], "fps must be a positive"),
        (["--compare", "missing.ply"], "no such file"),
    ):
        assert main(["view", "grow.glb", *arguments, "--page", "page.html"]) == 1
        assert message in capsys.readouterr().err and not Path("page.html").exists()
