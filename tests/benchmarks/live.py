"""How many shapes a second a live session shows while something is dragged.

    python tests/benchmarks/live.py [--seconds 5]

The sample creature with its longest edges split to 8,000 vertices. What is timed is all that an update does but the
sending: the modal solve of the fast preset, and with local steps the accurate one, which follows at rest. Times are
medians: of the clock, which other work on the machine makes larger, and of the processor, which is what an update would
take on a quiet one if it runs on one thread. The last column is the processor's over that of the accurate shape.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from page import VERTICES, split_edges

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.view.live_shapes import LiveShapes


def milliseconds(function: Callable[[int], object], seconds: float) -> tuple[float, float]:
    """Median times of calls, of the clock and of the processor; two do not count, each is told its number."""
    clock: list[float] = []
    processor: list[float] = []
    end = time.perf_counter() + seconds
    while len(clock) < 7 or time.perf_counter() < end:
        starts = time.perf_counter(), time.process_time()
        function(len(clock))
        clock.append(1000 * (time.perf_counter() - starts[0]))
        processor.append(1000 * (time.process_time() - starts[1]))
    return statistics.median(clock[2:]), statistics.median(processor[2:])


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
    print(f"{'dragged':<12}{'clock ms':>10}{'a second':>10}{'cpu ms':>10}{'a second':>10}{'/ at rest':>11}")
    base = 0.0
    for name, function in rows.items():
        clock, processor = milliseconds(function, seconds)
        base = base or processor
        print(
            f"{name:<12}{clock:>10.1f}{1000 / clock:>10.0f}{processor:>10.1f}{1000 / processor:>10.0f}"
            f"{processor / base:>11.2f}",
            flush=True,
        )
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")


if __name__ == "__main__":
    main()
