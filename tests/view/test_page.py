"""The page: what it holds, what it refuses, and in a real browser what it shows and does."""

import base64
import json
import re
import time
import zlib
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from browsers import NoBrowser, console, open_browser, open_page, requests

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.data.sequence import read_shapes
from torch_modal.errors import MeshError
from torch_modal.registration.landmarks import read_landmarks
from torch_modal.registration.load import load_keyframes
from torch_modal.view.page import Page, show_landmarks
from torch_modal.view.page_data import GRID_STEPS, pack_faces, pack_group

Ball = tuple[np.ndarray, np.ndarray]
NASTY = "</script><script>document.title='broken'</script><img src=x onerror=\"document.title='broken'\">&amp;'"


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    """A sphere around (1, 2, 3), of radius 2, with one vertex straight towards +z: vertices (V, 3), faces (F, 3)."""
    mesh = trimesh.creation.uv_sphere(radius=2.0, count=(16, 16))
    assert np.isclose(mesh.vertices[:, 2].max(), 2.0)
    return np.array(mesh.vertices) + np.array([1.0, 2.0, 3.0]), np.array(mesh.faces, dtype=np.int64)


@pytest.fixture(scope="module")
def growing(ball: Ball) -> np.ndarray:
    """Seven frames of the ball: from its size to 1.6 times that, a tenth a frame."""
    vertices, _ = ball
    centre = np.array([1.0, 2.0, 3.0])
    return np.stack([centre + (1 + 0.1 * n) * (vertices - centre) for n in range(7)])


