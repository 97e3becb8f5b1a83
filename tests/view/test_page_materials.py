"""Materials of the page: packed from files, and in a real browser of the right colours at the right places."""

import base64
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import Ball
from helpers.browsers import console
from helpers.pages import Opened, data_of, unpacked
from helpers.textured import RED, bend, textured_glb, textured_obj
from PIL import Image
from trimesh.visual.material import PBRMaterial

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.errors import MeshWarning
from torch_modal.view.page import Page, show_landmarks
from torch_modal.view.page_data import TEXTURE_PIXELS

FOUR = np.array([[[200, 30, 30], [30, 160, 60]], [[30, 60, 200], [188, 188, 188]]], np.uint8)  # rows from above
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = SQUARE[:, :2]  # trimesh counts them from below


def picture(kind: str = "PNG", width: int = 64, height: int = 64) -> bytes:
    """Four colours in four quarters."""
    stream = io.BytesIO()
    Image.fromarray(FOUR).resize((width, height), Image.Resampling.NEAREST).save(stream, kind)
    return stream.getvalue()


def square_glb(path: Path, *materials: PBRMaterial) -> Path:
    """A square for each material, side by side towards +z; the first one from (0, 0, 0) to (1, 1, 0)."""
    scene = trimesh.Scene()
    for i, material in enumerate(materials):
        visual = trimesh.visual.TextureVisuals(uv=UV, material=material)
        scene.add_geometry(trimesh.Trimesh(SQUARE + np.array([i, 0, 0]), FACES, process=False, visual=visual))
    path.write_bytes(scene.export(file_type="glb"))
    return path


def opened_square(material: PBRMaterial, folder: Path) -> Any:
    """A square of one material."""
    return tm.open_asset(square_glb(folder / "square.glb", material))


def textured(image: bytes | None = None, **options: Any) -> PBRMaterial:
    """A material without a factor, in the terms of trimesh."""
    image = picture() if image is None else image
    return PBRMaterial(baseColorTexture=Image.open(io.BytesIO(image)), metallicFactor=0.0, **options)


def lit(color: Any) -> np.ndarray:
    """An sRGB colour as the page shows it on a surface that faces the viewer: lights times colour, and a shine."""
    return 0.915 * np.asarray(color) + 3.4


def linear(color: np.ndarray) -> np.ndarray:
    """Light of sRGB colours of eight bits."""
    return np.where(color <= 10, color / 255 / 12.92, ((color / 255 + 0.055) / 1.055) ** 2.4)


def color_at(page: Opened, pixels: np.ndarray, place: dict[str, float]) -> np.ndarray:
    """Median of the pixels around a place of the window."""
    canvas = page.chrome.find_element("id", "canvas").rect
    x, y = round(place["x"] - canvas["x"]), round(place["y"] - canvas["y"])
    return np.median(pixels[y - 3 : y + 4, x - 3 : x + 4], axis=(0, 1))


def place_of(page: Opened, *vertices: int, sequence: int = 0) -> dict[str, float]:
    """Mean of the places where vertices are seen."""
    script = "return torchModal.placeOf(arguments[0], arguments[1])"
    places = [page.script(script, vertex, sequence) for vertex in vertices]
    return {axis: float(np.mean([place[axis] for place in places])) for axis in "xy"}


def quarters(page: Opened, sequence: int = 0) -> np.ndarray:
    """Colours in the middles of the quarters of the first square, by rows from above. *Shape:* ``(2, 2, 3)``."""
    pixels = page.pixels()
    middle = [(0, 1, 2, 3, 3, 3, 3, 3), (0, 1, 2, 3, 2, 2, 2, 2), (0, 1, 2, 3, 0, 0, 0, 0), (0, 1, 2, 3, 1, 1, 1, 1)]
    found = [color_at(page, pixels, place_of(page, *corners, sequence=sequence)) for corners in middle]
    return np.array(found).reshape(2, 2, 3)


# ---------------------------------------------------------------------------------------------------------- the data
def surface_of(page: Page) -> dict[str, Any]:
    return data_of(page)["groups"][0]["surface"]


def texture_of(page: Page, number: int = 1) -> tuple[str, bytes]:
    """Kind and file of a texture; the first one is none."""
    kind, text = re.fullmatch(r"data:image/(\w+);base64,(.*)", surface_of(page)["textures"][number]).groups()  # type: ignore[union-attr]
    return kind, base64.b64decode(text)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_textures_are_as_they_came(tmp_path: Path, kind: str) -> None:
    asset = opened_square(textured(picture(kind)), tmp_path)
    (part,) = asset.parts()
    found, data = texture_of(tm.show(asset.positions[None], asset.faces, asset=asset))
    assert found == kind.lower() and data == part.material.texture


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_large_textures_are_scaled_down(tmp_path: Path, kind: str) -> None:
    asset = opened_square(textured(picture(kind, 2 * TEXTURE_PIXELS + 10, 1024)), tmp_path)
    found, data = texture_of(tm.show(asset.positions[None], asset.faces, asset=asset))
    image = Image.open(io.BytesIO(data))
    assert found == kind.lower() and image.format == kind and image.size == (TEXTURE_PIXELS, 511)
    np.testing.assert_allclose(np.asarray(image.convert("RGB"))[100, 100], FOUR[0, 0], atol=3)


