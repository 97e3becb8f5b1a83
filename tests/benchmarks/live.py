"""How many shapes a second a live session shows while something is dragged.

    python tests/benchmarks/live.py [--seconds 5]

The sample creature with its longest edges split to 8,000 vertices. What is timed is all that an update does but the
sending: the modal solve of the fast preset, and with local steps the accurate one, which follows at rest. Times are
medians and the least; other work on the machine makes the first larger. The last column is the median over that of
the accurate shape.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from page import VERTICES, split_edges

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.view.live_shapes import LiveShapes


def milliseconds(function: Callable[[int], object], seconds: float) -> list[float]:
    """Times of calls, after two that do not count; each is told its number."""
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 5 or time.perf_counter() < end:
        start = time.perf_counter()
        function(len(times))
        times.append(1000 * (time.perf_counter() - start))
    return times[2:]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="for each row")
    seconds = parser.parse_args().seconds

    sample = load_sample("creature")
    split, faces = split_edges(sample.keyframes[:2].numpy(), sample.faces.numpy(), VERTICES)
    keyframes, triangles = torch.from_numpy(split), torch.from_numpy(faces)
    shapes = LiveShapes(keyframes, triangles, tm.extract_bases(keyframes, triangles, 30))
    vertex = int(keyframes[0, :, 1].argmin())
    start = keyframes[0, vertex].clone()
    size = float((keyframes[0].amax(0) - keyframes[0].amin(0)).norm())

    def at(number: int) -> float:
        return 0.1 + 0.8 * (number * 0.37 % 1)

    def handle(number: int) -> object:
        shapes.set_handles(0, {vertex: start + 0.05 * size * at(number)})
        return shapes.shape(0.5).numpy().astype(np.float32)

    def stiffness(number: int) -> object:
        shapes.set_stiffness(1.0, 10 ** (2 * at(number) - 1), 1.0)
        return shapes.shape(0.5).numpy().astype(np.float32)

    rows: dict[str, Callable[[int], object]] = {
        "at rest": lambda number: shapes.shape(at(number), accurate=True).numpy().astype(np.float32),
        "time": lambda number: shapes.shape(at(number)).numpy().astype(np.float32),
        "handle": handle,
        "stiffness": stiffness,
    }
    print(f"{keyframes.shape[1]} vertices, torch {torch.__version__}, {torch.get_num_threads()} threads")
    print(f"{'dragged':<12}{'median ms':>10}{'a second':>10}{'least ms':>10}{'a second':>10}{'/ at rest':>11}")
    base = 0.0
    for name, function in rows.items():
        times = milliseconds(function, seconds)
        median, least = statistics.median(times), min(times)
        base = base or median
        print(
            f"{name:<12}{median:>10.1f}{1000 / median:>10.0f}{least:>10.1f}{1000 / least:>10.0f}{median / base:>11.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
