"""The page in a real browser: its shapes, its controls, vertices and landmarks that are picked."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import Ball
from helpers.browsers import NoBrowser, console, open_browser, open_page, requests
from helpers.pages import NASTY, Opened, data_of

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.registration.landmarks import read_landmarks
from torch_modal.registration.load import load_keyframes
from torch_modal.view.page import Page, show_landmarks
from torch_modal.view.page_data import GRID_STEPS


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