def test_a_damaged_texture_is_white(tmp_path: Path) -> None:
    path = textured_obj(tmp_path, "bar.obj")
    (tmp_path / "blue.png").write_bytes((tmp_path / "blue.png").read_bytes()[:40])
    asset = tm.open_asset(path)
    with pytest.warns(MeshWarning, match="the texture of 'cap' cannot be read"):
        page = tm.show(asset.positions[None], asset.faces, asset=asset)
    textures = [np.asarray(Image.open(io.BytesIO(texture_of(page, n)[1])).convert("RGB")) for n in (1, 2)]
    assert sorted(image.shape[0] for image in textures) == [1, 8]
    assert (min(textures, key=len) == 255).all()


def test_parts_share_textures_and_points_share_normals(tmp_path: Path) -> None:
    asset = tm.open_asset(square_glb(tmp_path / "two.glb", textured(), textured(alphaMode="MASK")))
    surface = surface_of(tm.show(asset.positions[None], asset.faces, asset=asset))
    assert [part["texture"] for part in surface["parts"]] == [1, 1] and len(surface["textures"]) == 2
    assert [part["alpha"] for part in surface["parts"]] == ["OPAQUE", "MASK"]
    # The bar has a seam of texture coordinates, and hard edges between its body and its caps.
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    surface = surface_of(tm.show(asset.positions[None], asset.faces, asset=asset))
    n_normals = 8 * 12 + 2 * (12 + 1)
    assert surface["n_points"] == 8 * 13 + 2 * (12 + 1)
    assert len(np.unique(np.cumsum(unpacked(surface["normals"], 4)))) == n_normals


def test_commands_pass_materials_on(tmp_path: Path, ball: Ball) -> None:
    bar, out = textured_glb(tmp_path / "bar.glb"), tmp_path / "page.html"
    assert main(["view", str(bar), "--page", str(out), "--quiet"]) == 0
    page = Page(out.read_text(encoding="utf-8"))
    assert [part["texture"] for part in surface_of(page)["parts"]] == [1, 2]
    assert np.asarray(Image.open(io.BytesIO(texture_of(page)[1])).convert("RGB"))[4, 4].tolist() == list(RED)
    tm.save_mesh(*ball, tmp_path / "plain.ply")
    assert main(["view", str(tmp_path / "plain.ply"), "--page", str(out), "--quiet", "--overwrite"]) == 0
    assert surface_of(Page(out.read_text(encoding="utf-8"))) is None
    assert surface_of(show_landmarks({"a": ball, "b": ball})) is None


def test_an_asset_of_another_mesh_is_refused(tmp_path: Path, ball: Ball) -> None:
    asset = opened_square(textured(), tmp_path)
    with pytest.raises(ValueError, match="has 4 vertices, the frames have"):
        tm.show(ball[0][None], ball[1], asset=asset)


# ----------------------------------------------------------------------------------------------------- in a browser
def test_texture_at_its_place_and_plain(chrome: Any, tmp_path: Path) -> None:
    """Two sequences side by side share the texture; it moves with the shape; a click or a key shows them plain."""
    asset = opened_square(textured(), tmp_path)
    frames = np.stack([asset.positions, asset.positions * [1, 0.6, 1]])
    rows = {"a": frames, "b": frames[::-1]}
    shown = tm.show(rows, asset.faces, asset=asset, view=(0, 0), keyframe_indices=[0])
    page = Opened(chrome, shown.save(tmp_path / "page.html"))
    for frame in (0, 1, 0.5):
        page.seek(frame)
        for sequence in (0, 1):
            np.testing.assert_allclose(quarters(page, sequence), lit(FOUR), atol=7)
    page.seek(0)
    page.click("#materials")
    plain = quarters(page)
    assert np.ptp(plain, axis=(0, 1)).max() < 6 and (plain[..., 0] > plain[..., 2] + 60).all(), "a key-frame's colour"
    page.seek(1)
    assert (quarters(page)[..., 2] > quarters(page)[..., 0] + 20).all(), "the colour of a shape between"
    page.press("m")
    np.testing.assert_allclose(quarters(page), lit(FOUR), atol=7)
    # Overlaid, the first sequence keeps its texture and the other one has its colour.
    page.click("#layout button[value=over]")
    both = page.pixels()
    page.click("#sequences button:nth-child(2)")
    assert (page.pixels() != both).any()
    np.testing.assert_allclose(quarters(page), lit(FOUR), atol=7)
    assert not console(chrome)


