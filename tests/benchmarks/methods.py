"""The ways to an in-between that are compared.

A method is a function of a case that gives the frames at the case's times, and how long one call for all of them took,
with everything that can be prepared beforehand left out. ``METHODS`` has them by their names.
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from cases import HALF, Case
from decimated_pair import ReducedPair, froehlich_botsch
from full_space import full_space
from geodesic import geodesic
from helpers.shapes import rigid_blend
from timing import timed

import torch_modal as tm

PEER, PEER_SECONDS = "TORCH_MODAL_PEER_PYTHON", 180
MOST_VERTICES = 5_000  # over all vertices: more take minutes
# One thread, as for all others. Most of the threads of NPROC only wait; of two, jax 0.10 waits for itself for ever.
PEER_ENVIRONMENT = {
    "NPROC": "8",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}


class Outcome(NamedTuple):
    """What a method gives."""

    frames: torch.Tensor
    """*Shape:* ``(T, V, 3)``."""
    seconds: float
    """Processor seconds of one call for all T."""
    making: float = float("nan")
    """Seconds of what is made once for a mesh, where that was timed."""


class UnavailableError(Exception):
    """This method cannot run here, or not on this case."""


def linear(case: Case) -> Outcome:
    """Straight lines between the first key-frame and the second laid upon it; the rigid motion along its geodesic."""
    times = torch.tensor(case.times, dtype=case.x_a.dtype)
    weights = torch.ones(len(case.x_a), dtype=case.x_a.dtype)
    return Outcome(*timed(lambda: rigid_blend(case.x_a, case.x_b, times, weights)))


def paper(case: Case) -> Outcome:
    """The preset "paper", which knows t = 1/2 alone."""
    layer = tm.MidShape(case.bases(30), case.faces, preset="paper")
    with torch.no_grad():
        shape, seconds = timed(lambda: layer(case.x_a, case.x_b))
    return Outcome(shape[None], seconds)


def by_layer(case: Case, preset: Literal["accurate", "fast", "modal"]) -> Outcome:
    """All times in one call of the layer."""
    ends = case.bases(30) if preset == "modal" else torch.stack([case.x_a, case.x_b])
    layer, times = tm.InBetween(ends, case.faces, preset), torch.tensor(case.times, dtype=torch.float64)
    with torch.no_grad():
        return Outcome(*timed(lambda: layer(case.x_a, case.x_b, times)))


def optimum(case: Case) -> Outcome:
    """The optimum over all vertices: the best of what our own in-between and linear interpolation lead to."""
    if len(case.x_a) > MOST_VERTICES:
        raise UnavailableError(f"{len(case.x_a)} vertices are too many")
    starts, shapes = by_layer(case, "accurate").frames, []
    begin = time.process_time()
    for start, t in zip(starts, case.times, strict=True):
        results = [full_space(case.x_a, case.x_b, case.faces, t, start=x) for x in (start, None)]
        shapes.append(min(results, key=lambda result: result.energies[-1]).shape)
    return Outcome(torch.stack(shapes), time.process_time() - begin)


def example_based(case: Case) -> Outcome:
    """One reference with interpolated lengths and angles, on a decimated mesh, and back by deformation transfer."""
    reduced = ReducedPair(case.x_a, case.x_b, case.faces, 1000)
    return Outcome(*timed(lambda: torch.stack([froehlich_botsch(reduced, t) for t in case.times])))


def isometric_geodesic(case: Case) -> Outcome:
    """As-isometric-as-possible (Kilian et al. 2007): eight steps, all optimised together, from coarse to fine."""
    begin = time.process_time()
    found = geodesic(case.x_a, case.x_b, case.faces)
    seconds = time.process_time() - begin
    return Outcome(found.at(torch.tensor(case.times, dtype=case.x_a.dtype)), seconds)


def add_peer(parser: argparse.ArgumentParser) -> None:
    """The option that names a Python with the peers, for this process and its children."""

    def named(python: str) -> str:
        os.environ[PEER] = python
        return python

    parser.add_argument("--peer-python", type=named, metavar="FILE", help="a Python that has morphomatics")


def peer_python() -> str | None:
    """The interpreter that has the peers: ``TORCH_MODAL_PEER_PYTHON``, or this one if they are installed here."""
    return os.environ.get(PEER) or (sys.executable if importlib.util.find_spec("morphomatics") else None)


def by_peer(case: Case, limit: float = PEER_SECONDS) -> Outcome:
    """In-betweens by morphomatics, in a child process: its threads and its memory are its own.

    By differential coordinates with the first key-frame as the reference, as in the library's tutorial. No answer
    within the limit, in seconds, is an :class:`UnavailableError`.
    """
    python = peer_python()
    if python is None:
        raise UnavailableError("pip install morphomatics, or name a Python that has it with --peer-python")
    used = case.faces.unique()
    number = torch.full((len(case.x_a),), -1).index_put((used,), torch.arange(len(used)))
    with tempfile.TemporaryDirectory() as scratch:
        request, answer = Path(scratch) / "request.npz", Path(scratch) / "answer.npz"
        arrays = {"x_a": case.x_a[used].numpy(), "x_b": case.x_b[used].numpy(), "faces": number[case.faces].numpy()}
        np.savez(request, times=np.array(case.times), **arrays)
        command = [python, str(Path(__file__).with_name("morphomatics_worker.py")), str(request), str(answer)]
        environment = {**os.environ, **PEER_ENVIRONMENT}
        environment.pop("PYTHONPATH", None)
        try:
            run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired as error:
            raise UnavailableError(f"no answer in {limit:g} s") from error
        if run.returncode != 0:
            raise UnavailableError((run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1][:120])
        given = np.load(answer)
        frames = torch.from_numpy(given["frames"]).to(case.x_a.dtype)
    whole = torch.lerp(case.x_a, case.x_b, HALF).repeat(len(case.times), 1, 1)
    whole[:, used] = frames  # vertices of no face stay where they are
    return Outcome(whole, float(given["seconds"]), making=float(given["making"]))


METHODS: dict[str, Callable[[Case], Outcome]] = {
    "linear": linear,
    "paper": paper,
    "fast": partial(by_layer, preset="fast"),
    "accurate": partial(by_layer, preset="accurate"),
    "modal": partial(by_layer, preset="modal"),
    "optimum": optimum,
    "Froehlich-Botsch": example_based,
    "geodesic": isometric_geodesic,
    "morphomatics": by_peer,
}
