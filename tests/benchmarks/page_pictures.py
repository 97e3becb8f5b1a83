"""The pictures of docs/viewing.md: pages of the samples in a browser.

python tests/benchmarks/page_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from PIL import Image

sys.path.append(str(Path(__file__).parents[1]))  # beside the tests
from browsers import open_browser, open_page

import torch_modal as tm
from torch_modal.data.samples import load_sample

if TYPE_CHECKING:
    from selenium.webdriver import Chrome


def choose(chrome: Chrome, name: str, value: str) -> None:
    """Choose in a list of the page."""
    change = "const s = document.getElementById(arguments[0]); s.value = arguments[1];"
    chrome.execute_script(change + "s.dispatchEvent(new Event('change'))", name, value)


def save(chrome: Chrome, path: Path) -> None:
    """The window as it is, when all is drawn."""
    time.sleep(2.0)
    Image.open(io.BytesIO(chrome.get_screenshot_as_png())).convert("RGB").save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def hand(folder: Path) -> Path:
    """The closing hand beside linear interpolation and the truth."""
    sample = load_sample("hand")
    ours = tm.subdivide(sample.keyframes, sample.faces, 2)
    places = tm.keyframe_places(2, 2)
    first, last = sample.keyframes[:1], sample.keyframes[1:]
    rows = {
        "torch_modal": ours,
        "linear": tm.linear_sequence(sample.keyframes, places),
        "truth": torch.cat([first, sample.truth, last]),
    }
    return tm.write_page(
        rows, sample.faces, folder / "hand.html", keyframe_indices=places, fps=4, view=sample.view, title="Closing hand"
    )


def creature(folder: Path) -> Path:
    """Two strides of the creature beside linear interpolation."""
    sample = load_sample("creature")
    keyframes = sample.keyframes[:3]
    places = tm.keyframe_places(3, 3)
    rows = {
        "torch_modal": tm.subdivide(keyframes, sample.faces, 3),
        "linear": tm.linear_sequence(keyframes, places),
    }
    return tm.write_page(
        rows, sample.faces, folder / "gallop.html", keyframe_indices=places, view=sample.view, title="Gallop"
    )


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[2] / "docs" / "images", metavar="FOLDER")
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder, open_browser(1240, 760) as chrome:
        from selenium.webdriver.common.actions.action_builder import ActionBuilder

        open_page(chrome, hand(Path(folder)))
        chrome.execute_script("torchModal.seek(2)")
        save(chrome, out / "page.png")
        choose(chrome, "measure", "strain")
        save(chrome, out / "page-strain.png")

        open_page(chrome, creature(Path(folder)))
        chrome.execute_script("torchModal.seek(12)")
        chrome.find_element("css selector", "#layout button[value=over]").click()
        chrome.find_element("id", "wireframe").click()
        time.sleep(1.0)
        for x, y in ((0.27, 0.26), (0.74, 0.3), (0.6, 0.83)):
            canvas = chrome.find_element("id", "canvas").rect
            builder = ActionBuilder(chrome)
            place = (canvas["x"] + x * canvas["width"], canvas["y"] + y * canvas["height"])
            builder.pointer_action.move_to_location(*map(round, place)).click()
            builder.perform()
        save(chrome, out / "page-picked.png")


if __name__ == "__main__":
    main()
