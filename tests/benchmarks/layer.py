"""How fast :class:`torch_modal.InBetween` is in a batch, forward and backward, and what its gradient costs in memory.

    python tests/benchmarks/layer.py
    python tests/benchmarks/layer.py --device cuda --dtype float32 float64 --batches 1 4 16 64 256 1024

Everything compared is measured in one run, in turns, so that a busy machine slows both sides; what to read are the
ratios. The reference of a batch is a loop of single calls over the same samples. Each sample has key-frames and a time
of its own. 30 + 30 and 50 + 50 modes make 60 and 100 unknowns; dependent modes are dropped. What is timed is the modal
solve with what it starts from (local_steps=0); ``--preset`` times that of a name instead.

On a machine that others use too, threads wait for each other, small calls the most: the loop then looks bad without
being so. ``--threads 1 --cpu-time`` counts the time of the processor instead of the clock's.
"""

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from threads import limit_threads
from torch import Tensor

import torch_modal as tm

SAMPLE = Path(tm.__file__).parent / "samples" / "hand"
DTYPES = {"float32": torch.float32, "float64": torch.float64}


class Case:
    """A layer with samples to put through it."""

    def __init__(self, modes: int, batch: int, dtype: torch.dtype, arguments: argparse.Namespace) -> None:
        keyframes, faces = tm.load_keyframes([SAMPLE / "key-0.ply", SAMPLE / "key-1.ply"])
        bases = [basis.truncate(modes) for basis in tm.extract_bases(keyframes, faces, n_modes=50)]
        if arguments.preset:
            layer = tm.InBetween(bases, faces, arguments.preset)
        else:
            objective = tm.Objective(coarse_faces=arguments.coarse_faces)
            layer = tm.InBetween(bases, faces, objective=objective, solver=tm.Solver(local_steps=0))
        self.layer = layer.to(arguments.device, dtype)
        generator = torch.Generator().manual_seed(0)
        times = torch.rand(batch, generator=generator, dtype=torch.float64) * 0.8 + 0.1
        ends = []
        for x, basis in zip(keyframes, bases, strict=True):
            # Each key-frame moves along its five softest modes.
            softest = basis.modes[:5] / basis.modes[:5].flatten(1).norm(dim=1)[:, None, None]
            push = torch.randn(batch, len(softest), generator=generator, dtype=torch.float64)
            size = arguments.spread * (x.amax(0) - x.amin(0)).norm() * (len(x) / len(softest)) ** 0.5
            ends.append(x + size * torch.tensordot(push, softest, 1))
        self.samples = [value.to(arguments.device, dtype) for value in (*ends, times)]

    def part(self, rows: slice) -> list[Tensor]:
        """Some samples, as leaves of a graph."""
        return [value[rows].clone().requires_grad_() for value in self.samples]


