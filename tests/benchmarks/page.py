"""Size and speed of a page of shapes, and the pictures of docs/viewing.md.

    python tests/benchmarks/page.py [--repeats 3]
    python tests/benchmarks/page.py --pictures docs/images

The sample creature: 33 shapes of one interval, and 193 of it there and back six times (by which nothing is saved),
alone and beside linear interpolation. Sizes are also given in relation to the positions as float32 in base64. Loading
is from the navigation to the first picture, in the page's own clock. While the page plays, pictures a second are
counted, and the milliseconds that the page's scripts take for each. The browser draws in software: with a graphics
card, the scripts are what is left.
"""

from __future__ import annotations

import argparse
import io
import statistics
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

LEVELS = 5  # 32 intervals between two key-frames
SECONDS = 4.0


def play(chrome: Chrome) -> tuple[float, float]:
    """Pictures drawn in a second while the page plays, and milliseconds that its scripts take for each."""
    chrome.find_element("id", "play").click()
    time.sleep(0.5)
    script = "return [torchModal.drawn, torchModal.busy, performance.now()]"
    before = chrome.execute_script(script)
    time.sleep(SECONDS)
    drawn, busy, milliseconds = (end - start for start, end in zip(before, chrome.execute_script(script), strict=True))
    return 1000 * drawn / milliseconds, busy / drawn


def measure(repeats: int, folder: Path) -> None:
    """Print the table."""
    sample = load_sample("creature")
    keyframes = sample.keyframes[:2]
    ours = tm.subdivide(keyframes, sample.faces, LEVELS)
    linear = tm.linear_sequence(keyframes, tm.keyframe_places(2, LEVELS))
    there_and_back = [*range(len(ours)), *range(len(ours) - 2, 0, -1)]
    way = [*(3 * there_and_back), 0]
    pages = {
        f"{len(ours)} shapes": {"a": ours},
        f"{len(ours)} shapes, with linear": {"a": ours, "b": linear},
        f"{len(way)} shapes": {"a": ours[way]},
        f"{len(way)} shapes, with linear": {"a": ours[way], "b": linear[way]},
    }
    print(f"{ours.shape[1]} vertices\n{'page':<26}{'MB':>7}{'/ float32':>11}{'load s':>8}{'a second':>10}{'ms':>7}")
    for name, sequences in pages.items():
        path = tm.show(sequences, sample.faces, view=sample.view).save(folder / "page.html", overwrite=True)
        loads = []
        for _ in range(repeats):
            with open_browser(1280, 720) as chrome:
                loads.append(open_page(chrome, path) / 1000)
                rate, busy = play(chrome)
        size = path.stat().st_size
        plain = sum(4 / 3 * 4 * frames.numel() for frames in sequences.values())
        load = statistics.median(loads)
        print(f"{name:<26}{size / 1e6:>7.2f}{size / plain:>11.2f}{load:>8.2f}{rate:>10.0f}{busy:>7.2f}", flush=True)


def save(chrome: Chrome, path: Path) -> None:
    """Save the window as it is, when all is drawn."""
    time.sleep(2.0)
    Image.open(io.BytesIO(chrome.get_screenshot_as_png())).convert("RGB").save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def draw(out: Path, folder: Path) -> None:
    """Draw the closing hand beside linear interpolation and the truth, and the gallop overlaid, with trails."""
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    hand, creature = load_sample("hand"), load_sample("creature")
    places = tm.keyframe_places(2, 2)
    rows = {
        "torch_modal": tm.subdivide(hand.keyframes, hand.faces, 2),
        "linear": tm.linear_sequence(hand.keyframes, places),
        "truth": torch.cat([hand.keyframes[:1], hand.truth, hand.keyframes[1:]]),
    }
    closing = tm.show(rows, hand.faces, keyframe_indices=places, view=hand.view, title="Closing hand")
    keyframes, places = creature.keyframes[:3], tm.keyframe_places(3, 3)
    rows = {
        "torch_modal": tm.subdivide(keyframes, creature.faces, 3),
        "linear": tm.linear_sequence(keyframes, places),
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
    """Measure, or draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3, help="loads of each page; the median counts")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the pictures there instead")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.pictures:
            draw(arguments.pictures, Path(folder))
        else:
            measure(arguments.repeats, Path(folder))


if __name__ == "__main__":
    main()
