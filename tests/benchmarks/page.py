"""Sizes of a page of shapes, and the pictures of docs/viewing.md.

    python tests/benchmarks/page.py [--only hand]
    python tests/benchmarks/page.py --pictures docs/images

A sample's first two key-frames, subdivided into 33 shapes.
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
from results import Table, add_keep

sys.path.append(str(Path(__file__).parents[1]))  # beside the tests
from helpers.browsers import open_browser, open_page

import torch_modal as tm
from torch_modal.data.samples import SAMPLES, load_sample
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

LEVELS = 5  # 32 intervals between two key-frames


def measure(name: str, folder: Path) -> list[str]:
    """A line of the table."""
    sample = load_sample(name)
    shapes = tm.interpolate(sample.keyframes[:2], sample.faces, LEVELS)
    path = tm.show(shapes, sample.faces).save(folder / "page.html")
    return [f"{name}, {len(shapes)} shapes of {shapes.shape[1]:,} vertices", f"{path.stat().st_size / 1e6:.2f} MB"]


def save(chrome: Chrome, path: Path) -> None:
    """Save the window as it is, when all is drawn."""
    time.sleep(2.0)
    Image.open(io.BytesIO(chrome.get_screenshot_as_png())).convert("RGB").save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def draw(out: Path, folder: Path) -> None:
    """Draw the closing hand beside linear interpolation and the truth, and the gallop overlaid, with trails."""
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    hand, creature = load_sample("hand"), load_sample("creature")
    places = keyframe_places(2, 2)
    rows = {
        "torch_modal": tm.interpolate(hand.keyframes, hand.faces, 2),
        "linear": fill_linear(hand.keyframes, places),
        "truth": torch.cat([hand.keyframes[:1], hand.truth, hand.keyframes[1:]]),
    }
    closing = tm.show(rows, hand.faces, keyframe_indices=places, view=hand.view, title="Closing hand")
    keyframes, places = creature.keyframes[:3], keyframe_places(3, 3)
    rows = {
        "torch_modal": tm.interpolate(keyframes, creature.faces, 3),
        "linear": fill_linear(keyframes, places),
    }
    gallop = tm.show(rows, creature.faces, keyframe_indices=places, view=creature.view, title="Gallop")
    with open_browser(1240, 760) as chrome:
        open_page(chrome, closing.save(folder / "hand.html"))
        chrome.execute_script("torchModal.seek(2)")
        save(chrome, out / "page.png")
        open_page(chrome, gallop.save(folder / "gallop.html"))
        chrome.execute_script("torchModal.seek(12)")
        chrome.find_element("css selector", "#layout button[value=over]").click()
        chrome.find_element("id", "wireframe").click()
        time.sleep(1.0)
        canvas = chrome.find_element("id", "canvas").rect
        for x, y in ((0.27, 0.26), (0.765, 0.345), (0.545, 0.84)):
            builder = ActionBuilder(chrome)
            place = (canvas["x"] + x * canvas["width"], canvas["y"] + y * canvas["height"])
            builder.pointer_action.move_to_location(*map(round, place)).click()
            builder.perform()
        save(chrome, out / "page-picked.png")


def main() -> None:
    """Print and keep the table, or draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(SAMPLES), choices=list(SAMPLES))
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the pictures there instead")
    add_keep(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if given.pictures:
            draw(given.pictures, Path(folder))
            return
        with Table("page", ["", "size"], given.keep, check="--only hand") as table:
            for name in given.only:
                table.add(*measure(name, Path(folder)))


if __name__ == "__main__":
    main()