def data_of(page: Page) -> dict[str, Any]:
    """What the page's scripts find in it."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.html, re.S)
    assert found
    return json.loads(found.group(1))


def unpacked(text: str, width: int) -> np.ndarray:
    """Signed numbers from a page's text, as page_data.py describes it: one at a time, the plain way."""
    planes = zlib.decompress(base64.b64decode(text))
    count = len(planes) // width
    numbers = [sum(planes[p * count + i] << (8 * p) for p in range(width)) for i in range(count)]
    return np.array([n // 2 if n % 2 == 0 else -(n + 1) // 2 for n in numbers])


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
    np.testing.assert_array_equal(np.cumsum(unpacked(pack_faces(many), 4)), many.reshape(-1))


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


# ----------------------------------------------------------------------------------------------------- in a browser
@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    try:
        with open_browser() as browser:
            yield browser
    except NoBrowser as reason:
        pytest.skip(f"no page can be opened: {reason}")


class Opened:
    """A page in the browser, and what is done with it."""

    def __init__(self, chrome: Any, path: Path, frame: str | None = None) -> None:
        self.chrome = chrome
        console(chrome), requests(chrome)  # of the page before
        open_page(chrome, path, frame)

    def script(self, text: str, *arguments: Any) -> Any:
        return self.chrome.execute_script(text, *arguments)

    def settle(self) -> None:
        """Wait until all is drawn and nothing moves, also after two more turns of the page's loop."""
        look = "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(() =>"
        for _ in range(200):
            if self.chrome.execute_async_script(f"{look} done(torchModal.idle))))"):
                return
            time.sleep(0.05)
        raise AssertionError("the page does not come to rest")

    def seek(self, frame: float) -> None:
        self.script("torchModal.seek(arguments[0])", frame)
        self.settle()

    def text(self, selector: str) -> str:
        return self.chrome.find_element("css selector", selector).text

    def click(self, selector: str) -> None:
        self.chrome.find_element("css selector", selector).click()
        self.settle()

    def choose(self, name: str, value: str) -> None:
        change = "const s = document.getElementById(arguments[0]); s.value = arguments[1];"
        self.script(change + "s.dispatchEvent(new Event('change'))", name, value)
        self.settle()

    def press(self, *keys: str) -> None:
        from selenium.webdriver import ActionChains

        ActionChains(self.chrome).send_keys(*keys).perform()
        self.settle()

    def click_at(self, x: float, y: float) -> None:
        from selenium.webdriver.common.actions.action_builder import ActionBuilder

        builder = ActionBuilder(self.chrome)
        builder.pointer_action.move_to_location(round(x), round(y)).click()
        builder.perform()
        self.settle()

    def pixels(self) -> np.ndarray:
        """The shapes as they are seen, without what lies over them. *Shape:* ``(height, width, 3)``."""
        import io

        from PIL import Image

        png = self.chrome.find_element("id", "canvas").screenshot_as_png
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.int64)

    def position(self, vertex: int, sequence: int = 0) -> np.ndarray:
        return np.array(self.script("return torchModal.positionOf(arguments[0], arguments[1])", vertex, sequence))

    def picks(self) -> list[int]:
        return [int(word) for word in self.script("return torchModal.text").split(",") if word.strip()]

    def drawn_area(self) -> int:
        """How many pixels are not background, which is nearly white."""
        return int((self.pixels().min(axis=-1) < 225).sum())

    def reddish(self) -> int:
        """How many pixels are of the warm colour of key-frames."""
        pixels = self.pixels()
        return int((pixels[..., 0] > pixels[..., 2] + 30).sum())


@pytest.fixture
def page(chrome: Any, tmp_path: Path, ball: Ball, growing: np.ndarray) -> Iterator[Opened]:
    """Two sequences, the second standing still; nothing may appear on the console, and nothing may be asked for."""
    rows = {"growing": growing, "still": growing[:1].repeat(7, axis=0)}
    shown = tm.show(rows, ball[1], keyframe_indices=[0, 2, 6], view=(0, 0), fps=6)
    path = shown.save(tmp_path / "page.html")
    opened = Opened(chrome, path)
    yield opened
    assert not console(chrome)
    assert [address for address in requests(chrome) if address != "data:,"] == [path.absolute().as_uri()]


def test_frames_change(page: Opened, growing: np.ndarray) -> None:
    step = 1.6 * 4 / GRID_STEPS
    start, small = page.pixels(), page.drawn_area()
    assert page.reddish() > 1000, "a key-frame"
    assert page.text("#readout") == "frame 0 / 6"
    for frame in (6, 2.5):
        page.seek(frame)
        low = int(frame)
        expected = growing[low] + (frame - low) * (growing[min(low + 1, 6)] - growing[low])
        for vertex in (0, 17, 100):
            np.testing.assert_allclose(page.position(vertex), expected[vertex], atol=step)
            np.testing.assert_allclose(page.position(vertex, 1), growing[0, vertex], atol=step)
    assert page.text("#readout") == "frame 2.5 / 6"
    assert (page.pixels() != start).any()
    assert page.drawn_area() > 1.2 * small


def test_scrubbing_and_keys(page: Opened) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    slider = page.chrome.find_element("id", "time")
    ActionChains(page.chrome).move_to_element_with_offset(slider, 0, 0).click().perform()
    page.settle()
    assert page.script("return torchModal.frame") == pytest.approx(3, abs=0.1)
    page.press(Keys.ARROW_RIGHT)
    assert page.text("#readout") == "frame 4 / 6"
    ActionChains(page.chrome).key_down(Keys.SHIFT).send_keys(Keys.ARROW_LEFT).key_up(Keys.SHIFT).perform()
    page.settle()
    assert page.text("#readout") == "frame 2 / 6"
    page.press(Keys.END)
    assert page.text("#readout") == "frame 6 / 6"
    page.click('#keyframes button[title="Key-frame 2"]')
    assert page.text("#readout") == "frame 2 / 6"


def test_a_page_plays_to_the_end(page: Opened) -> None:
    before = page.script("return torchModal.drawn")
    page.choose("ending", "stop")
    page.click("#play")  # and waits for the end
    assert page.text("#readout") == "frame 6 / 6"
    assert page.chrome.find_element("id", "play").get_attribute("aria-pressed") == "false"
    assert page.script("return torchModal.drawn") >= before + 3, "it went through frames between"


def test_a_click_picks_a_vertex(page: Opened, growing: np.ndarray) -> None:
    canvas = page.chrome.find_element("id", "canvas").rect
    nearest = int(growing[0, :, 2].argmax())  # straight towards the viewer
    middle = canvas["y"] + canvas["height"] / 2
    page.click_at(canvas["x"] + 0.25 * canvas["width"], middle)
    assert page.picks() == [nearest]
    page.click_at(canvas["x"] + 0.75 * canvas["width"], middle)  # the same vertex of the other sequence: taken back
    assert page.picks() == []
    page.click_at(canvas["x"] + 3, canvas["y"] + canvas["height"] - 3)  # beside the shapes
    assert page.picks() == []
    # Vertices that face the viewer, in both sequences and at another frame.
    facing = np.flatnonzero(growing[0, :, 2] > 3 + 1.2)
    wanted = facing[:: len(facing) // 6].tolist()
    page.seek(4)
    for i, vertex in enumerate(wanted):
        place = page.script("return torchModal.placeOf(arguments[0], arguments[1])", vertex, i % 2)
        page.click_at(place["x"], place["y"])
    assert page.picks() == wanted
    assert [mark.text for mark in page.chrome.find_elements("css selector", ".mark")] == 2 * [str(v) for v in wanted]
    page.click("#clear")
    assert page.picks() == []


def test_dragging_turns_and_does_not_pick(page: Opened) -> None:
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    canvas, before = page.chrome.find_element("id", "canvas").rect, page.pixels()
    x, y = canvas["x"] + canvas["width"] / 4, canvas["y"] + canvas["height"] / 2
    builder = ActionBuilder(page.chrome)
    builder.pointer_action.move_to_location(round(x), round(y)).pointer_down()
    builder.pointer_action.move_to_location(round(x + 80), round(y + 30)).pointer_up()
    builder.perform()
    page.settle()
    assert page.picks() == []
    assert (page.pixels() != before).any()
    page.click("#reset")
    assert (page.pixels() == before).all()


def test_picked_vertices_leave_trails(page: Opened) -> None:
    canvas, before = page.chrome.find_element("id", "canvas").rect, page.pixels()
    page.click_at(canvas["x"] + canvas["width"] / 4, canvas["y"] + canvas["height"] / 2)
    page.script("document.querySelectorAll('#picked, .mark').forEach((card) => (card.style.visibility = 'hidden'))")
    with_trail = page.pixels()
    assert (with_trail != before).any()
    page.script("document.getElementById('trails').click()")
    page.settle()
    assert (page.pixels() != with_trail).any()


def test_sequences_are_shown_side_by_side_and_overlaid(page: Opened) -> None:
    page.seek(6)
    both = page.drawn_area()
    page.click("#sequences button:nth-child(2)")
    assert page.drawn_area() < both
    assert len(page.chrome.find_elements("css selector", ".name")) == 1
    page.click("#sequences button:nth-child(2)")
    page.click("#layout button[value=over]")
    overlaid = page.pixels()
    page.click("#sequences button:nth-child(1)")
    alone = page.pixels()
    assert (alone != overlaid).any()
    page.click("#wireframe")
    assert page.pixels().sum() < alone.sum(), "the lines are dark"


def test_user_texts_are_texts(chrome: Any, tmp_path: Path, ball: Ball, growing: np.ndarray) -> None:
    shown = tm.show({NASTY: growing, "b": growing}, ball[1], title=NASTY)
    page = Opened(chrome, shown.save(tmp_path / "page.html"))
    assert chrome.title == NASTY
    assert page.text("h1") == page.text("#sequences button") == page.text(".name") == NASTY
    assert not console(chrome)


def test_cyclic_times_and_notebook(chrome: Any, tmp_path: Path, ball: Ball, growing: np.ndarray) -> None:
    """A closed sequence in the frame that a notebook makes."""
    times = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 10.0]
    shown = tm.show(growing, ball[1], cyclic=True, times=times)
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><title>notebook</title>{shown._repr_html_()}")
    page = Opened(chrome, path, frame="iframe")
    page.seek(6.5)  # half-way back to the first
    np.testing.assert_allclose(page.position(5), 0.5 * (growing[6, 5] + growing[0, 5]), atol=1e-3)
    page.seek(5.5)
    assert page.text("#readout") == "frame 5.5 / 6, t = 7.5"
    places = [
        float(tick.get_attribute("style").split("--place:")[1].strip(" ;"))
        for tick in chrome.find_elements("css selector", "#keyframes button")
    ]
    assert places == pytest.approx([0.0, 10 / (10 + 10 / 6)])
    chrome.switch_to.default_content()
    assert not console(chrome)


def test_without_webgl(tmp_path: Path, ball: Ball, growing: np.ndarray) -> None:
    path = tm.show(growing, ball[1]).save(tmp_path / "page.html")
    try:
        with open_browser(800, 600, "--disable-3d-apis") as browser, pytest.raises(AssertionError, match="needs WebGL"):
            open_page(browser, path)
    except NoBrowser as reason:
        pytest.skip(f"no page can be opened: {reason}")


# ------------------------------------------------------------------------------------------------------- landmarks
@pytest.fixture
def two(ball: Ball, tmp_path: Path) -> list[Path]:
    """A ball, and a box of another connectivity elsewhere."""
    box = trimesh.creation.box(extents=(4, 2, 3)).subdivide().subdivide().subdivide()
    meshes = [tmp_path / "ball.obj", tmp_path / "box.ply"]
    trimesh.Trimesh(*ball, process=False).export(meshes[0])
    trimesh.Trimesh(box.vertices + 50, box.faces, process=False).export(meshes[1])
    return meshes


def test_landmarks_are_picked_and_saved(chrome: Any, two: list[Path], tmp_path: Path) -> None:
    """Two are there, one is picked on both meshes; what Save writes is what `--landmarks` reads."""
    given = tmp_path / "given.txt"
    given.write_text("3 5\n7 9\n")
    out = tmp_path / "pick.html"
    assert main(["view", *map(str, two), "--landmarks", str(given), "--page", str(out), "--quiet"]) == 0
    page = Opened(chrome, out)
    assert read_text(page) == [[3, 5], [7, 9]]
    shapes = [load_keyframes([path]).keyframes[0].numpy() for path in two]
    # The vertices that are straight towards the viewer: each mesh is seen on its own.
    places = [(panel.rect["x"] + panel.rect["width"] / 2, panel.rect["y"] + panel.rect["height"] / 2)
              for panel in chrome.find_elements("css selector", ".cell")]  # fmt: skip
    page.click_at(*places[1])
    assert "ball.obj" in page.text("#hint") and read_text(page) == [[3, 5], [7, 9]], "not whole yet"
    page.click_at(places[1][0] + 40, places[1][1])  # another vertex of the same landmark
    page.click_at(*places[0])
    rows = read_text(page)
    assert len(rows) == 3
    for mesh, vertex in enumerate(rows[2]):
        place = page.script("return torchModal.placeOf(arguments[0], arguments[1])", vertex, mesh)
        away = np.hypot(place["x"] - places[mesh][0] - 40 * mesh, place["y"] - places[mesh][1])
        assert vertex < len(shapes[mesh]) and away < 40, "the vertex that was clicked on"
    assert [mark.text for mark in chrome.find_elements("css selector", ".mark")] == ["1", "2", "3"] * 2
    chrome.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    page.click("#save")
    saved = tmp_path / "landmarks.txt"
    for _ in range(100):
        if saved.exists():
            break
        time.sleep(0.05)
    assert saved.read_text().splitlines()[0] == "# ball.obj  box.ply"
    np.testing.assert_array_equal(read_landmarks(saved, 2), rows)
    page.click("#undo")
    assert read_text(page) == [[3, 5], [7, 9]]
    page.click("#chips button")
    assert len(chrome.find_elements("css selector", "#chips button")) == 2
    page.click("#clear")
    assert read_text(page) == [] and not chrome.find_element("id", "save").is_enabled()
    page.click("#undo")
    assert read_text(page) == [[7, 9]]
    assert not console(chrome)


def read_text(page: Opened) -> list[list[int]]:
    """The landmarks of a page."""
    lines = page.script("return torchModal.text").splitlines()
    return [[int(word) for word in line.split()] for line in lines if not line.startswith("#")]


def test_landmarks_as_points_become_vertices(two: list[Path], tmp_path: Path) -> None:
    shapes = [load_keyframes([path]).keyframes[0].numpy() for path in two]
    file, out = tmp_path / "points.txt", tmp_path / "page.html"
    file.write_text(" ".join(map(str, [*(shapes[0][4] + 1e-4), *(shapes[1][6] - 1e-4)])))
    assert main(["view", *map(str, two), "--landmarks", str(file), "--page", str(out)]) == 0
    assert data_of(Page(out.read_text(encoding="utf-8")))["landmarks"] == [[4, 6]]


def test_landmarks_that_cannot_be_shown(
    two: list[Path], ball: Ball, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "wrong.txt"
    file.write_text("3 99999")
    pages = ["--page", str(tmp_path / "page.html")]
    assert main(["view", *map(str, two), "--landmarks", str(file), *pages]) == 1
    assert "names vertex 99999 of mesh 1" in capsys.readouterr().err
    for wrong in (["--linear"], ["--keyframes", "0"]):
        with pytest.raises(SystemExit):
            main(["view", *map(str, two), *pages, *wrong, "--landmarks"])
    with pytest.raises(SystemExit):
        main(["view", str(two[0]), "--landmarks", *pages])
    with pytest.raises(ValueError, match="two meshes or more"):
        show_landmarks({"a": ball})
    for wrong in (np.zeros((3, 3), dtype=int), np.array([[0, -1]]), np.array([[0.0, 1.0]])):
        with pytest.raises(ValueError, match="a column for each of the meshes"):
            show_landmarks({"a": ball, "b": ball}, wrong)
