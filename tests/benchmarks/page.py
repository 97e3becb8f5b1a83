"""What a page of shapes weighs, how long it takes to load, and how many frames a second it draws.

    python tests/benchmarks/page.py [--repeats 3] [--size 1280 720]

The sample creature, its longest edges split to 8,000 vertices: 33 shapes of one interval, and 193 of it there and back
six times (by which nothing is saved), alone and beside linear interpolation. Sizes are also given in relation to the
positions as float32 in base64. Loading is from the navigation to the first picture, in the page's own clock, and beside
that of a page of one tetrahedron, which is what the browser and its graphics need. Frames a second are counted while
the page plays, with nothing coloured and with edge strain, and ms are what the page's scripts take for each. The
browser draws in software, on the processor's cores: with a graphics card, the scripts are what is left.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[1]))  # beside the tests
from browsers import find_browser, open_browser, open_page

import torch_modal as tm
from torch_modal.data.samples import load_sample

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

VERTICES = 8000
LEVELS = 5  # 32 intervals between two key-frames
SECONDS = 4.0


def split_edges(frames: NDArray[np.float64], faces: NDArray[np.int64], n_vertices: int) -> tuple[NDArray, NDArray]:
    """Split long edges in the middle, at most one of each face, until there are so many vertices."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    lengths = np.linalg.norm(frames[0, edges[:, 0]] - frames[0, edges[:, 1]], axis=1)
    around: dict[tuple[int, int], list[int]] = {}
    for number, (a, b, c) in enumerate(faces.tolist()):
        for pair in ((a, b), (b, c), (c, a)):
            around.setdefault((min(pair), max(pair)), []).append(number)
    middles, whole, parts = [], np.ones(len(faces), dtype=bool), []
    for a, b in edges[np.argsort(-lengths)].tolist():
        mine = around[(a, b)]
        if len(middles) == n_vertices - frames.shape[1] or not whole[mine].all():
            continue
        new = frames.shape[1] + len(middles)
        middles.append((a, b))
        whole[mine] = False
        for face in faces[mine].tolist():
            parts += [[new if v == b else v for v in face], [new if v == a else v for v in face]]
    ends = np.array(middles)
    added = 0.5 * (frames[:, ends[:, 0]] + frames[:, ends[:, 1]])
    return np.concatenate([frames, added], axis=1), np.concatenate([faces[whole], np.array(parts)])


def play(chrome: Chrome, seconds: float = SECONDS) -> tuple[float, float]:
    """Pictures drawn in a second while the page plays, and milliseconds that its scripts take for each."""
    button = chrome.find_element("id", "play")
    button.click()
    time.sleep(0.5)
    script = "return [torchModal.drawn, torchModal.busy, performance.now()]"
    before = chrome.execute_script(script)
    time.sleep(seconds)
    drawn, busy, milliseconds = (end - start for start, end in zip(before, chrome.execute_script(script), strict=True))
    button.click()
    return 1000 * drawn / milliseconds, busy / drawn


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3, help="loads of each page; the median counts")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar="PIXELS", help="of the window")
    arguments = parser.parse_args()
    find_browser()

    sample = load_sample("creature")
    keyframes = sample.keyframes[:2]
    bases = tm.extract_bases(keyframes, sample.faces, 30)
    rows = [
        tm.subdivide(keyframes, sample.faces, LEVELS, bases=bases),
        tm.linear_sequence(keyframes, tm.keyframe_places(2, LEVELS)),
    ]
    split = [split_edges(frames.numpy(), sample.faces.numpy(), VERTICES) for frames in rows]
    ours, linear = (torch.from_numpy(frames) for frames, _ in split)
    faces = torch.from_numpy(split[0][1])
    print(f"{ours.shape[1]} vertices, {len(faces)} faces; window {arguments.size[0]} x {arguments.size[1]}")

    short = len(ours)
    there_and_back = [n if n < short else 2 * (short - 1) - n for n in range(2 * (short - 1))]
    way = [*(3 * there_and_back), 0]
    corners = torch.eye(4, 3, dtype=torch.float64) * torch.linspace(1, 2, short)[:, None, None]
    sides = torch.tensor([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    pages = {
        "tetrahedron": ({"a": corners}, sides),
        f"{short} shapes": ({"a": ours}, faces),
        f"{short} shapes, with linear": ({"a": ours, "b": linear}, faces),
        f"{len(way)} shapes": ({"a": ours[way]}, faces),
        f"{len(way)} shapes, with linear": ({"a": ours[way], "b": linear[way]}, faces),
    }
    header = (
        ("MB", 7),
        ("/ float32", 11),
        ("write s", 9),
        ("load s", 8),
        ("/ tetr.", 9),
        ("fps", 6),
        ("ms", 7),
        ("strain fps", 12),
        ("ms", 7),
    )
    print(f"{'page':<26}" + "".join(f"{name:>{width}}" for name, width in header))
    base = None
    with tempfile.TemporaryDirectory() as folder:
        for name, (sequences, triangles) in pages.items():
            start = time.perf_counter()
            path = tm.write_page(sequences, triangles, Path(folder, "page.html"), view=sample.view, overwrite=True)
            written = time.perf_counter() - start
            loads = []
            for _ in range(arguments.repeats):
                with open_browser(*arguments.size) as chrome:
                    loads.append(open_page(chrome, path) / 1000)
                    if len(loads) < arguments.repeats:
                        continue
                    rates = []
                    for measure in ("", "strain"):
                        chrome.execute_script(
                            "const s = document.getElementById('measure'); s.value = arguments[0];"
                            "s.dispatchEvent(new Event('change'))",
                            measure,
                        )
                        time.sleep(1.0)
                        rates += play(chrome)
            load = statistics.median(loads)
            base = base or load
            plain = sum(4 / 3 * 4 * frames.numel() for frames in sequences.values())
            size = path.stat().st_size
            print(
                f"{name:<26}{size / 1e6:>7.2f}{size / plain:>11.2f}{written:>9.2f}{load:>8.2f}{load / base:>9.2f}"
                f"{rates[0]:>6.0f}{rates[1]:>7.2f}{rates[2]:>12.0f}{rates[3]:>7.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
