"""How long one in-between takes: as ratios to linear interpolation and to one call of the mesher, and in ms.

    python tests/benchmarks/in_between.py [--repeats 20] [--skip-mesher]

One in-between is a whole `MidShape.solve` with the bases given: 30 + 30 modes, 1,000 coarse faces, from the key-frames
to the fine shape, the modes alone added to linear interpolation, to the last digit (`presets.py` has the presets).
Linear interpolation is one `lerp` of the same vertices. The mesher is a bare `pytetwild.tetrahedralize` of the first
key-frame, in a process of its own, without its imports. Times are medians.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from cases import Case, hand_path, samples, women
from measures import Yardstick
from methods import BARE, linear

import torch_modal as tm

MESHER = """
import sys, time
import numpy as np
import pytetwild
mesh = np.load(sys.argv[1])
start = time.perf_counter()
pytetwild.tetrahedralize(mesh["vertices"], mesh["faces"], edge_length_fac=0.03, epsilon=2e-3)
print("seconds", time.perf_counter() - start)
"""


def median_seconds(function: Callable[[], object], repeats: int) -> float:
    """Median time of a call, after two that do not count."""
    times = []
    for i in range(repeats + 2):
        start = time.perf_counter()
        function()
        if i >= 2:
            times.append(time.perf_counter() - start)
    return statistics.median(times)


def mesher_seconds(case: Case) -> float:
    """One bare call in a child process, as it may crash and keeps threads."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.npz"
        np.savez(path, vertices=case.x_a.numpy(), faces=case.faces.numpy().astype(np.int32))
        command = [sys.executable, "-c", MESHER, str(path)]
        result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600, cwd=folder)
    return float(result.stdout.split("seconds")[-1].split()[0])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--skip-mesher", action="store_true")
    arguments = parser.parse_args()

    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads, medians of {arguments.repeats} repeats")
    columns = (
        ("V", 7),
        ("steps", 7),
        ("energy/linear", 15),
        ("ms", 9),
        ("x linear", 10),
        ("mesher s", 10),
        ("/ mesher", 10),
    )
    print(f"{'case':<20}" + "".join(f"{name:>{width}}" for name, width in columns))
    mesher: dict[tuple[int, float], float] = {}
    for case in chain(hand_path(), women(), samples()):
        layer = tm.MidShape(case.bases(), case.faces, **BARE)
        yardstick = Yardstick(case)
        with torch.no_grad():
            shape, solution = layer.solve(case.x_a, case.x_b)
            seconds = median_seconds(lambda: layer.solve(case.x_a, case.x_b), arguments.repeats)  # noqa: B023
            straight = median_seconds(lambda: torch.lerp(case.x_a, case.x_b, 0.5), 50 * arguments.repeats)  # noqa: B023
            gain = yardstick.energy(shape) / yardstick.energy(linear(case).frames[0])
        row = f"{case.name:<20}{len(case.x_a):>7}{int(solution.n_steps):>7}{gain:>15.3f}"
        row += f"{1e3 * seconds:>9.1f}{seconds / straight:>10.0f}"
        if not arguments.skip_mesher:
            key = (len(case.x_a), float(case.x_a.sum()))
            if key not in mesher:
                mesher[key] = mesher_seconds(case)
            row += f"{mesher[key]:>10.2f}{seconds / mesher[key]:>10.4f}"
        print(row + ("" if solution.converged else "  NOT CONVERGED"), flush=True)


if __name__ == "__main__":
    main()