def test_texture_in_a_notebook(chrome: Any, tmp_path: Path) -> None:
    """Within the sandbox of a notebook's frame."""
    asset = opened_square(textured(), tmp_path)
    shown = tm.show(asset.positions[None], asset.faces, asset=asset, view=(0, 0))
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><title>notebook</title>{shown._repr_html_()}")
    page = Opened(chrome, path, frame="iframe")
    np.testing.assert_allclose(quarters(page), lit(FOUR), atol=7)
    chrome.switch_to.default_content()
    assert not console(chrome)


def test_factors_and_alpha(chrome: Any, tmp_path: Path) -> None:
    """A linear factor; alpha that is ignored, cut out, and mixed with the background."""
    clear = np.zeros((8, 8, 4), np.uint8)
    clear[:] = [*RED, 100]  # below one half
    stream = io.BytesIO()
    Image.fromarray(clear).save(stream, "PNG")
    kinds = [textured(stream.getvalue(), alphaMode=mode) for mode in ("OPAQUE", "MASK", "BLEND")]
    half = PBRMaterial(baseColorFactor=[128, 128, 128, 255], metallicFactor=0.0)
    asset = tm.open_asset(square_glb(tmp_path / "squares.glb", half, *kinds))
    shown = tm.show(asset.positions[None], asset.faces, asset=asset, view=(0, 0))
    page = Opened(chrome, shown.save(tmp_path / "page.html"))
    pixels = page.pixels()
    factor, opaque, mask, blend = (color_at(page, pixels, place_of(page, 4 * i, 4 * i + 2)) for i in range(4))
    np.testing.assert_allclose(factor, lit([188] * 3), atol=7)  # 0.5 linear
    np.testing.assert_allclose(opaque, lit(RED), atol=7)
    assert mask.min() > 235, "the background"
    np.testing.assert_allclose(blend, mask + 100 / 255 * (lit(RED) - mask), atol=9)
    assert not console(chrome)


def test_two_materials_move_and_vertices_are_picked_at_a_seam(chrome: Any, tmp_path: Path) -> None:
    """The bar of an OBJ: at its seam a vertex has two texture coordinates; its caps have another material."""
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    frames = np.stack([bend(asset.positions, turn) for turn in (0.3, 0.6, 0.9)])
    shown = tm.show(frames, asset.faces, asset=asset, view=(90, 10), up="y")
    page = Opened(chrome, shown.save(tmp_path / "page.html"))
    seam, apex = [12 * ring for ring in range(1, 7)], 8 * 12 + 1
    for frame in (0, 2):
        page.seek(frame)
        pixels = page.pixels()
        body = color_at(page, pixels, place_of(page, *seam[1:3]))
        cap = color_at(page, pixels, place_of(page, apex, 7 * 12, 7 * 12 + 1))
        assert body[0] > 3 * body[1] and body[0] > 1.5 * body[2], "red skin, times vertex colours"
        assert cap[2] > 3 * cap[0] and cap[2] > 3 * cap[1], "blue caps"
    for vertex in [*seam, apex]:
        place = place_of(page, vertex)
        page.click_at(place["x"], place["y"])
    assert page.picks() == [*seam, apex]
    np.testing.assert_allclose(page.position(seam[2]), frames[2, seam[2]], atol=1e-3)
    assert not console(chrome)


def test_vertex_colors(chrome: Any, tmp_path: Path) -> None:
    colors = FOUR[[1, 1, 0, 0], [0, 1, 1, 0]]  # of the corners, in the order of SQUARE
    path = tmp_path / "colours.ply"
    trimesh.Trimesh(SQUARE, FACES, process=False, vertex_colors=colors).export(path)
    asset = tm.open_asset(path)
    shown = tm.show(SQUARE[None], FACES, asset=asset, view=(0, 0))
    page = Opened(chrome, shown.save(tmp_path / "page.html"))
    pixels = page.pixels()
    for corners in ([0] * 8 + [1, 2], [1] * 8 + [0, 2], [2] * 8 + [0, 1], [3] * 8 + [0, 2], [0, 2, 3]):
        mixed = np.interp(np.mean(linear(colors[corners]), axis=0), linear(np.arange(256)), np.arange(256))
        np.testing.assert_allclose(color_at(page, pixels, place_of(page, *corners)), lit(mixed), atol=7)
    assert not console(chrome)


def test_a_texture_that_the_browser_cannot_read_is_white(chrome: Any, tmp_path: Path) -> None:
    asset = opened_square(textured(), tmp_path)
    shown = tm.show(asset.positions[None], asset.faces, asset=asset, view=(0, 0))
    path = tmp_path / "page.html"
    path.write_text(re.sub(r"(data:image/png;base64,)[\w+/=]+", r"\1AAAA", shown.html), encoding="utf-8")
    np.testing.assert_allclose(quarters(Opened(chrome, path)), lit(np.full((2, 2, 3), 255)), atol=7)
    assert not console(chrome)