def clock(arguments: argparse.Namespace, run: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds, and what came out."""
    now = time.process_time if arguments.cpu_time else time.perf_counter
    if arguments.device == "cuda":
        torch.cuda.synchronize()
    start = now()
    out = run()
    if arguments.device == "cuda":
        torch.cuda.synchronize()
    return now() - start, out


def there_and_back(case: Case, rows: slice, arguments: argparse.Namespace) -> tuple[float, float, float]:
    """Seconds of a forward pass alone, of one that is recorded, and of its backward pass."""
    inputs = case.part(rows)
    with torch.no_grad():
        alone, _ = clock(arguments, lambda: case.layer(*inputs))
    recorded, shapes = clock(arguments, lambda: case.layer(*inputs))
    weights = torch.linspace(-1, 1, shapes[0].numel(), dtype=shapes.dtype, device=shapes.device).view_as(shapes[0])
    backward, _ = clock(arguments, lambda: torch.autograd.grad((shapes * weights).sum(), inputs))
    return alone, recorded, backward


def speed(arguments: argparse.Namespace, modes: int, dtype_name: str) -> None:
    """Print a table over batch sizes."""
    device, batches = arguments.device, sorted(arguments.batches)
    case = Case(modes, batches[-1], DTYPES[dtype_name], arguments)
    layer, n_single = case.layer, min(batches[-1], arguments.singles)
    energy: Any = layer.core.space
    solution = layer.solve(*case.samples).solution
    lost = int((~solution.usable).sum())
    mean_steps = float(solution.n_steps.double().mean())
    print(
        f"\n{modes}+{modes} modes ({energy.n_amplitudes} unknowns), {arguments.coarse_faces} coarse faces, "
        f"{dtype_name}, {device}: {mean_steps:.1f} steps a sample on average, {int(solution.n_steps.max())} at most"
        + (f", {lost} of {batches[-1]} not converged" if lost else "")
    )
    there_and_back(case, slice(0, 2), arguments)  # warm-up

    loop: list[list[tuple[float, float, float]]] = []
    found: dict[int, list[tuple[float, float, float]]] = {n: [] for n in batches}
    for _ in range(arguments.repeats):
        loop.append([there_and_back(case, slice(i, i + 1), arguments) for i in range(n_single)])
        for n in batches:
            found[n].append(there_and_back(case, slice(0, n), arguments))

    print("  ms per in-between, median; x: throughput over the loop of single calls, same samples, same run")
    print("  batch   forward    x    fwd+bwd    x   backward/forward")
    for n in batches:
        alone, recorded, backward = (1e3 * median(column) / n for column in zip(*found[n], strict=True))
        # A loop over more samples than are measured one by one takes in proportion.
        singles = [row[: min(n, n_single)] for row in loop]
        forward_gain, both_gain = (
            median(
                sum(cost(one) for one in single) / len(single) * n / cost(batch)
                for single, batch in zip(singles, found[n], strict=True)
            )
            for cost in (lambda s: s[0], lambda s: s[1] + s[2])
        )
        ratio = median(b / r for _, r, b in found[n])
        print(f"  {n:5d} {alone:9.2f} {forward_gain:5.2f} {recorded + backward:9.2f} {both_gain:5.2f} {ratio:12.2f}")
    print(f"  load average of the machine now: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def memory(arguments: argparse.Namespace) -> None:
    """Print what a gradient holds in memory over the number of steps."""
    batch, limits = 4, (1, 2, 4, 8, 16)
    print(f"\nMemory of forward and backward, MiB above what is there before, batch of {batch}, 30+30 modes, float64")
    print("  max_steps   " + "".join(f"{n:8d}" for n in limits))
    for gradient in ("implicit", "unroll"):
        found = [_memory_of(arguments, gradient, n, batch) for n in limits]
        print(f"  {gradient:11s} " + "".join(f"{value:8.0f}" for value in found))


def _memory_of(arguments: argparse.Namespace, gradient: str, max_steps: int, batch: int) -> float:
    """In a process of its own: a peak never falls again."""
    options = ["--device", arguments.device, "--coarse-faces", str(arguments.coarse_faces)]
    options += ["--preset", arguments.preset] if arguments.preset else []
    command = [sys.executable, __file__, *options, "--probe", gradient, str(max_steps), str(batch)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the memory of {gradient} could not be measured:\n{done.stderr}")
    return float(done.stdout.split()[-1])


def probe(arguments: argparse.Namespace) -> None:
    """Print the peak of one forward and backward pass, in MiB above what was there before."""
    gradient, max_steps, batch = arguments.probe[0], *map(int, arguments.probe[1:])
    case = Case(30, batch, torch.float64, arguments)
    layer = case.layer
    inputs = case.part(slice(0, batch))
    cuda = arguments.device == "cuda"

    def peak() -> float:
        return torch.cuda.max_memory_allocated() / 2**20 if cuda else _resident_peak()

    # What is loaded and set up on first use is not the gradient's.
    small = case.part(slice(0, 1))
    limit(layer, gradient, 1)
    layer.solve(*small).shapes.sum().backward()
    limit(layer, gradient, max_steps)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated() / 2**20 if cuda else _resident_peak(reset=True)
    layer.solve(*inputs).shapes.sum().backward()
    print(peak() - before)


def limit(layer: tm.InBetween, gradient: str, max_steps: int) -> None:
    """Other settings in a layer that stands."""
    layer.solver = layer.core.solver = replace(layer.solver, gradient=gradient, max_steps=max_steps)


def _resident_peak(reset: bool = False) -> float:
    """Peak of resident memory in MiB; since the last reset where Linux lets us."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
        return float(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 2**10
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--dtype", nargs="+", default=["float64"], choices=tuple(DTYPES))
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 2, 4, 8, 16, 32, 64])
    parser.add_argument("--modes", nargs="+", type=int, default=[30, 50], help="of each key-frame, at most 50")
    parser.add_argument("--coarse-faces", type=int, default=1000)
    parser.add_argument("--preset", choices=("accurate", "fast"), help="instead of the modal solve alone")
    spread_help = "how far the key-frames of the samples differ (root mean square), in bounding-box diagonals"
    parser.add_argument("--spread", type=float, default=0.003, help=spread_help)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--singles", type=int, default=64, help="samples of the loop that are measured one by one")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cpu-time", action="store_true", help="processor time; with one thread only")
    parser.add_argument("--no-memory", action="store_true")
    parser.add_argument("--probe", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    limit_threads(arguments.threads)
    if arguments.cpu_time and (arguments.device == "cuda" or arguments.threads > 1):
        parser.error("--cpu-time counts all threads together: it needs --device cpu and --threads 1")
    if arguments.probe:
        probe(arguments)
        return
    name = torch.cuda.get_device_name() if arguments.device == "cuda" else f"{torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {name}; load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    for dtype_name in arguments.dtype:
        for modes in arguments.modes:
            speed(arguments, modes, dtype_name)
    if not arguments.no_memory:
        memory(arguments)


if __name__ == "__main__":
    main()
