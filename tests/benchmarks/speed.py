"""How fast in-betweens are: over morphomatics, or over another version of this package.

    python tests/benchmarks/speed.py [--peer-python FILE] [--rounds 2] [--only TEXT ...]
    python tests/benchmarks/speed.py --before CHECKOUT
    python tests/benchmarks/speed.py --parts blends first
    python tests/benchmarks/speed.py --parts batches [--device cuda] [--threads 16]
    python tests/benchmarks/speed.py --parts threads [--rounds 10]

Each side runs in processes of its own, on one thread, in turns; what is told are ratios of processor seconds, the best
of all rounds, so that what else a machine does slows all sides. In-betweens, with gradients too, are over theirs
without; making a layer is over the set-up of their shape space. ``--before`` names the folder of another checkout, for
example of an earlier commit, which each column is then compared with. Bases are there before the clock starts, but for
``--parts first``: from two new key-frames to a sequence with nothing cached, on the clock. ``--parts batches`` compares
batches, forward and with their gradients, with single calls, and a GPU with the CPU of the same machine; ``--parts
blends`` a blend of six key-frames with a pair. ``--parts threads`` compares two threads with one, in turns, on the
clock: more rounds find the quiet moments of a machine.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from cases import Case, KeyframeSet, divided, samples, shared
from methods import by_peer
from results import ROOT, Table, add_keep, geometric_mean, wanted
from timing import limit_threads, timed

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.inbetween.settings import PRESETS

WORK = (
    *("whole", "fast", "modal", "torch alone"),
    *("forward and backward", "fast, forward and backward", "making a layer"),
)
DIVIDED = ("sample creature", "mh-hand", "mh-woman")


def all_cases() -> dict[str, Case]:
    """One case of each mesh, and some with triangles divided in four."""
    meshes: dict[int, Case] = {}
    for case in [*samples(), *shared()]:
        meshes.setdefault(len(case.x_a), case)
    cases = [case for case in meshes.values() if len(case.x_a) > 1000]
    for case in [case for case in cases if case.name.startswith(DIVIDED)]:
        ends, faces = divided(torch.stack([case.x_a, case.x_b]), case.faces)
        cases.append(Case(f"{case.name}, divided", KeyframeSet(ends, faces), 0, 1, {}))
    return {case.name: case for case in cases if len(case.x_a) > 2000}


def layers(case: Case) -> dict[str, Callable[[], tm.InBetween]]:
    """The layers that are compared, to be made."""
    bases = case.bases()
    options: dict[str, dict[str, Any]] = {
        "whole": {},
        "fast": {"preset": "fast"},
        "modal": {"preset": "modal"} if "modal" in PRESETS else {},  # the former default
        "torch alone": {"solver": tm.Solver(backend="torch")},
    }
    return {name: partial(tm.InBetween, bases, case.faces, **own) for name, own in options.items()}


def worker(name: str, answer: str) -> None:
    """Seconds of one side of one case."""
    limit_threads()
    case = all_cases()[name]
    makes, half = layers(case), torch.tensor(0.5, dtype=torch.float64)

    def backward(layer: tm.InBetween) -> torch.Tensor:
        leaf = case.x_a.clone().requires_grad_()
        (found,) = torch.autograd.grad(layer(leaf, case.x_b, half).square().sum(), leaf)
        return found

    whole, fast = makes["whole"](), makes["fast"]()
    found = {
        "forward and backward": timed(lambda: backward(whole))[1],
        "fast, forward and backward": timed(lambda: backward(fast))[1],
        "making a layer": timed(makes["whole"])[1],
    }
    for part, make in makes.items():
        layer = make()
        with torch.no_grad():
            found[part] = timed(lambda: layer(case.x_a, case.x_b, half))[1]  # noqa: B023
    Path(answer).write_text(json.dumps(found))


def run(name: str, root: Path) -> dict[str, float]:
    """A worker in a process of its own, with the package of a checkout."""
    with tempfile.TemporaryDirectory() as scratch:
        answer = Path(scratch) / "answer.json"
        command = [sys.executable, __file__, "--worker", name, str(answer)]
        environment = {**os.environ, "PYTHONPATH": str(root)}
        subprocess.run(command, check=True, env=environment, stderr=subprocess.DEVNULL)
        return json.loads(answer.read_text())


def theirs(case: Case) -> dict[str, float]:
    """Their seconds for each column."""
    found = by_peer(case.at([0.5]))
    return dict.fromkeys(WORK, found.seconds) | {"making a layer": found.making}


def compare(given: argparse.Namespace) -> None:
    """Ratios of all meshes, and their geometric means."""
    own, means = ROOT, []
    kept = "speed" if given.before is None else "speed-before"
    with Table(kept, ["mesh", "vertices", *WORK], given.keep, WORK) as table:
        for name, case in all_cases().items():
            if not wanted(name, given.only):
                continue
            ours, others = {}, {}
            for _ in range(given.rounds):
                other = theirs(case) if given.before is None else run(name, given.before)
                for best, found in ((ours, run(name, own)), (others, other)):
                    best.update({part: min(found[part], best.get(part, math.inf)) for part in WORK})
            ratios = [ours[part] / others[part] for part in WORK]
            means.append(ratios)
            table.add(name, f"{len(case.x_a):,}", *(f"{ratio:.3f}" for ratio in ratios))
        table.add("geometric mean", "", *(f"{geometric_mean(list(each)):.3f}" for each in zip(*means, strict=True)))


def blends(arguments: argparse.Namespace) -> None:
    """A weighted in-between of six key-frames over one of two, without gradients and with them."""
    limit_threads()
    x, faces = load_sample("creature")[:2]
    bases, weights = tm.extract_bases(x, faces), torch.full((len(x),), 1 / len(x), dtype=torch.float64)
    blend, pair = tm.Blend(bases, faces), tm.InBetween([bases[0], bases[-1]], faces)
    works: list[Callable[[torch.Tensor], torch.Tensor]] = [
        lambda x: blend(x, weights),
        lambda x: pair(x[0], x[-1], 0.5),
    ]
    with torch.no_grad():
        six, two = (timed(lambda: work(x))[1] for work in works)  # noqa: B023
    leaf = x.clone().requires_grad_()
    back_six, back_two = (timed(lambda: work(leaf).square().sum().backward())[1] for work in works)  # noqa: B023
    print(f"Blend of {len(x)} over InBetween: {six / two:.1f}, with gradients {back_six / back_two:.1f}")


def batches(arguments: argparse.Namespace) -> None:
    """Milliseconds of each in-between of batches at random times, on the clock: on a CPU, and on a GPU."""
    times = torch.rand(64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    devices = ["cpu"] if arguments.device == "cpu" else ["cpu", arguments.device]

    def clock(work: Callable[[], Any], device: str) -> float:
        found = []
        for _ in range(arguments.rounds + 1):
            start = time.perf_counter()
            work()
            if device != "cpu":
                torch.cuda.synchronize()
            found.append(time.perf_counter() - start)
        return min(found[1:])

    def trained(layer: tm.InBetween, both: torch.Tensor, t: torch.Tensor) -> None:
        layer(*both.clone().requires_grad_(), t).square().sum().backward()

    limit_threads(arguments.threads)
    hand = next(case for case in samples() if "hand" in case.name)
    ends, faces = divided(torch.stack([hand.x_a, hand.x_b]), hand.faces)
    gradients = [f"with gradients, {device}" for device in devices]
    columns = ["vertices", "batch", *devices, *gradients]
    if len(devices) > 1:
        columns += ["ratio", "ratio with gradients"]
    keep = arguments.keep if len(devices) > 1 else None
    with Table("gpu", columns, keep, timed=columns[2:], labels=2) as table:
        for case in (hand, Case("divided", KeyframeSet(ends, faces), 0, 1, {})):
            layers = {device: tm.InBetween(case.bases(), case.faces).to(device) for device in devices}
            for n in (1, 8, 64):
                forward, backward = [], []
                for device, layer in layers.items():
                    both, own = torch.stack([case.x_a, case.x_b]).to(device), times[:n].to(device)
                    with torch.no_grad():
                        forward.append(1e3 * clock(lambda: layer(*both, own), device) / n)  # noqa: B023
                    backward.append(1e3 * clock(lambda: trained(layer, both, own), device) / n)  # noqa: B023
                ratios = [cpu / gpu for cpu, gpu in (forward, backward)] if len(devices) > 1 else []
                cells = [f"{x:.1f}" for x in (*forward, *backward, *ratios)]
                table.add(f"{len(case.x_a):,}", str(n), *cells)


def threads(arguments: argparse.Namespace) -> None:
    """Two threads over one, on the clock: the sample creature, the best of all rounds."""
    case = next(case for case in samples() if "creature" in case.name)
    layer, times = tm.InBetween(case.bases(), case.faces), torch.linspace(0.05, 0.95, 16, dtype=torch.float64)
    ends = [x.expand(len(times), -1, -1) for x in (case.x_a, case.x_b)]
    six = load_sample("creature").keyframes[:6]

    def forward() -> None:
        with torch.no_grad():
            layer(*ends, times)

    def backward() -> None:
        layer(*(x.clone().requires_grad_() for x in ends), times).square().sum().backward()

    def divided() -> None:
        tm.interpolate(torch.stack([case.x_a, case.x_b]), case.faces, 4, bases=case.bases(), progress=False)

    def extracted() -> None:
        with tempfile.TemporaryDirectory() as scratch:
            os.environ["TORCH_MODAL_CACHE"] = scratch
            tm.extract_bases(six, case.faces, progress=False)

    works = {"16 in-betweens": forward, "the same with gradients": backward, "subdivide, levels=4": divided}
    for name, work in {**works, "extract_bases of six": extracted}.items():
        best = {1: math.inf, 2: math.inf}
        for _ in range(arguments.rounds + 1):
            for n in best:
                limit_threads(n)
                start = time.perf_counter()
                work()
                best[n] = min(best[n], time.perf_counter() - start)
        one, two = best.values()
        print(f"{name:<24}{1e3 * one:7.0f} ms on one thread, {1e3 * two:7.0f} on two: {one / two:.2f}", flush=True)


FIRST = """
import json, os, sys, time
start = time.perf_counter()
import torch, torch_modal as tm
loaded, used = time.perf_counter(), sum(os.times()[:4])
keyframes, faces = torch.load(sys.argv[1])
tm.interpolate(keyframes, faces, levels=3)
print(json.dumps([loaded - start, time.perf_counter() - loaded, sum(os.times()[:4]) - used]))
"""


def first(arguments: argparse.Namespace) -> None:
    """Two new key-frames to a sequence of nine shapes, with nothing kept on disk, on the clock, default threads.

    The package is bytecode by then, as one that is installed is, and its kernels are compiled: one round more comes
    before, which does not count.
    """
    for name, case in all_cases().items():
        found = []
        for _ in range(arguments.rounds + 1):
            with tempfile.TemporaryDirectory() as scratch:
                torch.save((torch.stack([case.x_a, case.x_b]), case.faces), Path(scratch) / "given.pt")
                environment = {**os.environ, "TORCH_MODAL_CACHE": str(Path(scratch) / "cache")}
                environment.pop("PYTHONDONTWRITEBYTECODE", None)
                command = [sys.executable, "-c", FIRST, str(Path(scratch) / "given.pt")]
                out = subprocess.run(command, check=True, env=environment, capture_output=True, text=True).stdout
                found.append(json.loads(out.splitlines()[-1]))
        load, spent, used = (min(times) for times in zip(*found[1:], strict=True))
        print(
            f"{name:<24}{len(case.x_a):>7} vertices: {spent:.2f} s, {used:.2f} s of the processor with children; "
            f"imports {load:.2f} s before",
            flush=True,
        )


PARTS = {"compare": compare, "blends": blends, "first": first, "batches": batches, "threads": threads}


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=["compare"])
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    parser.add_argument("--peer-python", type=Path, metavar="FILE", help="a Python that has morphomatics")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="TEXT", help="meshes with one of these in their names"
    )
    parser.add_argument("--device", default="cpu", help="of the batches")
    parser.add_argument("--threads", type=int, default=1, help="of the batches, on the CPU")
    parser.add_argument("--worker", nargs=2, metavar=("CASE", "ANSWER"), help=argparse.SUPPRESS)
    add_keep(parser)
    arguments = parser.parse_args()
    if arguments.worker:
        worker(*arguments.worker)
        return
    if arguments.peer_python:
        os.environ["TORCH_MODAL_PEER_PYTHON"] = str(arguments.peer_python)
    for part in arguments.parts:
        PARTS[part](arguments)


if __name__ == "__main__":
    main()
