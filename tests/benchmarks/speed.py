"""How fast in-betweens are: kernels against torch, against other versions of this package, and against morphomatics.

    python tests/benchmarks/speed.py [--before CHECKOUT] [--peer-python FILE] [--rounds 3]
    python tests/benchmarks/speed.py --parts growth first
    python tests/benchmarks/speed.py --parts batches [--device cuda]

Each side runs in processes of its own, on one thread, in turns; what is told are ratios of processor seconds, the best
of all rounds, so that what else a machine does slows all sides. ``--before`` names the folder of another checkout, for
example of an earlier commit. Bases are there before the clock starts, but for ``--parts first``: from two new
key-frames to a sequence with nothing cached, on the clock. ``--parts batches`` compares batches, forward and with their
gradients, with single calls.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import trimesh
from cases import Case, samples, shared
from methods import UnavailableError, by_peer, peer_python
from timing import limit_threads, timed

import torch_modal as tm
from torch_modal.data.samples import load_sample

WORK = ("whole", "without local steps", "forward and backward", "making a layer")
MOTION = ("193 shapes", "making a path")
BASELINE = "torch"


def all_cases() -> dict[str, Case]:
    """One case of each mesh."""
    meshes: dict[int, Case] = {}
    for case in [*samples(), *shared()]:
        meshes.setdefault(len(case.x_a), case)
    return {case.name: case for case in meshes.values() if len(case.x_a) > 1000}


def solvers(backend: str) -> list[tm.Solver]:
    """The default, and that without local steps."""
    chosen = {} if backend == "before" else {"backend": backend}
    return [tm.Solver(**chosen), tm.Solver(local_steps=0, **chosen)]


def worker(name: str, backend: str, answer: str) -> None:
    """One side of one case: seconds, and what came out."""
    limit_threads()
    if name == "motion":
        sample = load_sample("creature")
        faces = sample.faces
        bases = tm.extract_bases(sample.keyframes, faces)
        path = tm.Path(bases, faces, cyclic=True, solver=solvers(backend)[0])
        t = torch.arange(193, dtype=torch.float64) / 193 * len(sample.keyframes)

        def make() -> Any:
            return tm.Path(bases, faces, cyclic=True, solver=solvers(backend)[0])

        with torch.no_grad():
            found = {"193 shapes": timed(lambda: path(sample.keyframes, t))[1], "making a path": timed(make)[1]}
            np.savez(answer, shape=path(sample.keyframes, t).numpy(), gradient=0, **found)
        return
    case = all_cases()[name]
    bases, x_a, x_b = case.bases(), case.x_a, case.x_b
    layer, modal = (tm.InBetween(bases, case.faces, solver=solver) for solver in solvers(backend))

    def backward() -> torch.Tensor:
        leaf = x_a.clone().requires_grad_()
        (found,) = torch.autograd.grad(layer(leaf, x_b, 0.5).square().sum(), leaf)
        return found

    found: dict[str, Any] = {
        "forward and backward": timed(backward)[1],
        "making a layer": timed(lambda: tm.InBetween(bases, case.faces, solver=solvers(backend)[0]))[1],
    }
    with torch.no_grad():
        found["whole"] = timed(lambda: layer(x_a, x_b, 0.5))[1]
        found["without local steps"] = timed(lambda: modal(x_a, x_b, 0.5))[1]
        shape = layer(x_a, x_b, 0.5).numpy() / float((x_a.amax(0) - x_a.amin(0)).norm())
    np.savez(answer, shape=shape, gradient=backward().numpy(), **found)


def run(name: str, side: str, before: Path | None) -> dict[str, np.ndarray]:
    """A worker in a process of its own."""
    root = Path(tm.__file__).parents[1] if side != "before" or before is None else before
    with tempfile.TemporaryDirectory() as scratch:
        answer = Path(scratch) / "answer.npz"
        command = [sys.executable, __file__, "--worker", name, side, str(answer)]
        environment = {**os.environ, "PYTHONPATH": str(root)}  # whose package is measured
        subprocess.run(command, check=True, env=environment, stderr=subprocess.DEVNULL)
        return dict(np.load(answer))


def compare(arguments: argparse.Namespace) -> None:
    """Kernels, torch, another checkout, morphomatics."""
    sides = ["warp", BASELINE, *(["before"] if arguments.before else [])]
    ratios: dict[tuple[str, str], list[float]] = {}
    peers = []
    for name, case in [*all_cases().items(), ("motion", None)]:
        rounds = [{side: run(name, side, arguments.before) for side in sides} for _ in range(arguments.rounds)]
        work = MOTION if name == "motion" else WORK
        best = {(side, part): min(float(each[side][part]) for each in rounds) for side in sides for part in work}
        print(f"\n{name}" + ("" if case is None else f", {len(case.x_a)} vertices"))
        for part in work:
            line = f"  {part:<22}" + "".join(f"{side} {1e3 * best[side, part]:7.1f} ms  " for side in sides)
            for side in sides[1:]:
                ratios.setdefault((part, side), []).append(best[side, part] / best["warp", part])
                line += f"  {side}/warp {ratios[part, side][-1]:.2f}"
            print(line)
        ours, truth = rounds[0]["warp"], rounds[0][BASELINE]
        scale = max(float(np.abs(truth["gradient"]).max()), 1e-300)
        print(
            f"  warp against torch: shape {np.abs(ours['shape'] - truth['shape']).max():.1e} of the diagonal, gradient "
            f"{np.abs(ours['gradient'] - truth['gradient']).max() / scale:.1e} of the largest",
            flush=True,
        )
        if case is not None and peer_python():
            try:
                theirs = min(by_peer(case).seconds for _ in range(arguments.rounds))
            except UnavailableError as error:
                print(f"  morphomatics: {error}")
                continue
            peers.append(best["warp", "whole"] / theirs)
            print(f"  morphomatics {1e3 * theirs:.1f} ms: whole takes {peers[-1]:.2f} of that")
    print("\nmedians")
    for (part, side), found in ratios.items():
        print(f"  {part:<22} {side}/warp {median(found):.2f}   ({min(found):.2f} to {max(found):.2f}, of {len(found)})")
    if peers:
        print(f"  whole / morphomatics   {median(peers):.2f}   ({min(peers):.2f} to {max(peers):.2f})")


def growth(arguments: argparse.Namespace) -> None:
    """The same shapes with more and more vertices."""
    limit_threads()
    case = next(iter(all_cases().values()))
    shapes, faces = torch.stack([case.x_a, case.x_b]), case.faces
    for _ in range(3):
        bases = tm.extract_bases(shapes, faces)
        for backend in ("warp", "torch"):
            both = [tm.InBetween(bases, faces, solver=solver) for solver in solvers(backend)]
            with torch.no_grad():
                whole, modal = (timed(lambda: layer(*shapes, 0.5))[1] for layer in both)  # noqa: B023
            print(
                f"{shapes.shape[1]:>7} vertices, {backend:<5}: whole {1e3 * whole:7.1f} ms, modal {1e3 * modal:7.1f} ms"
            )
        finer = [trimesh.remesh.subdivide(x.numpy(), faces.numpy()) for x in shapes]
        shapes, faces = torch.tensor(np.stack([x for x, _ in finer])), torch.tensor(finer[0][1])


def batches(arguments: argparse.Namespace) -> None:
    """Time of one in-between in batches of the sample hand at random times, on the clock."""
    limit_threads()
    case = next(case for case in samples() if "hand" in case.name)
    layer = tm.InBetween(case.bases(), case.faces).to(arguments.device)
    both = torch.stack([case.x_a, case.x_b]).to(arguments.device)
    times = torch.rand(64, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).to(arguments.device)

    def clock(work: Callable[[], Any]) -> float:
        found = []
        for _ in range(arguments.rounds + 1):
            start = time.perf_counter()
            work()
            if arguments.device == "cuda":
                torch.cuda.synchronize()
            found.append(time.perf_counter() - start)
        return min(found[1:])

    def trained(n: int) -> None:
        layer(*both.clone().requires_grad_(), times[:n]).square().sum().backward()

    for n in (1, 4, 16, 64):
        with torch.no_grad():
            forward = clock(lambda: layer(*both, times[:n]))  # noqa: B023
        backward = clock(lambda: trained(n))  # noqa: B023
        print(f"batch of {n:2d}: {1e3 * forward / n:6.1f} ms each, with gradients {1e3 * backward / n:6.1f} ms")


FIRST = """
import json, os, sys, time
start = time.perf_counter()
import torch, torch_modal as tm
loaded, used = time.perf_counter(), sum(os.times()[:4])
keyframes, faces = torch.load(sys.argv[1])
tm.subdivide(keyframes, faces, levels=3)
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


PARTS = {"compare": compare, "growth": growth, "first": first, "batches": batches}


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=["compare"])
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    parser.add_argument("--peer-python", type=Path, metavar="FILE", help="a Python that has morphomatics")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu", help="of the batches")
    parser.add_argument("--worker", nargs=3, metavar=("CASE", "SIDE", "ANSWER"), help=argparse.SUPPRESS)
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
